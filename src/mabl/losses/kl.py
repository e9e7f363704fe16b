"""KL divergence between vectors of categoricals, balanced as in Dreamer-v2 [13]."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def categorical_kl(
    posterior: Float[Array, "*b K C"], prior: Float[Array, "*b K C"]
) -> Float[Array, "*b K"]:
    """KL(posterior || prior) of each categorical from its logits, in nats."""
    log_q = jax.nn.log_softmax(posterior)
    log_p = jax.nn.log_softmax(prior)
    return (jnp.exp(log_q) * (log_q - log_p)).sum(-1)


def balanced_kl(
    posterior: Float[Array, "*b K C"],
    prior: Float[Array, "*b K C"],
    prior_weight: float,
    posterior_weight: float,
    reduction: str = "mean",
    free_nats: float = 0.0,
) -> Float[Array, "*b"]:
    """KL balancing: `prior_weight * KL(stop(q) || p) + posterior_weight * KL(q || stop(p))`.

    Table 2: 0.8 (cross entropy: trains the prior) and 0.2 (entropy: trains the posterior).
    Reduced over the K categoricals by `reduction`, `mean` or `sum`; each reduced term is kept from
    falling below `free_nats`.
    """
    reduce = {"mean": jnp.mean, "sum": jnp.sum}[reduction]
    # Both terms have one value, so that one maximum keeps both from falling.
    kl = reduce(_weighted_kl(posterior, prior, prior_weight, posterior_weight), axis=-1)
    return jnp.maximum(kl, (prior_weight + posterior_weight) * free_nats)


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _weighted_kl(
    posterior: Float[Array, "*b K C"],
    prior: Float[Array, "*b K C"],
    prior_weight: float,
    posterior_weight: float,
) -> Float[Array, "*b K"]:
    """`(prior_weight + posterior_weight) * KL(q || p)`, whose gradients each have their own weight.

    They are written out: d KL / d logits of p is p - q, and of q it is q (log q / p - KL).
    """
    return (prior_weight + posterior_weight) * categorical_kl(posterior, prior)


def _weighted_kl_fwd(
    posterior: Array, prior: Array, prior_weight: float, posterior_weight: float
) -> tuple[Array, tuple[Array, ...]]:
    log_q, log_p = jax.nn.log_softmax(posterior), jax.nn.log_softmax(prior)
    kl = (jnp.exp(log_q) * (log_q - log_p)).sum(-1)
    return (prior_weight + posterior_weight) * kl, (log_q, log_p, kl)


def _weighted_kl_bwd(
    prior_weight: float, posterior_weight: float, saved: tuple[Array, ...], gradient: Array
) -> tuple[Array, Array]:
    log_q, log_p, kl = saved
    q, p, scale = jnp.exp(log_q), jnp.exp(log_p), gradient[..., None]
    to_posterior = posterior_weight * scale * q * (log_q - log_p - kl[..., None])
    return to_posterior, prior_weight * scale * (p - q)


_weighted_kl.defvjp(_weighted_kl_fwd, _weighted_kl_bwd)
