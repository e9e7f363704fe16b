"""Policy inputs with the decoded observation: values, gradients and dependence on teammates."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.world_models.test_mabl import SPEC, batched, some_rows
from tests.world_models.test_scales import MODELS, SCALED, SHIFTS, SIZES, rows_in

from mabl.world_models.dreamer_v2 import DreamerV2
from mabl.world_models.loss import model_loss
from mabl.world_models.mabl import MABL
from mabl.world_models.mabl_sg import MABLSG
from mabl.world_models.mamba import MAMBA
from mabl.world_models.sequences import observe_sequence, with_scales

DECODED = replace(SCALED, policy_input="decoded")


def latents_of(model, rows):
    return observe_sequence(model, rows, jax.random.key(1))[0]


@pytest.mark.parametrize("make", MODELS)
def test_policies_and_critics_see_the_prediction_in_standard_units(make):
    rows = rows_in(SIZES, SHIFTS)
    model = with_scales(make(SPEC, DECODED, jax.random.key(0)), rows)
    latents = latents_of(model, jax.tree.map(lambda x: x[0], rows))
    *_, decoded = jax.vmap(model.actor_features)(latents)
    assert decoded.shape == (60, 3, 4)
    mean, std = map(np.asarray, model.filter.scale.moments())
    predicted = jax.vmap(model.predict)(latents).obs
    assert_allclose(np.asarray(decoded) * std + mean, predicted, rtol=1e-3, atol=1e-2)
    assert_array_equal(jax.vmap(model.critic_features)(latents)[-1], decoded)
    plain = make(SPEC, SCALED, jax.random.key(0))
    assert len(plain.actor_features(plain.initial())) == 2


@pytest.mark.parametrize("make", MODELS)
def test_execution_shows_policies_what_training_shows_them(make):
    model = make(SPEC, DECODED, jax.random.key(0))
    latents = latents_of(model, some_rows(4))
    trained = jax.vmap(model.actor_features)(latents)[-1]
    memory = latents if isinstance(model, MAMBA) else getattr(latents, "agent", latents)
    one = model.filter.features
    executed = jax.vmap(one if isinstance(model, MAMBA) else jax.vmap(one))(memory)[-1]
    assert_allclose(executed, trained, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("make", MODELS)
def test_the_loss_of_observations_trains_the_filters_decoder(make):
    rows, config = batched(some_rows(4)), replace(DECODED, kl_weight=0.0)

    @eqx.filter_jit
    def gradient(model, weight):
        settings = replace(config, obs_weight=weight)
        return eqx.filter_grad(
            lambda m: model_loss(m, rows, jax.random.key(2), settings, SPEC.action_space)[0]
        )(model)

    model = make(SPEC, config, jax.random.key(0))
    for weight in (0.0, 1.0):
        found = gradient(model, weight)
        nets = found.filter.team.nets if isinstance(model, MAMBA) else found.filter
        moved = any(np.abs(x).max() > 0 for x in jax.tree.leaves(nets.decoder))
        assert moved == (weight > 0)


@pytest.mark.parametrize("make", [MABL, MABLSG, DreamerV2])
def test_an_agents_policy_depends_on_no_teammates_observation(make):
    model, rows = make(SPEC, DECODED, jax.random.key(0)), some_rows(5)
    others = rows._replace(obs=rows.obs.at[:, 1:].add(3.0), state=rows.state + 2.0)
    own = rows._replace(obs=rows.obs.at[:, 0].add(3.0))
    seen, same, other = (
        jax.vmap(model.actor_features)(latents_of(model, r))[-1][:, 0] for r in (rows, others, own)
    )
    assert_array_equal(seen, same)
    assert (jnp.abs(seen - other).max(-1) > 1e-3).all()
