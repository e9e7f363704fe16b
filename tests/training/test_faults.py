"""What a run does with numbers that are not finite, and with disks that take no more."""

import errno

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from tests.tiny import flags, tiny

from mabl.algorithms.registry import ALGORITHMS
from mabl.envs import registry
from mabl.envs.counting import CountingEnv
from mabl.errors import UserError
from mabl.nets.optimiser import guarded, guards
from mabl.runs.checkpoint import Checkpoints, named
from mabl.training.faults import disks_explained
from mabl.training.loop import repeat
from mabl.training.programs import programs


def test_an_update_is_traced_once_and_metrics_are_means():
    traced = []

    def update(carry, key):
        traced.append(key)
        return carry + 1, {"carry": carry}

    go = jax.jit(lambda n: repeat(update, jnp.float32(5), jax.random.key(0), n))
    carry, metrics = go(3)
    assert len(traced) == 1
    assert carry == 8 and metrics["carry"] == (5 + 6 + 7) / 3


def test_a_gradient_that_is_not_finite_changes_nothing_and_is_counted():
    plain, optimiser = optax.adam(0.1), guarded(optax.adam(0.1))
    parameters = {"w": jnp.arange(3.0), "b": jnp.float32(1)}
    expected, ours = plain.init(parameters), optimiser.init(parameters)
    counts = []
    for bad in (None, jnp.nan, jnp.inf, None, jnp.nan):
        gradient = {"w": jnp.array([1.0, -2.0, 0.5]), "b": jnp.float32(3)}
        if bad is None:
            step, expected = plain.update(gradient, expected)
        else:
            step = jax.tree.map(jnp.zeros_like, gradient)
            gradient["w"] = gradient["w"].at[1].set(bad)
        mine, ours = optimiser.update(gradient, ours)
        jax.tree.map(np.testing.assert_array_equal, mine, step)
        jax.tree.map(np.testing.assert_array_equal, ours.inner, expected)
        counts.append((int(ours.skipped), int(ours.in_a_row)))
    assert counts == [(0, 0), (1, 1), (2, 2), (2, 0), (3, 1)]
    assert list(guards({"a": [ours], "b": expected})) == ["a.0"]


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_optimiser_of_an_algorithm_is_guarded(algo):
    """Adam's state lies in a guard, always."""
    training = programs(tiny(algo)).training
    names = [name for name, _ in named(jax.eval_shape(training.init, jax.random.key(0)).learner)]
    assert [name for name in names if name.endswith(".in_a_row")]
    assert all(".inner." in name for name in names if name.endswith((".count", ".mu", ".nu")))


class BrokenEnv(CountingEnv):
    """Gives agent 1 a reward that is not finite, on the third step of some episodes."""

    def step(self, key, env_state, action):
        state, row = super().step(key, env_state, action)
        bad = (state.t == 3) & (state.episode % 10 == 0)
        return state, row._replace(reward=row.reward.at[1].set(jnp.where(bad, jnp.inf, 0)))


def test_an_environment_that_gives_no_numbers_ends_the_run(mabl, monkeypatch, tmp_path):
    broken = {"test/counting": registry.Entry(BrokenEnv, "")}
    monkeypatch.setitem(registry.FAMILIES, "test", lambda: broken)
    given = flags("mappo", "test/counting")
    code, _, err = mabl("train", *given, "--total-steps=5000", f"--logdir={tmp_path}")
    assert code == 2 and "Traceback" not in err
    assert "gave reward = inf for agent 1 in environment" in err
    assert "mabl check-env looks at it" in err


def test_a_disk_that_takes_no_more_is_said_with_what_is_kept(tmp_path):
    checkpoints = Checkpoints.to_write(tmp_path / "checkpoints", 2)
    for expected in ("no checkpoint was written", "its checkpoint at 7 is kept"):
        said = rf"cannot write here \(full\); {expected}"
        with pytest.raises(UserError, match=said), disks_explained([checkpoints]):
            raise OSError(errno.ENOSPC, "full", "here")
        checkpoints.save(7, {}, {})
    with pytest.raises(OSError, match="gone"), disks_explained([checkpoints]):
        raise OSError(errno.ENOENT, "gone")
