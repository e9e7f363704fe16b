"""Algorithm 1 of the paper as a pure function of (config, key); a cycle is one compiled program."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from mabl import replay as replays
from mabl.algorithms.base import Algorithm, Experience
from mabl.envs.base import CompiledEnv
from mabl.envs.host import Hosted
from mabl.execution import Executor, Memory, executor_of
from mabl.host_rollout import start_hosted
from mabl.nets.optimiser import guards
from mabl.replay import Replay
from mabl.rollout import Collector, Rollout, rollout, start
from mabl.rows import TimeStep
from mabl.types import Metrics, PRNGKey


class TrainState(NamedTuple):
    """Everything that decides the future of a run."""

    learner: Any
    replay: Replay
    collectors: Collector
    key: PRNGKey
    env_steps: Int[Array, ""]
    model_updates: Int[Array, ""]


class CycleKeys(NamedTuple):
    """Randomness of a cycle, and of all after it."""

    after: PRNGKey
    collect: PRNGKey
    model: PRNGKey
    policy: PRNGKey
    recall: PRNGKey


def cycle_keys(key: PRNGKey) -> CycleKeys:
    """Split the key of a state."""
    return CycleKeys(*jax.random.split(key, len(CycleKeys._fields)))


class Training(NamedTuple):
    """An algorithm in an environment, ready to run."""

    env: CompiledEnv | Hosted
    algorithm: Algorithm

    def init(self, key: PRNGKey) -> TrainState:
        """Line 1: initialise actor, critic, model and the model buffer."""
        config = self.algorithm.config.training
        key, key_learner, key_envs = jax.random.split(key, 3)
        learner = self.algorithm.init(key_learner)
        executor = self.executor(learner)

        def begin(key: PRNGKey) -> Collector:
            if isinstance(self.env, Hosted):
                return start_hosted(self.env.spec, executor, key)
            return start(self.env, executor, key)

        collectors = jax.vmap(begin)(jax.random.split(key_envs, config.num_envs))
        capacity = config.replay_capacity // config.num_envs
        replay = jax.vmap(lambda row: replays.empty(row, capacity))(collectors.row)
        return TrainState(learner, replay, collectors, key, jnp.int32(0), jnp.int32(0))

    def cycle(
        self,
        state: TrainState,
        n_model: Int[Array, ""],
        n_policy: Int[Array, ""],
        total_steps: Int[Array, ""] | int = 0,
    ) -> tuple[TrainState, Metrics]:
        """Lines 3-14: collect, then `learn`, where environments are compiled too."""
        key = cycle_keys(state.key).collect
        collectors, collected = self.collect(state.learner, state.collectors, key)
        return self.learn(state, collectors, collected, n_model, n_policy, total_steps)

    def learn(
        self,
        state: TrainState,
        collectors: Collector,
        collected: Rollout,
        n_model: Int[Array, ""],
        n_policy: Int[Array, ""],
        total_steps: Int[Array, ""] | int = 0,
    ) -> tuple[TrainState, Metrics]:
        """Lines 4-14: store what was collected, `n_model` model updates, `n_policy` policy updates.

        `total_steps` is the length of the run, which schedules are shares of; with 0 they stay at
        their start. Metrics are means over the cycle's updates (NaN if there were none) and sums
        over the cycle.
        """
        keys = cycle_keys(state.key)
        replay = state.replay
        if isinstance(self.env, Hosted):
            replay = jax.vmap(replays.cut)(replay, state.collectors.row.truncated)
        replay = self.store(replay, collected)
        progress = jnp.where(total_steps > 0, state.env_steps / jnp.maximum(total_steps, 1), 0.0)
        experience = Experience(replay, state.collectors, collected, progress)
        before = state.learner
        learner, model_metrics = repeat(
            lambda learner, key: self.algorithm.update_model(learner, experience, key),
            before,
            keys.model,
            n_model,
        )
        learner, policy_metrics = repeat(
            lambda learner, key: self.algorithm.update_policy(learner, experience, key),
            learner,
            keys.policy,
            n_policy,
        )
        state = TrainState(
            learner=learner,
            replay=replay,
            collectors=with_recalled_memories(
                self.algorithm, self.executor(learner), replay, collectors, keys.recall
            ),
            key=keys.after,
            env_steps=state.env_steps + steps_in(collected),
            model_updates=state.model_updates + n_model,
        )
        skipped = {"train/skipped_updates": skips(learner) - skips(before)}
        return state, model_metrics | policy_metrics | skipped | sums_over(collected)

    def collect(
        self, learner: Any, collectors: Collector, key: PRNGKey
    ) -> tuple[Collector, Rollout]:
        """Line 3: act in every environment, for one episode or a fixed number of rows.

        Rewards are scaled as learning wants them, sums over episodes are not.
        """
        config = self.algorithm.config.training
        assert not isinstance(self.env, Hosted)
        env, executor = self.env, self.executor(learner)
        n_rows, one_episode = self.rows_wanted
        collectors, collected = jax.vmap(
            lambda collector, key: rollout(env, executor, collector, key, n_rows, one_episode)
        )(collectors, jax.random.split(key, config.num_envs))
        rows = collected.rows._replace(reward=collected.rows.reward * config.reward_scale)
        return collectors, collected._replace(rows=rows)

    @property
    def rows_wanted(self) -> tuple[int, bool]:
        """Rows of an environment in a cycle, at most; and whether its episode's end ends them."""
        steps = self.algorithm.config.training.collect_steps
        return steps or self.env.spec.episode_limit + 1, steps is None

    def executor(self, learner: Any) -> Executor:
        """How the learner acts while it learns."""
        return executor_of(self.algorithm.policy(learner), self.env.spec.action_space)

    def store(self, replay: Replay, collected: Rollout) -> Replay:
        """Line 4: append the new rows."""
        return jax.vmap(replays.add)(replay, collected.rows, collected.count)


def with_recalled_memories(
    algorithm: Algorithm, executor: Executor, replay: Replay, collectors: Collector, key: PRNGKey
) -> Collector:
    """Compute the memories of agents in mid-episode anew, with an executor's parameters.

    A memory holds latents of the parameters that computed it, which mean something else to those
    that go on with the episode. Where a cycle ends with an episode, nothing is to be done.
    """
    config, length = algorithm.config.training, algorithm.memory_rows
    if config.collect_steps is None or not length:
        return collectors
    memory = jax.vmap(lambda *lane: recalled_memory(executor, length, *lane))(
        replay, collectors.row, jax.random.split(key, config.num_envs)
    )
    return collectors._replace(memory=memory)


def recalled_memory(
    executor: Executor, length: int, replay: Replay, newest: TimeStep, key: PRNGKey
) -> Memory:
    """Memory of an executor after the last `length` rows of one lane before its newest row.

    The newest row, which gives shapes, has yet to be acted on. Rows that the lane does not hold are
    as if they had never been.
    """
    age = jnp.arange(length, 0, -1)
    index = (replay.cursor - 1 - age) % replay.rows.is_first.shape[0]
    rows = jax.tree.map(lambda x: x[index], replay.rows)
    initial = executor.initial(newest)

    def step(memory: Memory, at: tuple[TimeStep, Array, PRNGKey]) -> tuple[Memory, None]:
        row, known, key = at
        after, _ = executor.act(memory, row, key)
        return jax.tree.map(lambda a, b: jnp.where(known, a, b), after, initial), None

    known = age < replay.size
    return jax.lax.scan(step, initial, (rows, known, jax.random.split(key, length)))[0]


def steps_in(collected: Rollout) -> Int[Array, ""]:
    """Joint environment steps of a rollout: its valid rows less its resets."""
    return (valid_rows(collected) & ~collected.rows.is_first).sum(dtype=jnp.int32)


def valid_rows(collected: Rollout) -> Bool[Array, "E R"]:
    """Which rows of a rollout were collected."""
    return jnp.arange(collected.rows.is_first.shape[1])[None] < collected.count[:, None]


def sums_over(collected: Rollout) -> Metrics:
    """Of a rollout: episodes that ended in it, and rows that are not finite."""
    episodes, rows = collected.episodes, collected.rows
    finite = [jnp.isfinite(x).all(range(2, x.ndim)) for x in (rows.obs, rows.state, rows.reward)]
    return {
        "rows/not_finite": (valid_rows(collected) & ~jnp.stack(finite).all(0)).sum(),
        "episodes/count": episodes.ended.sum(),
        "episodes/return": episodes.episode_return.sum(),
        "episodes/length": episodes.length.sum(),
        "episodes/score": episodes.score.sum(),
    }


def skips(learner: Any) -> Int[Array, ""]:
    """Steps of optimisers that were left out so far."""
    return sum((guard.skipped for guard in guards(learner).values()), jnp.int32(0))


def repeat(
    update: Callable[[Any, PRNGKey], tuple[Any, Metrics]],
    carry: Any,
    key: PRNGKey,
    n: Int[Array, ""],
) -> tuple[Any, Metrics]:
    """Apply `update` n times; a traced n lets prefill, pretraining and cycles share a program."""
    update = jax.jit(update, inline=True)  # is traced once
    shapes = jax.eval_shape(update, carry, key)[1]
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def body(i: Array, carry_sums: tuple[Any, Metrics]) -> tuple[Any, Metrics]:
        carry, sums = carry_sums
        carry, metrics = update(carry, jax.random.fold_in(key, i))
        return carry, jax.tree.map(jnp.add, sums, metrics)

    carry, sums = jax.lax.fori_loop(0, n, body, (carry, zeros))
    return carry, jax.tree.map(lambda x: x / n, sums)
