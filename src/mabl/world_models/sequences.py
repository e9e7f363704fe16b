"""World models on real sequences: posteriors, priors and predictions of every row."""

from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mabl.nets.normaliser import Normaliser
from mabl.rows import TimeStep
from mabl.types import PRNGKey
from mabl.world_models.base import WorldModel, WorldModelConfig
from mabl.world_models.heads import Predictions
from mabl.world_models.levels import arriving

L = TypeVar("L")
M = TypeVar("M", bound=Any)


def observe_sequence(
    model: WorldModel[L], rows: TimeStep, key: PRNGKey, train: bool = False
) -> tuple[L, dict[str, Float[Array, "T ..."]]]:
    """Posterior latents `[T, N, ...]` and logits of one sequence, from a zero latent."""
    inputs = jax.vmap(model.encode)(rows)
    keys = jax.random.split(key, rows.is_first.shape[0])

    def step(latent: L, at: tuple[Any, PRNGKey]) -> tuple[L, tuple[L, dict[str, Array]]]:
        latent, logits = model.observe(latent, *at, train=train)
        return latent, (latent, logits)

    _, (latents, logits) = jax.lax.scan(step, model.initial(), (inputs, keys))
    return latents, logits


class Observed(NamedTuple):
    """Latents and logits of real sequences, `[T, B, ...]`."""

    latents: Any
    """Posterior latents."""
    prior_latents: Any
    """Prior latents of the same rows, from the rows before."""
    posterior: dict[str, Float[Array, "T B *n K C"]]
    prior: dict[str, Float[Array, "T B *n K C"]]


def observe_batch(model: WorldModel, rows: TimeStep, key: PRNGKey, train: bool = False) -> Observed:
    """Posteriors and priors of sequences, time first: `[T, B, ...]`."""
    length, batch = rows.is_first.shape
    key_observe, key_prior = jax.random.split(key)
    observe = jax.vmap(
        lambda rows, key: observe_sequence(model, rows, key, train), in_axes=(1, 0), out_axes=1
    )
    latents, posterior = observe(rows, jax.random.split(key_observe, batch))
    keys_prior = jax.random.split(key_prior, (length, batch))
    prior_latents, prior = jax.vmap(jax.vmap(model.prior))(latents, keys_prior)
    return Observed(latents, prior_latents, posterior, prior)


OUTCOMES = (
    "reward",
    "agent_reward",
    "terminated",
    "win",
    "reward_logits",
    "agent_reward_logits",
)
"""Predictions that `WorldModelConfig.outcomes` is about, and their losses."""


def followers(is_first: Bool[Array, "T B"]) -> Bool[Array, "T B"]:
    """Mask of the rows of time-first sequences whose row before is known and of their episode."""
    inside = jnp.arange(is_first.shape[0])[:, None] > 0
    return inside & ~is_first


def predict_step(
    model: WorldModel[L], before: L, after: L, config: WorldModelConfig
) -> Predictions:
    """Predictions of a row from its latent and the latent of the row before; no batch axis."""
    predicted = model.predict(after)
    if config.outcomes == "row":
        return predicted
    came = model.predict(arriving(before, after))
    return predicted._replace(**{name: getattr(came, name) for name in OUTCOMES})


def predict_sequence(model: WorldModel[L], latents: L, config: WorldModelConfig) -> Predictions:
    """Predictions of the rows of time-first latents `[T, B, ...]`.

    With outcomes of the transition, those of rows that have no row before mean nothing.
    """
    before = jax.tree.map(lambda x: jnp.concatenate([x[:1], x[:-1]]), latents)
    return jax.vmap(jax.vmap(lambda a, b: predict_step(model, a, b, config)))(before, latents)


SCALE_DECAY = 0.99
"""Share of the running mean and variance of inputs that remains after a model update."""


def with_scales(model: M, rows: TimeStep) -> M:
    """Copy of a model that standardises its inputs, after it has seen `rows` `[*b, ...]`.

    Observations of the dead do not count. A model without scales is returned as it is.
    """
    if getattr(model.filter, "scale", None) is None:
        return model
    scale = model.filter.scale.update(rows.obs, 1.0 * rows.alive, SCALE_DECAY)
    model = eqx.tree_at(lambda m: m.filter.scale, model, scale)
    if hasattr(model, "state_scale"):
        everywhere = jnp.ones(rows.is_first.shape)
        scale = model.state_scale.update(rows.state, everywhere, SCALE_DECAY)
        model = eqx.tree_at(lambda m: m.state_scale, model, scale)
    return model


def std_of(scale: Normaliser | None) -> Float[Array, " F"] | float:
    """Standard deviations by which errors are divided; 1 without a scale. They are not trained."""
    return 1.0 if scale is None else jax.lax.stop_gradient(scale.moments()[1])


def obs_std(model: WorldModel) -> Float[Array, " O"] | float:
    """Standard deviations of observations."""
    return std_of(getattr(model.filter, "scale", None))


def state_std(model: WorldModel) -> Float[Array, " S"] | float:
    """Standard deviations of the state; 1 also for models that do not see it."""
    return std_of(getattr(model, "state_scale", None))
