"""Playing whole episodes with fixed policies, and summing them up."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from mabl.envs.base import CompiledEnv, EnvSpec
from mabl.envs.host import Hosted
from mabl.envs.pool import Pool
from mabl.envs.workers import open_pool
from mabl.errors import UserError
from mabl.execution import Executor, Memory, RandomExecutor
from mabl.host_rollout import HostRollouts, act_where, start_hosted
from mabl.rollout import rollout, start
from mabl.types import PRNGKey

PARALLEL = 64
"""Episodes played side by side where environments are compiled."""
HOSTED_PARALLEL = 8
"""The same where they run in Python."""


class Results(NamedTuple):
    """One entry for each episode."""

    episode_return: Float[Array, " E"]
    """Mean over agents of the summed rewards, in the environment's units."""
    length: Int[Array, " E"]
    """Joint steps."""
    score: Float[Array, " E"]


def evaluate(
    env: CompiledEnv | Hosted,
    executor: Executor,
    key: PRNGKey,
    episodes: int,
    num_workers: int | None = None,
    worker_timeout: float = 60.0,
    say: Callable[[int], object] = lambda played: None,
) -> Results:
    """Play `episodes` independent episodes to their ends; with workers if the environment needs.

    `say` hears, batch by batch, how many were played so far.
    """
    if not isinstance(env, Hosted):
        return _play_compiled(env, executor, key, episodes, say)
    pool = open_pool(env, min(episodes, HOSTED_PARALLEL), num_workers, worker_timeout)
    try:
        return _play_hosted(pool, env.spec, executor, key, episodes, say)
    finally:
        pool.close()


def _play_compiled(
    env: CompiledEnv,
    executor: Executor,
    key: PRNGKey,
    episodes: int,
    say: Callable[[int], object],
) -> Results:
    @eqx.filter_jit
    def play(executor: Executor, keys: Array) -> Results:
        def one(key: PRNGKey) -> Results:
            key_start, key_play = jax.random.split(key)
            collector = start(env, executor, key_start)
            n_rows = env.spec.episode_limit + 1
            _, played = rollout(env, executor, collector, key_play, n_rows, one_episode=True)
            ended = played.episodes
            return Results(ended.episode_return.sum(), ended.length.sum(), ended.score.sum())

        return jax.vmap(one)(keys)

    batches = -(-episodes // PARALLEL)
    keys = jax.random.split(key, (batches, min(episodes, PARALLEL)))
    played: list[Results] = []
    for batch in keys:
        played.append(jax.device_get(play(executor, batch)))
        say(min(episodes, len(played) * len(batch)))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:episodes], *played)


def _play_hosted(
    pool: Pool,
    spec: EnvSpec,
    executor: Executor,
    key: PRNGKey,
    episodes: int,
    say: Callable[[int], object],
) -> Results:
    key, key_start = jax.random.split(key)
    n_envs = len(pool.slots.command)
    collectors = jax.vmap(lambda key: start_hosted(spec, executor, key))(
        jax.random.split(key_start, n_envs)
    )
    rollouts = HostRollouts(pool, spec, spec.episode_limit + 1, one_episode=True)

    @eqx.filter_jit
    def act(executor: Executor, *of_envs: Any) -> tuple[Memory, Array]:
        return jax.vmap(partial(act_where, executor))(*of_envs)

    played: list[Results] = []
    while (n := sum(len(batch.length) for batch in played)) < episodes:
        say(n)
        key, key_batch = jax.random.split(key)
        keys = jax.random.split(key_batch, n_envs)
        landed = rollouts.collect(
            lambda memory, row, count, go, keys=keys: act(executor, memory, row, keys, count, go),
            collectors,
        )
        collectors, ended = landed.after, landed.rollout.episodes
        whole = ended.ended.any(-1)  # those of lost workers are not
        sums = (ended.episode_return.sum(-1), ended.length.sum(-1), ended.score.sum(-1))
        played.append(Results(*(column[whole] for column in sums)))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:episodes], *played)


def summary(results: Results, spec: EnvSpec) -> dict[str, float | int]:
    """Mean and standard deviation over episodes of score, return and length."""
    columns = {
        spec.score_name: results.score,
        "episode_return": results.episode_return,
        "episode_length": results.length,
    }
    numbers: dict[str, float | int] = {}
    for name, values in columns.items():
        numbers[name] = float(np.mean(values))
        numbers[f"{name}_std"] = float(np.std(values))
    return numbers | {"episodes": len(results.score)}


def baseline(name: str, env: CompiledEnv | Hosted) -> Executor:
    """A policy that learned nothing: `random`, or the environment's own `heuristic`.

    Raises UserError if the environment has no heuristic.
    """
    if name == "random":
        return RandomExecutor(env.spec.action_space)
    heuristic = getattr(env, "heuristic", None)
    if heuristic is None:
        raise UserError(f"{env.spec.name} has no heuristic policy: use --policy random")
    return heuristic()
