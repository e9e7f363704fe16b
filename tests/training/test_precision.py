"""In bfloat16 training goes on as in float32: its statistics agree."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from tests.tiny import tiny

from mabl.training.programs import programs

UPDATES = 40


def statistics(algo, precision):
    """Metrics of one update, and means over many."""
    config = replace(tiny(algo), precision=precision)
    run = programs(config)
    states = run.init(jax.random.key(0)[None])
    with run.open_cycle(config) as cycle:
        for _ in range(6):
            states, _ = cycle(states, 0, 0)
        states, first = cycle(states, 1, 1)
        states, after = cycle(states, UPDATES, 4)
    diagnosed = run.diagnose(states)
    return tuple(jax.device_get(found) for found in (first, after, diagnosed))


@pytest.mark.parametrize("algo", ["mabl", "mag", "mabl-qmix"])
def test_training_statistics_agree(algo):
    plain, rounded = (statistics(algo, precision) for precision in ("float32", "bfloat16"))

    def agree(name, i, tolerance, atol=0.0):
        a, b = float(plain[i][name][0]), float(rounded[i][name][0])
        assert a == pytest.approx(b, rel=tolerance, abs=atol), name
        assert a != b, f"{name}: nothing was rounded"

    names = [name for name in plain[0] if name.startswith("world_model/loss")]
    assert len(names) > 6
    # One update on the same rows with the same weights: but for samples that rounding tips over,
    # the same numbers.
    agree("world_model/loss", 0, 0.02)
    agree("world_model/gradient_norm", 0, 0.1)
    # Many updates: learned as well.
    agree("world_model/loss", 1, 0.05)
    for name in ("world_model/loss_obs", "world_model/loss_available"):
        agree(name, 1, 0.1)
    for name in (name for name in plain[1] if name.startswith("world_model/kl")):
        agree(name, 1, 0.5, 0.05)
    for found in (*plain, *rounded):
        assert all(np.isfinite(x).all() for name, x in found.items() if "episodes" not in name)
