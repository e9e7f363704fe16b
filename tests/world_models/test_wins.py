"""The predictor of wins learns from ends alone, and its loss trains nothing else."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.world_models.test_mabl import CONFIG, SPEC, batched, some_rows
from tests.world_models.test_scales import MODELS

from mabl.world_models.loss import decoder_losses
from mabl.world_models.sequences import observe_batch, predict_sequence

SCORED = replace(SPEC, score_name="win_rate")


def rows_with_ends():
    """Row 2 is a win, row 5 is cut by the limit, and row 7 because a worker was lost."""
    rows = some_rows(8, first=(0, 3, 6))
    nan = jnp.nan
    return rows._replace(
        terminated=rows.terminated.at[2].set(True),
        truncated=rows.truncated.at[jnp.array([5, 7])].set(True),
        score=jnp.array([nan, nan, 1.0, nan, nan, 0.0, nan, nan]),
    )


@pytest.mark.parametrize("outcomes", ["row", "transition"])
@pytest.mark.parametrize("make", MODELS)
def test_it_learns_from_ends_and_trains_nothing_before_it(make, outcomes):
    rows = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), batched(rows_with_ends()))
    config = replace(CONFIG, outcomes=outcomes)
    model = make(SCORED, config, jax.random.key(0))

    @eqx.filter_jit
    def told(model):
        latents = observe_batch(model, rows, jax.random.key(1)).latents
        predicted = predict_sequence(model, latents, config)
        loss = decoder_losses(predicted, rows, config, SCORED.action_space)["win"]
        return loss.sum(), (loss, predicted.win)

    gradient, (loss, logit) = jax.device_get(eqx.filter_grad(told, has_aux=True)(model))
    logit = logit[:, 0]
    expected = np.zeros((8, 3))
    expected[2], expected[5] = np.log1p(np.exp(-logit[2])), np.log1p(np.exp(logit[5]))
    np.testing.assert_allclose(loss[:, 0], expected, rtol=1e-5)
    trained = {
        jax.tree_util.keystr(path)
        for path, leaf in jax.tree_util.tree_leaves_with_path(gradient)
        if np.abs(leaf).max() > 0
    }
    assert trained and all(".heads.win." in name for name in trained)


@pytest.mark.parametrize("make", MODELS)
def test_other_scores_are_not_predicted(make):
    model = make(SPEC, CONFIG, jax.random.key(0))
    rows = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), batched(some_rows(3)))
    latents = observe_batch(model, rows, jax.random.key(1)).latents
    predicted = predict_sequence(model, latents, CONFIG)
    assert predicted.win is None
    assert "win" not in decoder_losses(predicted, rows, CONFIG, SPEC.action_space)
