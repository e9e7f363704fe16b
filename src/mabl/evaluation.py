"""Playing whole episodes with fixed policies, and summing them up."""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from mabl.envs.base import CompiledEnv, EnvSpec
from mabl.errors import UserError
from mabl.execution import Executor, RandomExecutor
from mabl.rollout import rollout, start
from mabl.types import PRNGKey

PARALLEL = 64
"""Episodes played side by side."""


class Results(NamedTuple):
    """One entry for each episode."""

    episode_return: Float[Array, " E"]
    """Mean over agents of the summed rewards, in the environment's units."""
    length: Int[Array, " E"]
    """Joint steps."""
    score: Float[Array, " E"]


def evaluate(env: CompiledEnv, executor: Executor, key: PRNGKey, episodes: int) -> Results:
    """Play `episodes` independent episodes to their ends."""

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
    played = [jax.device_get(play(executor, batch)) for batch in keys]
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


def baseline(name: str, env: CompiledEnv) -> Executor:
    """A policy that learned nothing: `random`, or the environment's own `heuristic`.

    Raises UserError if the environment has no heuristic.
    """
    if name == "random":
        return RandomExecutor(env.spec.action_space)
    heuristic = getattr(env, "heuristic", None)
    if heuristic is None:
        raise UserError(f"{env.spec.name} has no heuristic policy: use --policy random")
    return heuristic()
