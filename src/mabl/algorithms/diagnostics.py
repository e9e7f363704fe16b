"""Diagnostics of a world model, and of values of its latents, on replayed rows."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from mabl.envs.base import ActionSpace
from mabl.nets.categorical import still
from mabl.rows import TimeStep, is_last
from mabl.types import Metrics, PRNGKey
from mabl.world_models.base import WorldModel, WorldModelConfig, with_life
from mabl.world_models.heads import Predictions
from mabl.world_models.sequences import followers, predict_sequence, predict_step

L = TypeVar("L")
T = TypeVar("T")

OPEN_LOOP_STEPS = (1, 5, 15)
DIAGNOSED_ROWS = max(OPEN_LOOP_STEPS) + 5
"""Rows of the sequences that diagnostics look at."""
WARM_UP = 5
"""Rows after which a latent is taken to know the past."""


def diagnose(
    model: WorldModel[L],
    latents: L,
    rows: TimeStep,
    key: PRNGKey,
    action_space: ActionSpace,
    config: WorldModelConfig,
) -> Metrics:
    """Diagnostics on real sequences `[B, T]`, T > 15, and their posterior latents.

    `posterior` metrics decode the latent that has seen the row (rewards and terminations: what
    `config.outcomes` says); `prior` ones the latent predicted for it one step before. Open-loop
    errors predict k steps ahead from real actions alone, and are relative: 1 is as bad as always
    predicting the mean, 0 is perfect. Everything stays within episodes; observations are those of
    the living.
    """
    everywhere = jnp.ones_like(rows.alive)
    outcomes = everywhere
    if config.outcomes == "transition":
        outcomes = everywhere & swapped(followers(swapped(rows.is_first)))[..., None]
    posterior = swapped(predict_sequence(model, swapped(latents), config))
    wins = jnp.nan_to_num(rows.score) > 0
    metrics = {
        "world_model/reconstruction": masked_mean(
            optax.squared_error(posterior.obs, rows.obs).mean(-1), rows.alive
        ),
        "world_model/obs_unexplained_posterior": unexplained(posterior.obs, rows.obs, rows.alive),
        "world_model/reward_unexplained_posterior": unexplained(
            posterior.reward[..., None], rows.reward[..., None], outcomes
        ),
        "world_model/reward_on_wins": masked_mean(posterior.reward.mean(-1), wins),
        "world_model/reward_on_wins_real": masked_mean(rows.reward.mean(-1), wins),
        "world_model/terminated_accuracy": masked_mean(
            (posterior.terminated > 0) == rows.terminated, outcomes
        ),
        "world_model/available_accuracy": ((posterior.available > 0) == rows.available).mean(),
    }
    ahead = open_loop(model, latents, rows, key, action_space, config, max(OPEN_LOOP_STEPS))
    ahead_reward, reward = ahead.reward[..., None], rows.reward[..., None]
    for k in OPEN_LOOP_STEPS:
        metrics[f"world_model/open_loop_obs_{k}"] = open_loop_error(
            ahead.obs, rows.obs, rows.alive, rows, k
        )
        metrics[f"world_model/open_loop_reward_{k}"] = open_loop_error(
            ahead_reward, reward, everywhere, rows, k
        )
    metrics["world_model/reward_unexplained_prior"] = metrics["world_model/open_loop_reward_1"]
    return metrics


def value_metrics(
    model: WorldModel[L],
    value: Callable[[L, TimeStep], Float[Array, ""]],
    latents: L,
    rows: TimeStep,
    key: PRNGKey,
    action_space: ActionSpace,
    reward_scale: float,
) -> Metrics:
    """Values of posterior latents `[B, T]` at resets, and how much higher imagined ones are valued.

    `behaviour/value_gap` is the mean of V(prior latent) - V(posterior latent) of the same row, the
    prior's drawn one step ahead with the real action. Above 0, the critic promises more of
    imagination than of the world. A row counts if the one before has `WARM_UP` rows of the
    sequence, or a reset, before it: else the latent does not know its past. Both metrics are in the
    environment's units.
    """

    def ahead(latent: L, row: TimeStep, key: PRNGKey) -> Float[Array, ""]:
        latent = model.imagine(latent, action_space.encode(row.prev_action), key)
        return value(with_life(model, latent, row.alive), row)

    values = jax.vmap(jax.vmap(value))(latents, rows)
    before, after = (
        jax.tree.map(lambda x: x[:, :-1], latents),
        jax.tree.map(lambda x: x[:, 1:], rows),
    )
    keys = jax.random.split(key, after.is_first.shape)
    gap = jax.vmap(jax.vmap(ahead))(before, after, keys) - values[:, 1:]
    warm = jnp.arange(rows.is_first.shape[1]) >= WARM_UP
    known = warm[None] | (jnp.cumsum(rows.is_first, axis=1) > 0)
    counted = known[:, :-1] & ~after.is_first & ~is_last(after)
    return {
        "behaviour/value_at_reset": masked_mean(values, rows.is_first) / reward_scale,
        "behaviour/value_gap": masked_mean(gap, counted) / reward_scale,
    }


def swapped(tree: T) -> T:
    """The two leading axes of all arrays exchanged: batch and time."""
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), tree)


def open_loop(
    model: WorldModel,
    latents: object,
    rows: TimeStep,
    key: PRNGKey,
    action_space: ActionSpace,
    config: WorldModelConfig,
    steps: int,
) -> Predictions:
    """Predictions `[K, B, T - K, N, ...]`: entry (k, b, t) is for row t + k + 1, from row t."""
    batch, length = rows.is_first.shape
    n_starts = length - steps
    actions = action_space.encode(rows.prev_action)

    def one(latent: object, actions: Array, key: PRNGKey) -> Predictions:
        def step(latent: object, at: tuple[Array, PRNGKey]) -> tuple[object, Predictions]:
            after = model.imagine(latent, *at)
            return after, predict_step(model, latent, after, config)

        return jax.lax.scan(step, latent, (actions, jax.random.split(key, steps)))[1]

    windows = jnp.arange(n_starts)[:, None] + jnp.arange(1, steps + 1)[None]
    return jax.vmap(jax.vmap(one, out_axes=1), out_axes=1)(
        jax.tree.map(lambda x: x[:, :n_starts], still(latents)),
        actions[:, windows],
        jax.random.split(key, (batch, n_starts)),
    )


def open_loop_error(
    predicted: Float[Array, "K B W N F"],
    real: Float[Array, "B T N F"],
    mask: Bool[Array, "B T N"],
    rows: TimeStep,
    k: int,
) -> Float[Array, ""]:
    """Squared error k steps ahead over the variance of the target, within episodes and `mask`."""
    n_starts = predicted.shape[2]
    target, mask = real[:, k : k + n_starts], mask[:, k : k + n_starts]
    resets = jnp.cumsum(rows.is_first, axis=1)
    same_episode = resets[:, k : k + n_starts] == resets[:, :n_starts]
    return unexplained(predicted[k - 1], target, mask & same_episode[..., None])


def unexplained(
    predicted: Float[Array, "B T N F"], real: Float[Array, "B T N F"], mask: Bool[Array, "B T N"]
) -> Float[Array, ""]:
    """Share of the target's variance that the prediction leaves: 1 - R^2."""
    weight = jnp.broadcast_to(mask[..., None], real.shape).astype(jnp.float32)
    total = weight.sum((0, 1), keepdims=True) + 1e-8
    mean = (weight * real).sum((0, 1), keepdims=True) / total
    return (weight * (predicted - real) ** 2).sum() / ((weight * (real - mean) ** 2).sum() + 1e-8)


def masked_mean(values: Float[Array, "..."], mask: Bool[Array, "..."]) -> Float[Array, ""]:
    """Mean where the mask holds; NaN where it never does."""
    return (values * mask).sum() / mask.sum()
