from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mabl import replay as replays
from mabl.envs.counting import CountingEnv
from mabl.rows import TimeStep

CAPACITY, CHUNK, LENGTH, SAMPLES = 7, 4, 3, 1024
STALE = -7
"""What rows past a chunk's count hold: they must never be stored."""


def tagged(ids: np.ndarray) -> TimeStep:
    """Rows `[..., R]` whose every numeric field shows their id."""
    ids = np.asarray(ids)
    wide = np.broadcast_to(ids[..., None], (*ids.shape, 2))
    return TimeStep(
        prev_action=wide.astype(np.int32),
        reward=wide.astype(np.float32),
        terminated=wide % 3 == 0,
        truncated=ids % 5 == 0,
        obs=np.broadcast_to(wide[..., None], (*wide.shape, 3)).astype(np.float32),
        state=wide.astype(np.float32),
        available=np.ones((*wide.shape, 2), bool),
        alive=np.ones(wide.shape, bool),
        is_first=ids % 2 == 0,
        score=ids.astype(np.float32),
    )


def ids_of(rows: TimeStep) -> np.ndarray:
    """The ids of rows `[..., T]`, after checking that all fields agree on them."""
    rows = jax.device_get(rows)
    ids = rows.score.astype(int)
    jax.tree.map(assert_array_equal, rows, tagged(ids))
    return ids


@jax.jit
def add(replay: replays.Replay, rows: TimeStep, count: jax.Array) -> replays.Replay:
    return jax.vmap(replays.add)(replay, rows, count)


sample = jax.jit(replays.sample_sequences, static_argnums=(2, 3))


def empty(n_lanes: int) -> replays.Replay:
    row = jax.tree.map(jnp.asarray, tagged(np.int64(0)))
    return jax.vmap(lambda _: replays.empty(row, CAPACITY))(jnp.arange(n_lanes))


def filled(counts: list[tuple[int, ...]]) -> tuple[replays.Replay, list[list[int]]]:
    """A replay after adding `counts[step][lane]` rows at a time, and all ids ever added by lane.

    Ids of lane e are 100 e, 100 e + 1, ...
    """
    n_lanes = len(counts[0])
    replay, added = empty(n_lanes), [[] for _ in range(n_lanes)]
    for row in counts:
        chunk = np.full((n_lanes, CHUNK), STALE)
        for lane, count in enumerate(row):
            first = 100 * lane + len(added[lane])
            chunk[lane, :count] = range(first, first + count)
            added[lane] += list(range(first, first + count))
        replay = add(replay, tagged(chunk), np.array(row, np.int32))
    return jax.device_get(replay), added


def valid_sequences(added: list[list[int]]) -> set[tuple[int, ...]]:
    """All runs of LENGTH among the last CAPACITY rows of each lane."""
    kept = [lane[-CAPACITY:] for lane in added]
    return {tuple(lane[i : i + LENGTH]) for lane in kept for i in range(len(lane) - LENGTH + 1)}


# Three lanes always, so that everything compiles once; lanes may stay empty.
histories = st.integers(1, 3).flatmap(
    lambda used: st.lists(
        st.tuples(*[st.integers(0, CHUNK if lane < used else 0) for lane in range(3)]),
        min_size=1,
        max_size=8,
    )
)
tolerant = partial(settings, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@tolerant(max_examples=60)
@given(histories)
def test_the_ring_holds_the_last_rows_in_order(counts):
    replay, added = filled(counts)
    for lane, ids in enumerate(added):
        size, cursor = int(replay.size[lane]), int(replay.cursor[lane])
        assert size == min(len(ids), CAPACITY)
        assert cursor == len(ids) % CAPACITY
        rows = jax.tree.map(lambda x, lane=lane: x[lane], replay.rows)
        ring = [(cursor - size + i) % CAPACITY for i in range(size)]
        held = jax.tree.map(lambda x, ring=ring: x[np.array(ring, int)], rows)
        assert list(ids_of(held)) == ids[-CAPACITY:]


@tolerant(max_examples=60)
@given(histories, st.integers(0, 1000))
def test_sequences_are_exactly_the_contiguous_runs_of_rows_still_held(counts, seed):
    replay, added = filled(counts)
    valid = valid_sequences(added)
    assume(valid)
    sequences = ids_of(sample(replay, jax.random.key(seed), SAMPLES, LENGTH))
    # At most 15 runs: 1024 draws miss one of them with probability 1e-29.
    assert {tuple(map(int, ids)) for ids in sequences} == valid


def test_runs_are_drawn_uniformly_over_lanes_of_unequal_size():
    # 3 rows: one run; 7 + 2 rows: five runs; 2 rows: none
    replay, _ = filled([(3, 4, 2), (0, 4, 0), (0, 1, 0)])
    sequences = ids_of(sample(replay, jax.random.key(0), 12_000, LENGTH))
    starts, counts = np.unique(sequences[:, 0], return_counts=True)
    assert_array_equal(starts, [0, 102, 103, 104, 105, 106])
    # 2000 expected, standard deviation 41
    assert (abs(counts - 2000) < 5 * 41).all()


def test_a_sequence_may_be_as_long_as_the_ring():
    replay, _ = filled([(4,), (4,), (3,)])
    sequences = ids_of(sample(replay, jax.random.key(0), 5, CAPACITY))
    assert_array_equal(sequences, [[4, 5, 6, 7, 8, 9, 10]] * 5)


@pytest.mark.parametrize("recency", [1.0, 2.0, 4.0])
def test_recent_rows_are_drawn_more_often(recency):
    replay, added = filled([(4, 3), (4, 4), (3, 2)])  # both rings have gone round
    drawn = jax.jit(replays.sample_sequences, static_argnums=(2, 3, 4))
    ids = ids_of(drawn(replay, jax.random.key(0), 20_000, LENGTH, recency))
    assert (np.diff(ids, axis=1) == 1).all()  # never across the seam
    lane = ids[:, 0] // 100
    assert abs(lane.mean() - 0.5) < 0.02
    oldest = np.array([min(kept[-CAPACITY:]) for kept in added])
    counts = np.bincount(ids[:, 0] - oldest[lane], minlength=CAPACITY - LENGTH + 1) / len(ids)
    edges = np.linspace(0, 1, CAPACITY - LENGTH + 2) ** recency
    assert_allclose(counts, np.diff(edges), atol=0.015)


def test_sequences_cross_episodes():
    # Whole episodes of the counting environment are stored back to back, and drawn as they lie.
    env = CountingEnv()
    state, row = env.reset(jax.random.key(0))
    rows = [row]
    for _ in range(2):
        state, row = env.step(jax.random.key(0), state, jnp.zeros(2, jnp.int32))
        rows.append(row)
    chunk = jax.tree.map(lambda *x: jnp.stack(x), *rows)
    lane = replays.add(replays.empty(row, 6), chunk, jnp.int32(3))
    lane = replays.add(lane, chunk, jnp.int32(3))
    sequence = replays.sample_sequences(
        jax.tree.map(lambda x: x[None], lane), jax.random.key(0), 1, 6
    )
    assert_array_equal(sequence.state[0, :, 0], [0, 1, 2, 0, 1, 2])
    assert_array_equal(sequence.is_first[0], [True, False, False] * 2)
