"""Two-hot regression of a scalar by a categorical over bins, as in DreamerV3 (Hafner et al. 2023).

For targets that are small on most rows and large on a few, such as the reward of a win (ADR 27):
the categorical learns the probability of the large value, where the squared error fits its size.
"""

from math import expm1

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

N_BINS = 51
LIMIT = 5.0
"""Distance of the outermost bins from 0, in symlog units."""
MOST = expm1(LIMIT)
"""The largest value that can be predicted: 147.4."""


def bins() -> Float[Array, " K"]:
    """Values of the bins, equally spaced in symlog units: sign(x) log(1 + |x|)."""
    half = N_BINS // 2
    x = LIMIT * (jnp.arange(N_BINS) - half) / half
    return jnp.sign(x) * jnp.expm1(jnp.abs(x))


def two_hot_mean(logits: Float[Array, "*b K"]) -> Float[Array, "*b"]:
    """Expected value under the categorical over bins."""
    return jnp.matmul(jax.nn.softmax(logits.astype(jnp.float32)), bins(), precision="highest")


def two_hot_loss(logits: Float[Array, "*b K"], target: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Cross-entropy against the two bins beside the target, whose weighted mean is the target.

    Targets beyond the outermost bins are clipped to them: see `beyond_bins`.
    """
    values = bins()
    target = jnp.clip(target, values[0], values[-1])
    above = jnp.clip(jnp.searchsorted(values, target), 1, N_BINS - 1)
    low, high = values[above - 1], values[above]
    share = (target - low) / (high - low)
    log_p = jax.nn.log_softmax(logits.astype(jnp.float32))

    def at(index: Array) -> Array:
        index = jnp.broadcast_to(index, log_p.shape[:-1])
        return jnp.take_along_axis(log_p, index[..., None], axis=-1)[..., 0]

    return -((1 - share) * at(above - 1) + share * at(above))


def beyond_bins(target: Float[Array, "*b"]) -> Float[Array, ""]:
    """Share of the targets that lie beyond the outermost bins."""
    return (jnp.abs(target) > MOST).mean()
