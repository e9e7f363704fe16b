"""Rewards and ends: what they are predicted from, which rows count, and what follows an end."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.world_models.test_mabl import CONFIG, SPEC, some_rows

from mabl.losses.two_hot import N_BINS, two_hot_mean
from mabl.world_models.dreamer_v2 import DreamerV2
from mabl.world_models.heads import Predictions
from mabl.world_models.levels import Level, arriving
from mabl.world_models.loss import absorbing_loss, model_loss
from mabl.world_models.mabl import MABL
from mabl.world_models.mabl_sg import MABLSG
from mabl.world_models.mamba import MAMBA, CommunicationConfig
from mabl.world_models.sequences import followers, observe_sequence, predict_sequence

TRANSITION = replace(CONFIG, outcomes="transition", reward_input="both")


def mamba(spec, config, key):
    return MAMBA(spec, config, key, CommunicationConfig(n_layers=1, n_heads=2))


@pytest.mark.parametrize("make", [MABL, MABLSG, DreamerV2, mamba])
@pytest.mark.parametrize("outcomes", ["row", "transition"])
def test_outcomes_of_a_transition_know_the_action_and_not_what_the_row_shows(make, outcomes):
    config = replace(TRANSITION, outcomes=outcomes)
    model = make(SPEC, config, jax.random.key(0))

    @jax.jit
    def predicted(rows):
        latents, _ = observe_sequence(model, rows, jax.random.key(1))
        batch = jax.tree.map(lambda x: x[:, None], latents)
        return jax.tree.map(lambda x: x[:, 0], predict_sequence(model, batch, config))

    rows = some_rows(4)
    shown = rows._replace(obs=rows.obs.at[2].add(50.0), state=rows.state.at[2].add(50.0))
    done = rows._replace(prev_action=(rows.prev_action.at[2].add(1)) % 3)
    before, other_row, other_action = predicted(rows), predicted(shown), predicted(done)
    for name in ("reward", "terminated"):
        same = np.array_equal(getattr(before, name)[2], getattr(other_row, name)[2])
        assert same == (outcomes == "transition"), name
        assert not np.allclose(getattr(before, name)[2], getattr(other_action, name)[2]), name
    # Observation, availability, life and action are decoded from the row's own latent in any case.
    for name in ("obs", "available", "alive", "action"):
        assert not np.allclose(getattr(before, name)[2], getattr(other_row, name)[2]), name


def test_a_transition_has_z_of_the_row_before_and_h_of_the_row_after():
    before, after = (
        Level(jnp.full(2, h), model) for h, model in ((1.0, "z before"), (2.0, "z after"))
    )
    mixed = arriving({"a": before}, {"a": after})["a"]
    assert mixed.z == "z before" and (mixed.h == 2).all()


def test_rows_follow_unless_they_come_first_in_the_sequence_or_the_episode():
    is_first = jnp.array([[False, True], [False, False], [True, False]])
    assert_array_equal(followers(is_first), [[False, False], [True, True], [False, True]])


class Fixed(eqx.Module):
    """A model whose latent counts imagined steps and whose predictions are constant.

    Its prior differs from its posterior by a known KL in every row.
    """

    filter: None = None

    def initial(self):
        return jnp.zeros(3)

    def encode(self, row):
        return row.is_first

    def observe(self, latent, inputs, key, train=False):
        return jnp.zeros(3), {"level": self._logits(0.9), "team": self._logits(0.9)[0]}

    def prior(self, latent, key):
        return latent, {"level": self._logits(0.5), "team": self._logits(0.5)[0]}

    def imagine(self, latent, action, key):
        return latent + 1.0

    def predict(self, latent):
        return Predictions(
            obs=jnp.zeros((3, 4)),
            reward=2.0 * latent,
            agent_reward=None,
            terminated=jnp.zeros(3),
            available=jnp.zeros((3, 3)),
            alive=jnp.zeros(3),
            action=jnp.zeros((3, 3)),
        )

    def _logits(self, p):
        return jnp.broadcast_to(jnp.log(jnp.array([[p, 1 - p]])), (3, 1, 2))


def loss_of(rows, **options):
    config = replace(CONFIG, **options)
    metrics = model_loss(Fixed(), rows, jax.random.key(0), config, SPEC.action_space)[1]
    return {name.removeprefix("world_model/"): float(value) for name, value in metrics.items()}


def batched(*sequences):
    return jax.tree.map(lambda *x: jnp.stack(x), *sequences)


def test_the_kl_of_a_row_whose_past_is_unknown_does_not_count():
    kl = 0.9 * np.log(0.9 / 0.5) + 0.1 * np.log(0.1 / 0.5)
    # A sequence that begins with a reset: all four rows; one that begins in mid-episode: three.
    whole = loss_of(batched(some_rows(4)))
    cut = loss_of(batched(some_rows(4, first=())))
    for level in ("level", "team"):
        assert_allclose(whole[f"loss_kl_{level}"], kl, rtol=1e-5)
        assert_allclose(cut[f"loss_kl_{level}"], kl * 3 / 4, rtol=1e-5)


def test_outcomes_of_rows_that_follow_nothing_do_not_count():
    # Predicted is 0, real is 1 in each of four rows: Huber's loss is .5
    rows = some_rows(4, first=(2,))._replace(reward=jnp.ones((4, 3)))
    assert_allclose(loss_of(batched(rows))["loss_reward"], 0.5, rtol=1e-6)
    # Transitions to rows 1 and 3 count: row 0 has no row before, row 2 is a reset.
    masked = loss_of(batched(rows), outcomes="transition", overshooting=1.0)
    assert_allclose(masked["loss_reward"], 0.25, rtol=1e-6)
    assert_allclose(masked["loss_terminated"], np.log(2) / 2, rtol=1e-6)
    # They are one step ahead as they are
    assert "loss_ahead_reward" not in masked and "loss_ahead_terminated" not in masked
    assert "loss_ahead_alive" in masked


def test_past_the_first_true_end_reward_is_0_and_the_end_is_certain():
    ended = some_rows(5)._replace(terminated=jnp.zeros((5, 3), bool).at[2].set(True))
    partly = some_rows(5)._replace(terminated=jnp.zeros((5, 3), bool).at[2, 0].set(True))
    rows = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), batched(ended, partly))
    config = replace(CONFIG, absorbing=2, reward_weight=10.0, reward_loss="mse", end_weight=3.0)
    latents = jnp.zeros((5, 2, 3)).at[2].set(1.0)
    losses = absorbing_loss(Fixed(), latents, rows, jax.random.key(0), config, SPEC.action_space)
    # From latent 1 on to 2 and 3, which predict rewards of 4 and 6: squares 16 / 2 and 36 / 2, ten
    # times; the end's logit is 0: log 2 each, three times; over the 5 rows of the sequence.
    assert_allclose(losses[0], (10 * 26 + 3 * 2 * np.log(2)) / 5, rtol=1e-6)
    assert_array_equal(losses[1], 0.0)  # one of three agents has terminated: the episode goes on


def test_learning_what_follows_an_end_trains_heads_and_recurrences():
    config = replace(TRANSITION, absorbing=1)
    model = MABL(SPEC, config, jax.random.key(0))
    rows = some_rows(4)._replace(terminated=jnp.zeros((4, 3), bool).at[2].set(True))

    def past(model):
        metrics = model_loss(model, batched(rows), jax.random.key(0), config, SPEC.action_space)[1]
        return metrics["world_model/loss_absorbing"]

    gradient = eqx.filter_jit(eqx.filter_grad(past))(model).nets

    def moves(part):
        return max(float(jnp.abs(x).max()) for x in jax.tree.leaves(part)) > 0

    assert moves(gradient.heads.terminated) and moves(gradient.heads.full_reward)
    assert moves(gradient.filter.recurrent) and moves(gradient.global_recurrent)
    assert not moves(gradient.heads.obs)


@pytest.mark.parametrize("make", [MABL, MABLSG])
def test_with_posterior_conditioning_decoders_still_see_what_imagination_draws(make):
    models = [
        make(SPEC, replace(CONFIG, agent_prior_input=source), jax.random.key(0))
        for source in ("prior", "posterior")
    ]
    latent = jax.tree.map(
        lambda x: x[-1], observe_sequence(models[0], some_rows(3), jax.random.key(1))[0]
    )
    (drawn, logits), (same, conditioned) = (
        model.prior(latent, jax.random.key(2)) for model in models
    )
    jax.tree.map(assert_array_equal, drawn, same)
    assert_array_equal(logits["global"], conditioned["global"])
    assert not np.allclose(logits["agent"], conditioned["agent"])


@pytest.mark.parametrize("make", [MABL, MABLSG, DreamerV2, mamba])
@pytest.mark.parametrize("reward_input", ["agent", "both"])
def test_two_hot_rewards_are_the_mean_over_their_bins_and_are_learned(make, reward_input):
    config = replace(
        CONFIG,
        reward_loss="two_hot",
        outcomes="transition",
        reward_input=reward_input,
        overshooting=1.0,
    )
    model = make(SPEC, config, jax.random.key(0))
    # Each agent is paid 10 after its action 1, and nothing after others.
    rows = some_rows(12)
    paid = (rows.prev_action == 1) & ~rows.is_first[:, None]
    rows = rows._replace(reward=10.0 * paid)
    batch = jax.tree.map(lambda x: x[None], rows)

    @eqx.filter_jit
    def predicted(model):
        latents, _ = observe_sequence(model, rows, jax.random.key(1))
        one = jax.tree.map(lambda x: x[:, None], latents)
        return jax.tree.map(lambda x: x[:, 0], predict_sequence(model, one, config))

    before = predicted(model)
    assert before.reward_logits.shape == (12, 3, N_BINS)
    assert_allclose(before.reward, two_hot_mean(before.reward_logits), rtol=1e-4, atol=1e-5)
    has_two = reward_input == "both" and make in (MABL, MABLSG)
    assert (before.agent_reward_logits is not None) == has_two

    optimiser = optax.adam(1e-2)
    state = optimiser.init(eqx.filter(model, eqx.is_array))

    @eqx.filter_jit
    def learn(model, state, key):
        gradient, metrics = eqx.filter_grad(model_loss, has_aux=True)(
            model, batch, key, config, SPEC.action_space
        )
        step, state = optimiser.update(gradient, state)
        return eqx.apply_updates(model, step), state, metrics

    for i in range(200):
        model, state, metrics = learn(model, state, jax.random.key(i))
    after = predicted(model)
    follows = (~rows.is_first & (jnp.arange(12) > 0))[:, None]
    assert (paid & follows).any() and (~paid & follows).any()
    assert_allclose(after.reward[paid & follows], 10.0, atol=2.0)
    assert_allclose(after.reward[~paid & follows], 0.0, atol=1.0)
    assert metrics["world_model/rewards_beyond_bins"] == 0
