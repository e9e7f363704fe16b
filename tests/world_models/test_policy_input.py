"""Inputs of policies and recurrent models from rows: values, gradients, decentralisation."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.world_models.test_mabl import SPEC, batched, some_rows
from tests.world_models.test_outcomes import mamba
from tests.world_models.test_scales import MODELS, SCALED, SHIFTS, SIZES, rows_in

from mabl.errors import UserError
from mabl.nets.categorical import still
from mabl.world_models.dreamer_v2 import DreamerV2
from mabl.world_models.levels import Level
from mabl.world_models.loss import decoder_losses, model_loss
from mabl.world_models.mabl import MABL
from mabl.world_models.mabl_sg import MABLSG
from mabl.world_models.mamba import MAMBA
from mabl.world_models.sequences import observe_sequence, with_scales

DECODED = replace(SCALED, policy_input="decoded")
OBSERVED = replace(SCALED, policy_input="observation")
ROWS = replace(OBSERVED, recurrent_sees="row", decoded_share=0.5)
LEVELS = [MABL, MABLSG, DreamerV2]
"""Models whose levels can hold rows."""


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


@pytest.mark.parametrize("config", [DECODED, OBSERVED, ROWS])
@pytest.mark.parametrize("make", LEVELS)
def test_an_agents_policy_depends_on_no_teammates_observation(make, config):
    model, rows = make(SPEC, config, jax.random.key(0)), some_rows(5)
    others = rows._replace(obs=rows.obs.at[:, 1:].add(3.0), state=rows.state + 2.0)
    own = rows._replace(obs=rows.obs.at[:, 0].add(3.0))
    seen, same, other = (
        jax.vmap(model.actor_features)(latents_of(model, r))[-1][:, 0] for r in (rows, others, own)
    )
    assert_array_equal(seen, same)
    assert (jnp.abs(seen - other).max(-1) > 1e-3).all()


def agent_level(latent):
    return getattr(latent, "agent", latent)


def levels_of(latent):
    return [latent] if isinstance(latent, Level) else list(latent)


@pytest.mark.parametrize("make", LEVELS)
def test_policies_see_the_real_observation_at_real_rows_and_the_decoded_one_at_imagined_ones(make):
    batch = rows_in(SIZES, SHIFTS)
    model = with_scales(make(SPEC, OBSERVED, jax.random.key(0)), batch)
    rows = jax.tree.map(lambda x: x[0], batch)
    latents = latents_of(model, rows)
    (seen,) = jax.vmap(model.actor_features)(latents)
    mean, std = map(np.asarray, model.filter.scale.moments())
    assert_allclose(np.asarray(seen) * std + mean, rows.obs, rtol=1e-3, atol=1e-2)
    assert_array_equal(jax.vmap(model.critic_features)(latents)[-1], seen)

    last = jax.tree.map(lambda x: x[-1], latents)
    imagined = model.imagine(last, jnp.eye(3), jax.random.key(2))
    (seen,) = model.actor_features(imagined)
    assert_allclose(seen, jax.vmap(model.filter.decoded)(agent_level(imagined))[0], rtol=1e-5)
    predicted = model.predict(imagined).obs
    assert_allclose(np.asarray(seen) * std + mean, predicted, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("make", [MABL, MABLSG])
def test_critics_see_the_state_where_global_levels_hold_it(make):
    batch = rows_in(SIZES, SHIFTS)
    model = with_scales(make(SPEC, ROWS, jax.random.key(0)), batch)
    rows = jax.tree.map(lambda x: x[0], batch)
    latents = latents_of(model, rows)
    *_, obs, state = jax.vmap(model.critic_features)(latents)
    assert obs.shape == (60, 3, 4) and state.shape == (60, 3, 5)
    mean, std = map(np.asarray, model.state_scale.moments())
    for agent in range(3):
        assert_allclose(np.asarray(state[:, agent]) * std + mean, rows.state, rtol=1e-3, atol=1e-3)
    last = jax.tree.map(lambda x: x[-1], latents)
    imagined = model.imagine(last, jnp.eye(3), jax.random.key(2))
    state = np.asarray(model.critic_features(imagined)[-1])
    assert_allclose(state * std + mean, model.predict(imagined).state, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("make", LEVELS)
def test_predictions_come_from_z_and_h_and_never_from_the_row_held(make):
    """Otherwise a model would learn to copy the row that it should decode."""
    model = make(SPEC, ROWS, jax.random.key(0))
    latent = jax.tree.map(lambda x: x[1], latents_of(model, some_rows(2)))

    def changed(level):
        return level._replace(row=level.row + 1.0)

    other = type(latent)(*map(changed, latent)) if make is not DreamerV2 else changed(latent)
    said, other_said = model.predict(latent), model.predict(other)
    for a, b in zip(jax.tree.leaves(said), jax.tree.leaves(other_said), strict=True):
        assert_array_equal(a, b)
    # The next row depends on it.
    after, other_after = (model.imagine(x, jnp.eye(3), jax.random.key(0)) for x in (latent, other))
    for a, b in zip(levels_of(after), levels_of(other_after), strict=True):
        assert jnp.abs(a.h - b.h).max() > 1e-3


@pytest.mark.parametrize("make", [MABL, MABLSG])
def test_the_loss_of_the_state_trains_its_decoder_and_the_global_level(make):
    rows = batched(some_rows(4))

    @eqx.filter_jit
    def gradient(model, weight):
        settings = replace(
            ROWS,
            kl_weight=0.0,
            state_weight=weight,
            obs_weight=0.0,
            reward_weight=0.0,
            end_weight=0.0,
        )
        return eqx.filter_grad(
            lambda m: model_loss(m, rows, jax.random.key(2), settings, SPEC.action_space)[0]
        )(model)

    # Without decoded rows, through which other losses reach the decoder.
    model = make(SPEC, replace(ROWS, decoded_share=0.0), jax.random.key(0))
    found = gradient(model, 1.0)
    for part in (found.nets.state_decoder, found.nets.global_posterior):
        assert any(np.abs(x).max() > 0 for x in jax.tree.leaves(part))
    none = gradient(model, 0.0).nets.state_decoder
    assert all(np.abs(x).max() == 0 for x in jax.tree.leaves(none))


def test_the_error_of_the_state_is_half_its_square_in_standard_units():
    model = MABL(SPEC, ROWS, jax.random.key(0))
    rows = some_rows(2)
    latents = latents_of(model, rows)
    predicted = jax.vmap(model.predict)(latents)
    std = jnp.arange(1.0, 6.0)
    exact = predicted._replace(state=rows.state[:, None].repeat(3, 1) + 0.5 * std[None, None])
    losses = decoder_losses(exact, rows, replace(ROWS, state_weight=3.0), SPEC.action_space, 1, std)
    assert_allclose(losses["state"], jnp.full((2, 3), 3.0 * 5 * 0.125), rtol=1e-5)


@pytest.mark.parametrize("share", [0.0, 1.0])
@pytest.mark.parametrize("make", LEVELS)
def test_in_training_recurrent_models_see_decoded_rows_at_a_share_of_the_real_ones(make, share):
    config = replace(ROWS, decoded_share=share)
    model, rows = make(SPEC, config, jax.random.key(0)), some_rows(3)
    moved = rows._replace(obs=rows.obs.at[1].add(1.0), state=rows.state.at[1].add(1.0))

    def h_of_the_last_row(rows, train):
        # The same z and h for all: rows reach h through what recurrent models see of them alone.
        latent = jax.tree.map(lambda x: x[0], observe_sequence(model, rows, jax.random.key(1))[0])
        encoded = jax.vmap(model.encode)(rows)
        row = jax.tree.map(lambda x: x[1], encoded)
        latent = model.observe(latent, row, jax.random.key(2), train=train)[0]
        levels = [latent] if make is DreamerV2 else list(latent)
        levels = [x._replace(z=y.z) for x, y in zip(levels, zeroed(levels), strict=True)]
        latent = levels[0] if make is DreamerV2 else type(latent)(*levels)
        row = jax.tree.map(lambda x: x[2], encoded)
        return model.observe(latent, row, jax.random.key(3), train=train)[0]

    def zeroed(levels):
        return [jax.tree.map(jnp.zeros_like, level) for level in levels]

    for train in (False, True):
        a, b = (h_of_the_last_row(x, train) for x in (rows, moved))
        seen = not (train and share == 1.0)
        for x, y in zip(levels_of(a), levels_of(b), strict=True):
            assert (np.abs(x.h - y.h).max() > 1e-4) == seen


@pytest.mark.parametrize("make", LEVELS)
def test_what_is_imagined_past_an_end_trains_no_decoder_and_no_prior(make):
    """Check that gradients stop at imagined codes and at the rows that they decode to."""
    config = replace(ROWS, decoded_share=0.0, outcomes="transition", absorbing=2)
    model = make(SPEC, config, jax.random.key(0))
    rows = some_rows(4)._replace(terminated=jnp.zeros((4, 3), bool).at[2].set(True))

    def past(model):
        metrics = model_loss(model, batched(rows), jax.random.key(0), config, SPEC.action_space)[1]
        return metrics["world_model/loss_absorbing"]

    gradient = eqx.filter_jit(eqx.filter_grad(past))(model)
    nets = getattr(gradient, "nets", gradient)
    unmoved = [nets.filter.decoder, nets.agent_prior]
    if make is not DreamerV2:
        unmoved += [nets.state_decoder, nets.global_prior]
    for leaf in jax.tree.leaves(unmoved):
        assert_array_equal(leaf, 0.0)
    moved = [nets.filter.recurrent, nets.heads.terminated]
    assert all(any(np.abs(x).max() > 0 for x in jax.tree.leaves(part)) for part in moved)


@pytest.mark.parametrize("make", LEVELS)
def test_the_filter_alone_infers_what_training_infers(make):
    """Also across a reset. Samples, whose keys differ, are those of training."""
    model, rows = make(SPEC, ROWS, jax.random.key(0)), some_rows(6, first=(0, 3))
    trained = agent_level(latents_of(model, rows))
    action = SPEC.action_space.encode(rows.prev_action)
    for agent in range(3):
        level = model.filter.initial()
        for t in range(6):
            first = bool(rows.is_first[t])
            level = model.filter.initial() if first else level
            before = jnp.zeros(3) if first else action[t, agent]
            level = model.filter(level, before, rows.obs[t, agent], jax.random.key(t))
            expected = jax.tree.map(lambda x, t=t, i=agent: x[t, i], trained)
            assert_allclose(level.h, expected.h, rtol=1e-4, atol=1e-5)
            assert_allclose(level.row, expected.row, rtol=1e-4, atol=1e-5)
            level = level._replace(z=still(expected.z))


def test_decoded_rows_for_recurrent_models_that_see_none_are_refused():
    with pytest.raises(UserError, match=r"decoded-share is 0\.5, and recurrent models see no rows"):
        replace(OBSERVED, decoded_share=0.5)


@pytest.mark.parametrize("options", [{"policy_input": "observation"}, {"recurrent_sees": "row"}])
def test_mamba_whose_agents_communicate_refuses_rows_in_latents(options):
    with pytest.raises(UserError, match="not for mamba and mag"):
        mamba(SPEC, replace(SCALED, **options), jax.random.key(0))
