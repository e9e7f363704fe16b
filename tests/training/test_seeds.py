"""A seed alone, and the same seed in a batch."""

import shutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.tiny import tiny

from mabl import UserError, resume, train
from mabl.runs.checkpoint import Checkpoints, named
from mabl.runs.metrics import read
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


@pytest.fixture
def two_seeds(tmp_path):
    """`two_seeds(name, steps)` trains seeds 4 and 5 in one program; their folders.

    Episodes differ in length, so that seeds are at steps of their own when they are saved.
    """

    def run(name: str, total_steps: int) -> list:
        config = replace(
            tiny("mappo", "test/counting"),
            seed=4,
            num_seeds=2,
            total_steps=total_steps,
            logdir=str(tmp_path / name),
        )
        config = replace(config, training=replace(config.training, checkpoint_every=100))
        return train(config).folders

    return run


def without_time(path):
    rows = read(path)
    return [{k: v for k, v in row.items() if not k.startswith("time/")} for row in rows]


def test_seeds_of_one_program_go_on_in_one_as_if_never_stopped(two_seeds):
    """Though one of them was killed before its newest checkpoint was whole, or in its place."""
    whole, cut = two_seeds("whole", 600), two_seeds("cut", 300)
    first, second = (Checkpoints(path / "checkpoints") for path in cut)
    assert first.steps == second.steps and len(first.steps) == 2
    shutil.rmtree(second.at(second.steps[0]))
    resume(cut, 600)
    for one, other in zip(whole, cut, strict=True):
        assert without_time(one) == without_time(other)
        newest = [Checkpoints(p / "checkpoints") for p in (one, other)]
        files = [c.at(c.steps[0]) / "state.safetensors" for c in newest]
        assert files[0].read_bytes() == files[1].read_bytes()


def test_seeds_begin_together_where_none_has_a_checkpoint(two_seeds):
    whole, cut = two_seeds("whole", 300), two_seeds("cut", 300)
    for run in cut:
        shutil.rmtree(run / "checkpoints")
    resume(cut)
    for one, other in zip(whole, cut, strict=True):
        assert without_time(one) == without_time(other)


def test_what_was_not_one_program_is_not_resumed_as_one(two_seeds):
    short, long = two_seeds("short", 40), two_seeds("long", 60)
    with pytest.raises(UserError, match="another config than"):
        resume([short[0], long[1]])
    with pytest.raises(UserError, match="the same seed"):
        resume([short[0], short[0]])


def test_runs_without_a_checkpoint_in_common_keep_what_they_have(two_seeds):
    runs = two_seeds("one", 200)
    steps = [Checkpoints(path / "checkpoints").steps for path in runs]
    for k, path in enumerate(runs):
        checkpoints = Checkpoints(path / "checkpoints")
        for step in steps[k]:
            checkpoints.at(step).rename(checkpoints.at(step + k))
    with pytest.raises(UserError, match="resume them one by one"):
        resume(runs, 300)
    assert [len(Checkpoints(path / "checkpoints").steps) for path in runs] == [
        len(s) for s in steps
    ]
