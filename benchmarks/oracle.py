"""Judge behaviour learning and the world model apart: imagine in the simulator itself.

    uv run python -m benchmarks.oracle --env smax/3s_vs_4z --total-steps 40000 --json oracle.jsonl
    uv run python -m benchmarks.oracle --env smax/3m --inputs latents --reward learned
    uv run python -m benchmarks.oracle --env smax/3m --inputs latents --model RUN
    uv run python -m benchmarks.oracle_table oracle.jsonl --png oracle.png

Trains as `mabl train` does, with every field of the configuration as a flag, but replaces parts of
imagination by the simulator, started from the stored true states of replayed rows. What then fails
is not the fault of the replaced parts: see docs/oracle.md. Environments must be compiled, and
`--algo` one of a world model and a behaviour in its imagination (not mag or mappo).
"""

import json
import math
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import tyro
from einops import rearrange
from jaxtyping import Array, Float

from benchmarks.agreement import agreement
from mabl import replay as replays
from mabl.algorithms.base import Experience
from mabl.algorithms.model_based import Learner, ModelBased
from mabl.behaviour.qmix import QMIX
from mabl.cli.runs import chosen_preset, parse_with_config
from mabl.devices import use_compilation_cache
from mabl.envs.base import CompiledEnv
from mabl.envs.host import Hosted
from mabl.errors import UserError
from mabl.evaluation import evaluate
from mabl.execution import Executor, Policy, executor_of
from mabl.imagination import Imagined
from mabl.nets.categorical import still
from mabl.replay import Replay
from mabl.rollout import Collector, Episodes, advance, start
from mabl.rows import TimeStep, is_last
from mabl.runs import folder
from mabl.runs.checkpoint import Checkpoints
from mabl.training.loop import TrainState, cycle_keys, repeat, with_recalled_memories
from mabl.training.programs import DIAGNOSE, as_in_a_run, build
from mabl.types import Metrics, PRNGKey, Replayed, TeamView, Trajectory
from mabl.world_models.sequences import observe_sequence

Source = Literal["true", "learned"]
EPISODES = 256
"""Greedy and sampled episodes of an evaluation."""


def flag(help: str) -> Any:
    return tyro.conf.arg(help=help)


FLAGS = (
    ("inputs", Annotated[Literal["observations", "latents"], flag("What policies see.")]),
    ("dynamics", Annotated[Source, flag("Who says what comes next.")]),
    ("reward", Annotated[Source, flag("Who says what it pays.")]),
    ("ends", Annotated[Source, flag("Who says whether the episode ends.")]),
    ("model", Annotated[Path | None, flag("Run folder whose world model is used, frozen.")]),
    ("name", Annotated[str, flag("Name of the setting in tables.")]),
    ("every", Annotated[int, flag("Environment steps between points.")]),
    ("evaluate_every", Annotated[int, flag("Environment steps between evaluations.")]),
    ("json", Annotated[Path | None, flag("File to append points to.")]),
)
DEFAULTS = ("observations", "true", "true", "true", None, "", 5_000, 20_000, None)


class Parts(NamedTuple):
    """Which parts of imagination the simulator replaces, and what policies see."""

    inputs: str
    dynamics: Source
    reward: Source
    ends: Source

    @property
    def learned(self) -> bool:
        """Whether imagination asks the world model for anything."""
        return "learned" in (self.dynamics, self.reward, self.ends)

    @property
    def simulated(self) -> bool:
        """Whether imagination asks the simulator for anything."""
        return "true" in (self.dynamics, self.reward, self.ends)

    @property
    def model(self) -> bool:
        """Whether there is a world model at all."""
        return self.learned or self.inputs == "latents"


class Recorded(NamedTuple):
    """A step in the replay: its row, and the simulator's state there."""

    row: TimeStep
    env_state: Any


class Sight(eqx.Module):
    """A `LocalFilter` of policies that see their observation as it is."""

    obs_dim: int = eqx.field(static=True)

    def initial(self) -> Array:
        return jnp.zeros(self.obs_dim)

    def __call__(self, memory: Array, prev_action: Array, obs: Array, key: PRNGKey) -> Array:
        del memory, prev_action, key
        return obs

    def features(self, memory: Array) -> Array:
        return memory


class Oracle(NamedTuple):
    """An algorithm whose imagination is the simulator, wholly or in part."""

    env: CompiledEnv
    algorithm: ModelBased
    parts: Parts

    def init(self, key: PRNGKey) -> TrainState:
        plan = self.algorithm.config.training
        key, key_learner, key_behaviour, key_envs, key_shape = jax.random.split(key, 5)
        learner = self.algorithm.init(key_learner)
        if self.parts.inputs == "observations":
            row = self.env.reset(key_shape)[1]
            space = self.algorithm.spec.action_space
            behaviour = self.algorithm.behaviour.init(
                self._view(learner, row), space, key_behaviour
            )
            learner = learner._replace(behaviour=behaviour)
        executor = self.executor(learner)
        collectors = jax.vmap(lambda key: start(self.env, executor, key))(
            jax.random.split(key_envs, plan.num_envs)
        )
        capacity = plan.replay_capacity // plan.num_envs
        replay = jax.vmap(lambda c: replays.empty(Recorded(c.row, c.env_state), capacity))(
            collectors
        )
        return TrainState(learner, replay, collectors, key, jnp.int32(0), jnp.int32(0))

    def executor(self, learner: Learner, greedy: bool = False) -> Executor:
        """Executor of the learner's policy in the environment."""
        policy = self.algorithm.policy(learner)
        if self.parts.inputs == "observations":
            policy = Policy(Sight(self.algorithm.spec.obs_dim), policy.actor)
        return executor_of(policy, self.algorithm.spec.action_space, greedy)

    def cycle(
        self, state: TrainState, n_model: Array, n_policy: Array, total_steps: Array
    ) -> tuple[TrainState, Metrics]:
        """`Training.cycle`, with imagination replaced."""
        keys = cycle_keys(state.key)
        collectors, recorded, episodes = self.collect(state.learner, state.collectors, keys.collect)
        count = jnp.full(recorded.row.is_first.shape[0], recorded.row.is_first.shape[1])
        replay = jax.vmap(replays.add)(state.replay, recorded, count)
        rows = replay._replace(rows=replay.rows.row)
        progress = state.env_steps / total_steps
        experience = Experience(rows, None, None, progress)  # pyright: ignore[reportArgumentType]
        learner, model_metrics = state.learner, {}
        if self.parts.model:
            learner, model_metrics = repeat(
                lambda learner, key: self.algorithm.update_model(learner, experience, key),
                learner,
                keys.model,
                n_model,
            )

        def update_policy(learner: Learner, key: PRNGKey) -> tuple[Learner, Metrics]:
            if not self.parts.simulated:
                return self.algorithm.update_policy(learner, experience, key)
            key_imagine, key_learn = jax.random.split(key)
            imagined = self.imagine(learner, replay, key_imagine)
            return self.algorithm.learn(learner, *imagined, key_learn, progress)

        learner, policy_metrics = repeat(update_policy, learner, keys.policy, n_policy)
        collectors = with_recalled_memories(
            self.algorithm, self.executor(learner), rows, collectors, keys.recall
        )
        steps = (~recorded.row.is_first).sum(dtype=jnp.int32)
        after = TrainState(
            learner,
            replay,
            collectors,
            keys.after,
            state.env_steps + steps,
            state.model_updates + n_model,
        )
        ended = {f"episodes/{name}": x.sum() for name, x in episodes._asdict().items()}
        return after, model_metrics | policy_metrics | ended

    def diagnose(self, state: TrainState) -> Metrics:
        """Compute the world model's diagnostics, as `mabl train` does, and its `agreement`."""
        rows = state.replay._replace(rows=state.replay.rows.row)
        key_model, key_agreement = jax.random.split(jax.random.fold_in(state.key, DIAGNOSE))
        metrics = self.algorithm.diagnose(state.learner, rows, key_model)
        return metrics | agreement(self, state, key_agreement)

    def collect(
        self, learner: Learner, collectors: Collector, key: PRNGKey
    ) -> tuple[Collector, Recorded, Episodes]:
        """Act in every environment; rewards are scaled as learning wants them."""
        plan, executor = self.algorithm.config.training, self.executor(learner)

        def step(collector: Collector, key: PRNGKey) -> tuple[Collector, Any]:
            collector, episodes = advance(self.env, executor, collector, key)
            row = collector.row._replace(reward=collector.row.reward * plan.reward_scale)
            return collector, (Recorded(row, collector.env_state), episodes)

        def one(collector: Collector, key: PRNGKey) -> tuple[Collector, Any]:
            return jax.lax.scan(step, collector, jax.random.split(key, plan.collect_steps))

        collectors, kept = jax.vmap(one)(collectors, jax.random.split(key, plan.num_envs))
        return collectors, *kept

    def imagine(
        self, learner: Learner, replay: Replay, key: PRNGKey
    ) -> tuple[Trajectory, Replayed]:
        """`ModelBased.imagine`, with the simulator in the place of the model's parts."""
        sizes, plan = self.algorithm.config.world_model, self.algorithm.config.imagination
        key_sample, key_observe, key_start, key_imagine = jax.random.split(key, 4)
        recorded = replays.sample_sequences(
            replay, key_sample, sizes.batch_size, sizes.batch_length, plan.recency
        )
        latents = None
        if self.parts.model:
            keys = jax.random.split(key_observe, sizes.batch_size)
            latents = still(
                jax.vmap(lambda *at: observe_sequence(learner.model, *at)[0])(recorded.row, keys)
            )
        flat = jax.tree.map(
            lambda x: rearrange(x, "b t ... -> (b t) ..."),
            ((recorded.env_state, recorded.row, latents), 1.0 - is_last(recorded.row)),
        )
        order = jax.random.permutation(key_start, flat[1].shape[0])
        order = order[jnp.argsort(-flat[1][order], stable=True)][
            : plan.n_starts or flat[1].shape[0]
        ]
        begin, weight = jax.tree.map(lambda x: x[order], flat)
        keys = jax.random.split(key_imagine, weight.shape[0])
        trajectory = jax.vmap(lambda *start: self.trajectory(learner, *start), out_axes=1)(
            begin, weight, keys
        )
        view = jax.vmap(jax.vmap(lambda row, z: self._view(learner, row, z)))(recorded.row, latents)
        return jax.lax.stop_gradient((trajectory, Replayed(view, recorded.row)))

    def trajectory(
        self, learner: Learner, begin: tuple, weight: Float[Array, ""], key: PRNGKey
    ) -> Trajectory:
        """One imagined trajectory from a replayed step."""
        algorithm, parts = self.algorithm, self.parts
        actor, dream = algorithm.behaviour.actor(learner.behaviour), algorithm.dream(learner)
        scale = algorithm.config.training.reward_scale
        # SMAX's own random numbers aside, a trajectory of learned dynamics lives through what the
        # simulator makes of the same actions: from there come true rewards and ends.

        def step(carry: tuple, key: PRNGKey) -> tuple[tuple, tuple]:
            env_state, row, latent = carry
            key_action, key_env, key_model, key_observe = jax.random.split(key, 4)
            view = self._view(learner, row, latent)
            policy = jax.vmap(actor)(view.actor_features, view.available)
            action = policy.sample(key_action)
            log_prob = policy.log_prob(action)
            reward = continues = after = None
            if parts.learned:
                imagined = Imagined(latent, row.available, row.alive)
                after, predicted = dream.step(imagined, action, key_model)
                reward, continues = predicted.reward, dream.continues(predicted)
            if parts.simulated:
                env_state, true = self.env.step(
                    key_env, env_state, action.astype(algorithm.spec.action_space.dtype)
                )
                if parts.reward == "true":
                    reward = true.reward * scale
                if parts.ends == "true":
                    continues = 1.0 - true.terminated
                if parts.dynamics == "true":
                    row = true
                    if latent is not None:
                        model = learner.model
                        latent = still(model.observe(latent, model.encode(row), key_observe)[0])
            if parts.dynamics == "learned":
                row = row._replace(available=after.available, alive=after.alive)
                latent = after.latent
            return (env_state, row, latent), (view, action, log_prob, reward, continues)

        keys = jax.random.split(key, algorithm.config.imagination.horizon - 1)
        (_, row, latent), (view, action, log_prob, reward, continues) = jax.lax.scan(
            step, begin, keys
        )
        last = self._view(learner, row, latent)
        view = jax.tree.map(lambda xs, x: jnp.concatenate([xs, x[None]]), view, last)
        survived = jnp.concatenate([jnp.ones_like(continues[:1]), continues[:-1]])
        return Trajectory(
            view, action, log_prob, reward, continues, weight * jnp.cumprod(survived, axis=0)
        )

    def _view(self, learner: Learner, row: TimeStep, latent: Any = None) -> TeamView:
        if self.parts.inputs == "latents":
            return self.algorithm.view(learner.model, latent, row.available, row.alive)
        if isinstance(self.algorithm.behaviour, QMIX):
            return TeamView(row.obs, row.state, row.available, row.alive)
        state = jnp.broadcast_to(row.state, (row.obs.shape[0], row.state.shape[-1]))
        return TeamView(row.obs, (row.obs, state), row.available, row.alive)


def main() -> None:
    try:
        run(sys.argv[1:])
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(2)


def run(arguments: list[str]) -> None:
    """Train as the flags say, and print a JSON line a point."""
    prog = "python -m benchmarks.oracle"
    default, rest = chosen_preset(arguments, prog)
    flags = [(*f, d) for f, d in zip(FLAGS, DEFAULTS, strict=True)]
    config, given = parse_with_config(rest, default, prog, __doc__, *flags)
    use_compilation_cache()
    training, parts = build(config), Parts(given.inputs, given.dynamics, given.reward, given.ends)
    if isinstance(training.env, Hosted) or not isinstance(training.algorithm, ModelBased):
        raise UserError("the oracle needs a compiled environment and an algorithm that imagines")
    if parts.learned and parts.inputs == "observations":
        raise UserError(
            "what a model says is said of its latents: give --inputs latents with learned parts"
        )
    oracle, plan = Oracle(training.env, training.algorithm, parts), config.training
    cycle = jax.jit(as_in_a_run(oracle.cycle, config), donate_argnums=0)
    diagnose = jax.jit(as_in_a_run(oracle.diagnose, config))
    state = jax.jit(as_in_a_run(oracle.init, config))(jax.random.key(config.seed))
    if given.model:
        state = state._replace(learner=state.learner._replace(model=model_of(given.model)))
    learns = parts.model and not given.model
    about = {
        "name": given.name or config.algo,
        "env": config.env,
        "seed": config.seed,
        **parts._asdict(),
        "model": str(given.model or ""),
        "commit": commit(),
    }
    sums: dict[str, float] = {}
    step, began = 0, time.process_time()
    while step < config.total_steps:
        ready = step >= max(plan.prefill_steps, plan.num_envs * training.algorithm.rows_needed)
        n_model, n_policy = (plan.model_updates, plan.policy_updates) if ready else (0, 0)
        if ready and int(state.model_updates) < plan.pretrain_updates and learns:
            n_model, n_policy = plan.pretrain_updates, 0
        state, metrics = cycle(state, n_model * learns, n_policy, config.total_steps)
        before, step = step, int(state.env_steps)
        metrics = {k: float(v) for k, v in jax.device_get(metrics).items()}
        for name, value in metrics.items():
            if name.startswith("episodes/"):
                sums[name] = sums.get(name, 0.0) + value
        if step // given.every > before // given.every or step >= config.total_steps:
            point = about | {"step": step, **told(metrics, sums, training.env.spec.score_name)}
            if (
                step // given.evaluate_every > before // given.evaluate_every
                or step >= config.total_steps
            ):
                point |= played(oracle, state)
                if parts.dynamics == "learned":
                    point |= said(diagnose(state))
            point["cpu_seconds"] = round(time.process_time() - began, 1)
            say(point, given.json)
            sums = {}


def told(metrics: dict[str, float], sums: dict[str, float], score: str) -> dict[str, float]:
    """Means over the episodes since the last point, and the newest cycle's metrics of learning."""
    episodes = max(sums["episodes/ended"], 1.0)
    found = {
        score: sums["episodes/score"] / episodes,
        "episode_return": sums["episodes/episode_return"] / episodes,
        "episode_length": sums["episodes/length"] / episodes,
    }
    return said(found | {k: v for k, v in metrics.items() if not k.startswith("episodes/")})


def said(metrics: Metrics) -> dict[str, float]:
    """Keep finite values, rounded, under the last part of their names."""
    finite = {k.rpartition("/")[2]: float(v) for k, v in metrics.items() if math.isfinite(v)}
    return {k: round(v, 4) for k, v in finite.items()}


def played(oracle: Oracle, state: TrainState) -> dict[str, float]:
    """Scores of greedy and of sampled episodes."""
    key = jax.random.key(2**31 - 2)
    return {
        kind: round(
            float(
                evaluate(
                    oracle.env, oracle.executor(state.learner, kind == "greedy"), key, EPISODES
                ).score.mean()
            ),
            4,
        )
        for kind in ("greedy", "sampled")
    }


def model_of(run: Path) -> Any:
    """The world model of a run's newest checkpoint."""
    training = build(folder.read_config(run))
    shape = jax.eval_shape(training.init, jax.random.key(0))
    return Checkpoints(run / "checkpoints").restore("state", shape)[1].learner.model


def commit() -> str:
    """The repository's, with a plus where files differ from it."""
    said = subprocess.run(
        ["git", "describe", "--always", "--dirty=+"], capture_output=True, text=True
    )
    return said.stdout.strip()


def say(point: dict[str, Any], file: Path | None) -> None:
    """Print a point, and append it to a file."""
    line = json.dumps(point)
    print(line, flush=True)
    if file:
        with file.open("a") as out:
            out.write(f"{line}\n")


if __name__ == "__main__":
    main()
