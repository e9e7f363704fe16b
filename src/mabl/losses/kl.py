"""KL divergence between vectors of categoricals, balanced as in Dreamer-v2 [13]."""

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
    stop = jax.lax.stop_gradient
    reduce = {"mean": jnp.mean, "sum": jnp.sum}[reduction]
    train_prior = reduce(categorical_kl(stop(posterior), prior), axis=-1)
    train_posterior = reduce(categorical_kl(posterior, stop(prior)), axis=-1)
    return prior_weight * jnp.maximum(train_prior, free_nats) + posterior_weight * jnp.maximum(
        train_posterior, free_nats
    )
