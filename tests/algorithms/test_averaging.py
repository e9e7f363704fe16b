"""The model that acts and imagines may be a moving average of the one that is trained."""

import shutil
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.tiny import tiny

from mabl import resume, train
from mabl.algorithms.base import Experience
from mabl.errors import UserError
from mabl.runs.checkpoint import Checkpoints
from mabl.training.programs import build, programs

DECAY, UPDATES = 0.75, 3


@pytest.fixture(scope="module")
def learned():
    """Learners after 0 to `UPDATES` model updates, without and with averaging, and behaviour."""

    def run(averaging):
        config = tiny("mabl")
        config = replace(
            config,
            world_model=replace(config.world_model, averaging=averaging, standardise=True),
        )
        training = build(config)

        @jax.jit
        def go(key):
            state = training.init(key)
            collectors, collected = training.collect(state.learner, state.collectors, key)
            replay = training.store(state.replay, collected)
            experience = Experience(replay, collectors, collected)
            learners = [state.learner]
            for i in range(UPDATES):
                updated, _ = training.algorithm.update_model(
                    learners[-1], experience, jax.random.key(i)
                )
                learners.append(updated)
            behaved, _ = training.algorithm.update_policy(
                learners[-1], experience, jax.random.key(9)
            )
            alone = learners[-1]._replace(trained=None)
            same, _ = training.algorithm.update_policy(alone, experience, jax.random.key(9))
            return learners, behaved, same

        return training.algorithm, *go(jax.random.key(0))

    return {averaging: run(averaging) for averaging in (0.0, DECAY)}


def leaves_of(tree):
    return [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.inexact)]


def without_scales(learner):
    def strip(model):
        return eqx.tree_at(lambda m: (m.nets.filter.scale, m.nets.state_scale), model, (None, None))

    return learner._replace(model=strip(learner.model), trained=strip(learner.trained))


def test_gradients_are_those_of_the_trained_model(learned):
    """It goes the same way whether it is averaged or not."""
    _, plain, *_ = learned[0.0]
    _, averaged, *_ = learned[DECAY]
    assert all(learner.trained is None for learner in plain)
    for one, other in zip(plain, averaged, strict=True):
        for a, b in zip(leaves_of(one.model), leaves_of(other.trained), strict=True):
            assert_allclose(a, b, rtol=1e-4, atol=1e-6)


def test_the_average_by_hand(learned):
    """After n updates: d^n of the first parameters, and (1 - d) d^(n - i) of those after i.

    Scales of inputs, which begin with no weight, are the newest.
    """
    _, learners, *_ = learned[DECAY]
    newest = learners[-1]
    for model in (newest.model, newest.trained):
        assert (model.filter.scale.moments()[1] > 0).any()
    for scale in (lambda m: m.filter.scale, lambda m: m.state_scale):
        for a, b in zip(
            jax.tree.leaves(scale(newest.model)),
            jax.tree.leaves(scale(newest.trained)),
            strict=True,
        ):
            assert_array_equal(a, b)
    learners = [without_scales(learner) for learner in learners]
    weights = [DECAY**UPDATES] + [(1 - DECAY) * DECAY ** (UPDATES - i) for i in (1, 2, 3)]
    history = [leaves_of(learner.trained) for learner in learners]
    moved = 0
    for i, found in enumerate(leaves_of(learners[-1].model)):
        expected = sum(w * leaves[i] for w, leaves in zip(weights, history, strict=True))
        assert_allclose(found, expected, rtol=1e-4, atol=1e-6)
        moved += bool(abs(found - history[-1][i]).max() > 1e-6)
    assert moved > 10


def test_agents_act_and_imagine_with_the_average(learned):
    algorithm, learners, behaved, same = learned[DECAY]
    for a, b in zip(
        leaves_of(algorithm.policy(behaved).filter),
        leaves_of(learners[-1].model.filter),
        strict=True,
    ):
        assert_array_equal(a, b)
    for a, b in zip(leaves_of(behaved.behaviour), leaves_of(same.behaviour), strict=True):
        assert_array_equal(a, b)


def test_an_average_that_never_moves_is_refused():
    config = tiny("mabl")
    with pytest.raises(UserError, match=r"--world-model\.averaging is 1: give a number from 0 to"):
        replace(config.world_model, averaging=1)


def test_a_run_with_an_average_is_resumed_bit_for_bit(tmp_path):
    """MAG's learner holds a model-based one, average and all."""
    config = tiny("mag")
    config = replace(
        config,
        world_model=replace(config.world_model, averaging=DECAY),
        training=replace(config.training, checkpoint_every=200),
        total_steps=300,
        logdir=str(tmp_path),
    )
    (whole,) = train(config).folders
    cut = shutil.copytree(whole, tmp_path / "cut")
    last, first = Checkpoints(cut / "checkpoints").steps
    assert first < 300 <= last
    shutil.rmtree(Checkpoints(cut / "checkpoints").at(last))
    resume(cut)
    training = programs(config).training
    shape = jax.eval_shape(training.init, jax.random.key(0))
    one, other = (
        Checkpoints(folder / "checkpoints").restore("state", shape)[1].learner
        for folder in (whole, cut)
    )
    assert other.base.trained is not None
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert_array_equal(a, b)
