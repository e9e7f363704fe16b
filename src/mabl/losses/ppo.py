"""The clipped surrogate objective of PPO."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def clipped_surrogate(
    new_log_prob: Float[Array, "*b"],
    old_log_prob: Float[Array, "*b"],
    advantage: Float[Array, "*b"],
    clip: float,
) -> Float[Array, "*b"]:
    """-min(rho A, clip(rho, 1 - eps, 1 + eps) A) with rho = pi_new / pi_old: a loss, per row."""
    ratio = jnp.exp(new_log_prob - old_log_prob)
    clipped = jnp.clip(ratio, 1 - clip, 1 + clip)
    return -jnp.minimum(ratio * advantage, clipped * advantage)
