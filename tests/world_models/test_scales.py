"""Standardised inputs: moments of what the living see, units, and no gradient to scales."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.world_models.test_mabl import CONFIG, SPEC, some_rows
from tests.world_models.test_outcomes import batched, mamba

from mabl.world_models.dreamer_v2 import DreamerV2
from mabl.world_models.loss import model_loss
from mabl.world_models.mabl import MABL
from mabl.world_models.mabl_sg import MABLSG
from mabl.world_models.sequences import obs_std, observe_sequence, with_scales

SCALED = replace(CONFIG, standardise=True, activation="rms_silu")
MODELS = [MABL, MABLSG, DreamerV2, mamba]
SIZES, SHIFTS = np.array([1.0, 10.0, 100.0, 0.5]), np.array([0.0, 5.0, -300.0, 1.0])


def rows_in(sizes, shifts, length=60):
    rows = some_rows(length)
    obs = jnp.asarray(np.asarray(rows.obs) * sizes + shifts, jnp.float32)
    return batched(rows._replace(obs=obs))


@pytest.mark.parametrize("make", MODELS)
def test_scales_are_the_moments_of_what_the_living_see(make):
    rows = rows_in(SIZES, SHIFTS)
    alive = rows.alive.at[:, ::2, 1].set(False)
    rows = rows._replace(alive=alive, obs=jnp.where(alive[..., None], rows.obs, 0.0))
    model = with_scales(make(SPEC, SCALED, jax.random.key(0)), rows)
    seen = np.asarray(rows.obs)[np.asarray(alive)]
    assert_allclose(model.filter.scale.mean, seen.mean(0), rtol=1e-3, atol=1e-3)
    assert_allclose(obs_std(model), seen.std(0), rtol=1e-3)
    if make in (MABL, MABLSG):
        state = np.asarray(rows.state).reshape(-1, SPEC.state_dim)
        assert_allclose(model.state_scale.mean, state.mean(0), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("make", MODELS)
def test_latents_and_losses_do_not_depend_on_units_and_predictions_are_in_them(make):
    def learned(rows):
        model = with_scales(make(SPEC, SCALED, jax.random.key(0)), rows)
        latents, logits = observe_sequence(
            model, jax.tree.map(lambda x: x[0], rows), jax.random.key(1)
        )
        loss = model_loss(model, rows, jax.random.key(2), SCALED, SPEC.action_space)[1]
        return logits["agent"], jax.vmap(model.predict)(latents).obs, loss["world_model/loss_obs"]

    plain, scaled = (eqx.filter_jit(learned)(rows_in(*by)) for by in ((1.0, 0.0), (SIZES, SHIFTS)))
    assert_allclose(plain[0], scaled[0], atol=2e-3)
    assert_allclose(np.asarray(plain[1]) * SIZES + SHIFTS, scaled[1], rtol=1e-3, atol=0.2)
    assert_allclose(plain[2], scaled[2], rtol=1e-3)


@pytest.mark.parametrize(
    ("make", "options"),
    [
        *((make, {}) for make in MODELS),
        *((make, {"policy_input": "observation", "recurrent_sees": "row"}) for make in MODELS[:3]),
    ],
)
def test_every_parameter_is_trained_and_no_scale(make, options):
    config = replace(SCALED, outcomes="transition", reward_input="both", overshooting=1.0)
    config = replace(config, **options)
    rows = rows_in(1.0, 0.0, 6)
    rows = rows._replace(obs=rows.obs * 3.0)
    model = with_scales(make(SPEC, config, jax.random.key(0)), rows)

    def loss(model):
        return model_loss(model, rows, jax.random.key(1), config, SPEC.action_space)[0]

    gradient = eqx.filter_jit(eqx.filter_grad(loss))(model)
    still = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(gradient)[0]:
        name = jax.tree_util.keystr(path)
        if "scale" in name and "layers" not in name and leaf.ndim < 2:
            assert not jnp.any(leaf), name
        elif not jnp.any(leaf):
            still.append(name)
    # The bias of attention's keys has no effect on a softmax.
    assert not [name for name in still if "key" not in name], still


def test_without_standardising_a_model_stays_as_it_is():
    model = MABL(SPEC, CONFIG, jax.random.key(0))
    assert with_scales(model, rows_in(SIZES, SHIFTS)) is model
    assert obs_std(model) == 1.0
