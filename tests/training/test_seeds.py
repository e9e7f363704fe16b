"""A seed alone, and the same seed in a batch."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.tiny import tiny

from mabl.runs.checkpoint import named
from mabl.training.programs import programs

RTOL = 1e-4
"""Of parameters after five updates, or ten of a policy's minibatches."""


@pytest.mark.parametrize("algo", ["mabl", "mappo"])
def test_a_seed_alone_is_that_seed_in_a_batch(algo):
    """Sums are ordered differently, so to rounding. In time, a sample will turn out differently."""

    def after_learning(seeds, k):
        config = replace(tiny(algo), num_seeds=len(seeds))
        run = programs(config)
        states = run.init(jnp.stack([jax.random.key(seed) for seed in seeds]))
        with run.open_cycle(config) as cycle:
            states, _ = cycle(states, 0, 0)
            states, _ = cycle(states, 5 if algo == "mabl" else 0, 1)
        return jax.tree.map(lambda x: x[k], states)

    alone, in_batch = after_learning([7], 0), after_learning([6, 7, 8], 1)
    for name in ("obs", "reward", "prev_action", "is_first"):
        one, other = (getattr(state.replay.rows, name) for state in (alone, in_batch))
        np.testing.assert_array_equal(one, other, err_msg=name)
    other = dict(named(in_batch.learner))
    for name, leaf in named(alone.learner):
        if name.endswith("key.bias"):  # nothing depends on it: Adam follows rounding alone
            continue
        np.testing.assert_allclose(leaf, other[name], RTOL, 1e-5, err_msg=name)
