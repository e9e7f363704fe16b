"""The one loss that trains all world models (section 3.2)."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from mabl.envs.base import ActionSpace, Discrete
from mabl.losses.kl import balanced_kl, categorical_kl
from mabl.losses.two_hot import beyond_bins, two_hot_loss
from mabl.nets.categorical import still
from mabl.rows import TimeStep, is_last
from mabl.types import Metrics, PRNGKey
from mabl.world_models.base import WorldModel, WorldModelConfig
from mabl.world_models.heads import Predictions
from mabl.world_models.sequences import (
    OUTCOMES,
    Observed,
    followers,
    obs_std,
    observe_batch,
    predict_sequence,
    predict_step,
    state_std,
)


def model_loss(
    model: WorldModel,
    rows: TimeStep,
    key: PRNGKey,
    config: WorldModelConfig,
    action_space: ActionSpace,
) -> tuple[Float[Array, ""], Metrics]:
    """L(psi) = L_ELBO + L_reward + L_termination + L_available + L_action (section 3.2).

    L_ELBO = -log p(o^i | h^a, z^a) + KL(q(z^a | .) || p(z^a | .)) + KL(q(z^g | .) || p(z^g | .)),
    the KLs balanced (`losses/kl.py`); the other terms are those of `decoder_losses`. `rows` are
    `[B, T, ...]`. Losses are sums over features and means over B, T and N.

    A sequence may begin in the middle of an episode, whose past the model cannot know: its first
    row's KL does not count. With `config.overshooting` the decoders also see the latent that the
    prior predicts for each row from the row before, which imagination decodes and the KL alone
    trains; rows whose row before is unknown or of another episode do not count there. With
    `config.absorbing` the model also learns that nothing follows an end (`absorbing_loss`).
    """
    rows = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), rows)  # as the scan over time leaves them
    key_observe, key_absorbing = jax.random.split(key)
    observed = observe_batch(model, rows, key_observe, train=True)
    follows = followers(rows.is_first)[..., None]
    predicted = predict_sequence(model, observed.latents, config)
    units = obs_std(model), state_std(model)
    losses = decoder_losses(predicted, rows, config, action_space, *units)
    if config.outcomes == "transition":
        losses |= {name: follows * losses[name] for name in OUTCOMES if name in losses}
    if config.overshooting:
        ahead = jax.vmap(jax.vmap(model.predict))(observed.prior_latents)
        for name, loss in decoder_losses(ahead, rows, config, action_space, *units).items():
            if config.outcomes == "row" or name not in OUTCOMES:
                losses[f"ahead_{name}"] = config.overshooting * follows * loss
    known = follows | rows.is_first[..., None]
    for name, loss in kl_losses(observed, config).items():
        losses[name] = loss * (known if loss.ndim > 2 else known[..., 0])
    if config.absorbing:
        losses["absorbing"] = absorbing_loss(
            model, observed.latents, rows, key_absorbing, config, action_space
        )
    means = {name: loss.mean() for name, loss in losses.items()}
    total = jnp.stack(list(means.values())).sum()
    metrics = {f"world_model/loss_{name}": value for name, value in means.items()}
    metrics["world_model/loss"] = total
    if config.reward_loss == "two_hot":
        metrics["world_model/rewards_beyond_bins"] = beyond_bins(rows.reward)
    for level, posterior in observed.posterior.items():
        nats = categorical_kl(posterior, observed.prior[level]).sum(-1).mean()
        metrics[f"world_model/kl_{level}"] = nats
    return total, metrics


def absorbing_loss(
    model: WorldModel,
    latents: Any,
    rows: TimeStep,
    key: PRNGKey,
    config: WorldModelConfig,
    action_space: ActionSpace,
) -> Float[Array, "B N"]:
    """Losses of reward 0 and of termination on steps imagined past the end of an episode.

    The replay holds no row that follows an end: the next one is a reset. MAMBA stores absorbing
    rows instead. The first true end of each sequence `[T, B, ...]` is continued by
    `config.absorbing` random joint actions; losses are divided by T, so that a step past an end
    counts as much as a replayed row.
    """
    ended = rows.terminated.all(-1)
    length, batch = ended.shape
    first, there = ended.argmax(0), ended.any(0)
    start = jax.tree.map(lambda x: x[first, jnp.arange(batch)], latents)

    def past(latent: Any, key: PRNGKey) -> Float[Array, " N"]:
        def step(latent: Any, key: PRNGKey) -> tuple[Any, Float[Array, " N"]]:
            key_action, key_latent = jax.random.split(key)
            action = action_space.encode(random_action(action_space, rows, key_action))
            after = model.imagine(latent, action, key_latent)
            said = predict_step(model, latent, after, config)
            loss = config.reward_weight * reward_loss(
                said.reward, said.reward_logits, jnp.zeros_like(said.reward), config.reward_loss
            ) + config.end_weight * optax.sigmoid_binary_cross_entropy(
                said.terminated, jnp.ones_like(said.terminated)
            )
            return still(after), loss

        return jax.lax.scan(step, still(latent), jax.random.split(key, config.absorbing))[1].sum(0)

    losses = jax.vmap(past)(start, jax.random.split(key, batch))
    return there[:, None] * losses / length


def random_action(space: ActionSpace, rows: TimeStep, key: PRNGKey) -> Array:
    """A joint action at random, whether available or not."""
    shape = rows.prev_action.shape[2:]
    if isinstance(space, Discrete):
        return jax.random.randint(key, shape, 0, space.n)
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def kl_losses(observed: Observed, config: WorldModelConfig) -> dict[str, Float[Array, "T B *n"]]:
    """Balanced and weighted KL of each level."""
    return {
        f"kl_{level}": config.kl_weight
        * balanced_kl(
            posterior,
            observed.prior[level],
            config.kl_prior_weight,
            config.kl_posterior_weight,
            config.kl_reduction,
            config.free_nats,
        )
        for level, posterior in observed.posterior.items()
    }


def decoder_losses(
    predicted: Predictions,
    rows: TimeStep,
    config: WorldModelConfig,
    action_space: ActionSpace,
    obs_std: Float[Array, " O"] | float = 1.0,
    state_std: Float[Array, " S"] | float = 1.0,
) -> dict[str, Float[Array, "*b N"]]:
    """-log likelihoods of rows `[*b, ...]` under what is decoded from their latents, weighted.

    -log p(o^i | z^a, h^a), -log p(r^i | z^a, h^a), and -log p(. | z^a, z^g, h^a, h^g) of
    termination, availability and the action a^i_{t-1} (sections 3.1.2 and 3.2), and of life
    (ADR 9), and of the state where it is decoded. Observations and actions of the dead do not
    count, nor the action before a first row, nor wins on rows that do not end an episode. Errors of
    observations and of the state are in units of `obs_std` and `state_std`, by feature.
    """
    alive = rows.alive.astype(jnp.float32)
    acted = alive * ~rows.is_first[..., None]
    std = jnp.broadcast_to(obs_std, rows.obs.shape)
    losses = {
        "obs": config.obs_weight
        * (alive * optax.huber_loss(predicted.obs / std, rows.obs / std).sum(-1)),
        "reward": config.reward_weight
        * reward_loss(predicted.reward, predicted.reward_logits, rows.reward, config.reward_loss),
        "terminated": config.end_weight
        * optax.sigmoid_binary_cross_entropy(
            predicted.terminated, rows.terminated.astype(jnp.float32)
        ),
        "available": optax.sigmoid_binary_cross_entropy(
            predicted.available, rows.available.astype(jnp.float32)
        ).sum(-1),
        "alive": config.end_weight * optax.sigmoid_binary_cross_entropy(predicted.alive, alive),
        "action": acted * action_loss(predicted.action, rows.prev_action, action_space),
    }
    if predicted.state is not None:
        std = jnp.broadcast_to(state_std, predicted.state.shape)
        state = jnp.broadcast_to(rows.state[..., None, :], predicted.state.shape)
        error = optax.huber_loss(predicted.state / std, state / std)
        losses["state"] = config.state_weight * error.sum(-1)
    if predicted.win is not None:
        # An episode that was cut because its worker was lost has no score.
        known = (is_last(rows) & jnp.isfinite(rows.score))[..., None]
        won = jnp.broadcast_to(jnp.nan_to_num(rows.score)[..., None], alive.shape)
        losses["win"] = known * optax.sigmoid_binary_cross_entropy(predicted.win, won)
    if predicted.agent_reward is not None:
        weight = config.agent_reward_weight * config.reward_weight
        losses["agent_reward"] = weight * reward_loss(
            predicted.agent_reward,
            predicted.agent_reward_logits,
            rows.reward,
            config.reward_loss,
        )
    return losses


def reward_loss(
    predicted: Float[Array, "*b"],
    logits: Float[Array, "*b K"] | None,
    reward: Float[Array, "*b"],
    kind: str,
) -> Float[Array, "*b"]:
    """-log p(r | ...) up to a constant: Huber (smooth L1), Gaussian with unit variance, or the
    categorical over bins, if its `logits` predict the reward."""
    if logits is not None:
        return two_hot_loss(logits, reward)
    return {"huber": optax.huber_loss, "mse": optax.l2_loss}[kind](predicted, reward)


def action_loss(
    predicted: Float[Array, "*b A"], action: Array, space: ActionSpace
) -> Float[Array, "*b"]:
    """-log p(a_{t-1} | ...): cross-entropy, or Gaussian with unit variance up to a constant."""
    if isinstance(space, Discrete):
        return optax.softmax_cross_entropy_with_integer_labels(predicted, action)
    return optax.l2_loss(predicted, action).sum(-1)
