"""Latent states as vectors of K categorical variables with C classes each (section 3.1, [13])."""

import jax
import jax.numpy as jnp
from einops import rearrange
from jaxtyping import Array, Float, Int

from mabl.types import PRNGKey


def sample_index(probs: Float[Array, "*b C"], key: PRNGKey) -> Int[Array, "*b"]:
    """One class for each leading index, by inverting the distribution function.

    Needs one uniform number a draw, where the Gumbel trick needs C.
    """
    cdf = jnp.cumsum(probs, axis=-1)
    # Scaling by the last entry keeps rounding from ever pointing past the last class.
    uniform = jax.random.uniform(key, (*probs.shape[:-1], 1)) * cdf[..., -1:]
    return (uniform >= cdf).sum(-1)


def sample_straight_through(logits: Float[Array, "*b K C"], key: PRNGKey) -> Float[Array, "*b K C"]:
    """One-hot samples whose gradient is that of the probabilities: onehot + p - stop(p)."""
    probs = jax.nn.softmax(logits)
    index = sample_index(jax.lax.stop_gradient(probs), key)
    onehot = jax.nn.one_hot(index, logits.shape[-1])
    return onehot + (probs - jax.lax.stop_gradient(probs))


def flatten(z: Float[Array, "*b K C"]) -> Float[Array, "*b KC"]:
    """The latent vector that networks see."""
    return rearrange(z, "... k c -> ... (k c)")


def unflatten(logits: Float[Array, "*b KC"], n_classes: int) -> Float[Array, "*b K C"]:
    """A network's output as K rows of C logits."""
    return rearrange(logits, "... (k c) -> ... k c", c=n_classes)
