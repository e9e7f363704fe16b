"""The model buffer D: the last rows of each environment, sampled as uniform sequences.

Functions are written for one lane (one environment's rows, contiguous in time) and one call; the
caller vmaps over lanes. All of it lives on the device and inside the compiled training cycle.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from mabl.devices import spread
from mabl.types import PRNGKey


class Replay(NamedTuple):
    """A ring of rows; `[C, ...]` for one lane, `[E, C, ...]` for all."""

    rows: Any
    """`TimeStep`s, or a pytree that holds more of each step."""
    cursor: Int[Array, "*e"]
    """Where the next row goes."""
    size: Int[Array, "*e"]
    """Rows held."""


def _rows_in(rows: Any, axis: int = 0) -> int:
    """Length of an axis that all arrays of a pytree share."""
    return jax.tree.leaves(rows)[0].shape[axis]


def empty(row: Any, capacity: int) -> Replay:
    """A lane for `capacity` rows shaped like `row`."""
    rows = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), row)
    return Replay(rows, cursor=jnp.int32(0), size=jnp.int32(0))


def add(replay: Replay, rows: Any, count: Int[Array, ""]) -> Replay:
    """Append the first `count` of `rows` `[R, ...]`, overwriting the oldest."""
    capacity = _rows_in(replay.rows)
    offset = jnp.arange(_rows_in(rows))
    # Rows past `count` are sent out of bounds, where the scatter drops them.
    index = jnp.where(offset < count, (replay.cursor + offset) % capacity, capacity)
    return Replay(
        rows=jax.tree.map(lambda old, new: old.at[index].set(new, mode="drop"), replay.rows, rows),
        cursor=(replay.cursor + count) % capacity,
        size=jnp.minimum(replay.size + count, capacity),
    )


def cut(replay: Replay, truncated: Bool[Array, ""]) -> Replay:
    """Truncate the episode at the newest row, if there is one."""
    rows, newest = replay.rows, (replay.cursor - 1) % replay.rows.truncated.shape[0]
    was = rows.truncated[newest]
    now = rows.truncated.at[newest].set(was | (truncated & (replay.size > 0)))
    return replay._replace(rows=rows._replace(truncated=now))


def sample_sequences(
    replay: Replay, key: PRNGKey, batch_size: int, length: int, recency: float = 1.0
) -> Any:
    """Draw `[B, T, ...]` from all runs of `length` rows, over all lanes `[E, C, ...]`.

    With `recency` 1 all are equally likely; with p the newest of a lane is drawn p times as often
    as the average one, and one with a share x of the lane before it p x^(p-1) times.

    Sequences cross episode boundaries (`is_first` marks them) but never the ring's seam. Some lane
    must hold at least `length` rows.
    """
    capacity = _rows_in(replay.rows, axis=1)
    starts = jnp.maximum(replay.size - length + 1, 0)
    ends = jnp.cumsum(starts)
    key_pick, key_age = jax.random.split(key)
    pick = jax.random.randint(key_pick, (batch_size,), 0, ends[-1])
    lane = jnp.searchsorted(ends, pick, side="right")
    age = pick - (ends - starts)[lane]
    if recency != 1.0:
        share = jax.random.uniform(key_age, (batch_size,)) ** (1 / recency)
        age = jnp.minimum((share * starts[lane]).astype(age.dtype), starts[lane] - 1)
    oldest = (replay.cursor - replay.size)[lane]
    index = ((oldest + age)[:, None] + jnp.arange(length)[None]) % capacity
    return spread(jax.tree.map(lambda x: x[lane[:, None], index], replay.rows))
