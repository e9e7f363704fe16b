"""Executor x environment -> rows. The only place where episodes end and begin."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mabl.envs.base import CompiledEnv, EnvState
from mabl.execution import Executor, Memory
from mabl.rows import TimeStep, is_last
from mabl.types import PRNGKey


class Collector(NamedTuple):
    """One environment in mid-flight: what a rollout needs to go on where the last one stopped."""

    env_state: EnvState
    row: TimeStep
    """The newest row; it has been emitted already."""
    memory: Memory
    episode_return: Float[Array, ""]
    """Mean over agents of the rewards so far in this episode."""
    episode_length: Int[Array, ""]
    """Joint steps so far in this episode."""


class Episodes(NamedTuple):
    """Episodes that ended in a rollout, row by row; other rows hold zeros."""

    ended: Bool[Array, " R"]
    episode_return: Float[Array, " R"]
    length: Int[Array, " R"]
    score: Float[Array, " R"]


class Rollout(NamedTuple):
    """`count` valid rows at the start of `rows` `[R, ...]`; the rest is padding."""

    rows: TimeStep
    episodes: Episodes
    count: Int[Array, ""]


def start(env: CompiledEnv, executor: Executor, key: PRNGKey) -> Collector:
    """A collector whose next row is a reset."""
    env_state, row = jax.tree.map(strong, env.reset(key))
    return Collector(
        env_state=env_state,
        row=row._replace(truncated=jnp.bool_(True)),
        memory=executor.initial(row),
        episode_return=jnp.float32(0),
        episode_length=jnp.int32(0),
    )


def strong(x: Array) -> Array:
    """Without JAX's weak type: what differs in it alone, as restored rows do, is traced anew."""
    return x if jnp.issubdtype(x.dtype, jax.dtypes.extended) else x.astype(x.dtype)


def row_keys(key: PRNGKey) -> Key[Array, "3"]:
    """For acting, stepping and resetting at one row."""
    return jax.random.split(key, 3)


def advance(
    env: CompiledEnv, executor: Executor, collector: Collector, key: PRNGKey
) -> tuple[Collector, Episodes]:
    """The next row: a step, or a reset if the newest row ended its episode."""
    key_act, key_step, key_reset = row_keys(key)
    row, over = collector.row, is_last(collector.row)
    memory, action = executor.act(collector.memory, row, key_act)
    stepped = env.step(key_step, collector.env_state, action)
    began = env.reset(key_reset)
    env_state, row = jax.tree.map(lambda a, b: strong(jnp.where(over, a, b)), began, stepped)
    collector = Collector(
        env_state=env_state,
        row=row,
        memory=memory,
        episode_return=jnp.where(over, 0.0, collector.episode_return + row.reward.mean()),
        episode_length=jnp.where(over, 0, collector.episode_length + 1),
    )
    ended = is_last(row)
    return collector, Episodes(
        ended=ended,
        episode_return=jnp.where(ended, collector.episode_return, 0.0),
        length=jnp.where(ended, collector.episode_length, 0),
        score=jnp.where(ended, row.score, 0.0),
    )


def rollout(
    env: CompiledEnv,
    executor: Executor,
    collector: Collector,
    key: PRNGKey,
    n_rows: int,
    one_episode: bool = False,
) -> tuple[Collector, Rollout]:
    """Collect `n_rows` rows from one environment, or fewer if `one_episode` ends before."""
    buffer = jax.tree.map(
        lambda x: jnp.zeros((n_rows, *x.shape), x.dtype),
        jax.eval_shape(lambda c: (c.row, advance(env, executor, c, key)[1]), collector),
    )

    def unfinished(carry: tuple) -> Array:
        count, collector, _ = carry
        more = count < n_rows
        if one_episode:
            more &= (count == 0) | ~is_last(collector.row)
        return more

    def body(carry: tuple) -> tuple:
        count, collector, buffer = carry
        collector, episodes = advance(env, executor, collector, jax.random.fold_in(key, count))
        buffer = jax.tree.map(lambda xs, x: xs.at[count].set(x), buffer, (collector.row, episodes))
        return count + 1, collector, buffer

    count, collector, (rows, episodes) = jax.lax.while_loop(
        unfinished, body, (jnp.int32(0), collector, buffer)
    )
    return collector, Rollout(rows, episodes, count)
