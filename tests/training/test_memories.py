"""Memories of agents in mid-episode are those of the newest parameters."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from numpy.testing import assert_allclose, assert_array_equal
from tests.tiny import tiny

from mabl import replay as replays
from mabl.envs.counting import CountingEnv
from mabl.rollout import rollout, start
from mabl.rows import TimeStep
from mabl.training.loop import recalled_memory
from mabl.training.programs import build

ENV = CountingEnv()
LANES = 4


class Tally(NamedTuple):
    """Remembers `weight` times the sum of t + 1 over an episode's rows t; always plays 0."""

    weight: float

    def initial(self, row: TimeStep) -> Array:
        return jnp.zeros(row.obs.shape[0])

    def act(self, memory: Array, row: TimeStep, key: Array) -> tuple[Array, Array]:
        del key
        memory = jnp.where(row.is_first, 0.0, memory) + self.weight * (row.obs[:, 0] + 1)
        return memory, jnp.zeros(2, jnp.int32)


def collected(n_rows: int, n_cycles: int, capacity: int):
    """Lanes and their collectors after each of some cycles of executors with weight 1."""
    keys = jax.random.split(jax.random.key(0), LANES)
    collectors = jax.vmap(lambda key: start(ENV, Tally(1.0), key))(keys)
    lanes = jax.vmap(lambda c: replays.empty(c.row, capacity))(collectors)
    for cycle in range(n_cycles):
        keys = jax.random.split(jax.random.key(cycle + 1), LANES)
        collectors, landed = jax.jit(
            jax.vmap(lambda c, key: rollout(ENV, Tally(1.0), c, key, n_rows))
        )(collectors, keys)
        lanes = jax.vmap(replays.add)(lanes, landed.rows, landed.count)
        yield lanes, collectors


@pytest.mark.parametrize(
    ("length", "capacity"), [(3, 11), (3, 100), (8, 11), (8, 100), (5, 5), (8, 8)]
)
def test_a_memory_is_recalled_from_the_rows_before_the_newest_by_hand(length, capacity):
    """Weight 3 sums 3 (s + 1) over rows s of the episode before row t, `length` of them at most.

    Of a full lane one row less than its capacity comes before the newest.
    """
    seen, reach = set(), min(length, capacity - 1)
    for lanes, collectors in collected(n_rows=5, n_cycles=6, capacity=capacity):
        keys = jax.random.split(jax.random.key(9), LANES)
        recalled = jax.vmap(lambda *lane: recalled_memory(Tally(3.0), length, *lane))(
            lanes, collectors.row, keys
        )
        for lane in range(LANES):
            t = int(collectors.row.obs[lane, 0, 0])
            if t == 0:  # whatever it was, it is forgotten
                continue
            seen.add(t)
            expected = 3.0 * sum(s + 1 for s in range(max(t - reach, 0), t))
            assert_array_equal(recalled[lane], np.full(2, expected))
            if reach >= t:
                assert_array_equal(recalled[lane], 3 * collectors.memory[lane])
    assert {1, 2, 4, 5} <= seen


@pytest.mark.parametrize(
    "algo, whole_episodes, recalls",
    [
        ("mabl", False, True),
        ("mamba", False, True),
        ("mag", False, True),
        ("mabl-qmix", False, True),
        ("qmix", False, True),
        ("mabl", True, False),
        ("mappo", False, False),
    ],
)
def test_updates_change_memories(algo, whole_episodes, recalls):
    """But for collection by whole episodes, and MAPPO, which learns from memories as they were."""
    config = tiny(algo, "test/counting")
    if whole_episodes:
        config = replace(config, training=replace(config.training, collect_steps=None))
    training = build(config)
    n_model = 0 if algo in ("mappo", "qmix") else 2

    @jax.jit
    def run(key):
        state = training.init(key)
        for _ in range(2):
            state, _ = training.cycle(state, 0, 0, 1000)
        collectors, landed = training.collect(state.learner, state.collectors, jax.random.key(1))
        return [
            training.learn(state, collectors, landed, *n, 1000)[0].collectors.memory
            for n in ((0, 0), (n_model, 1))
        ]

    without, after = map(jax.tree.leaves, jax.device_get(run(jax.random.key(0))))
    same = [np.array_equal(a, b) for a, b in zip(without, after, strict=True)]
    assert all(same) != recalls


def test_without_updates_a_cycle_recalls_what_was_remembered():
    """QMIX's memory draws nothing, and holds the whole episode: at most 7 of its 8 rows."""
    training = build(tiny("qmix", "test/counting"))

    @jax.jit
    def run(state, key):
        collectors, landed = training.collect(state.learner, state.collectors, key)
        return collectors, training.learn(state, collectors, landed, 0, 0, 1000)[0]

    state, compared = jax.jit(training.init)(jax.random.key(0)), 0
    for number in range(4):
        collectors, state = run(state, jax.random.key(number))
        inside = np.flatnonzero(~collectors.row.is_first)
        compared += len(inside)
        for carried, recalled in zip(
            jax.tree.leaves(collectors.memory),
            jax.tree.leaves(state.collectors.memory),
            strict=True,
        ):
            assert np.abs(carried[inside]).max() > 0
            assert_allclose(recalled[inside], carried[inside], atol=1e-5)
    assert compared >= 4
