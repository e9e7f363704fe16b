"""Fully connected networks with ReLU activations (appendix B.1)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mabl.types import PRNGKey


class Linear(eqx.Module):
    """y = W x + b with Xavier-uniform weights (decision 12) and zero bias."""

    weight: Float[Array, "I O"]
    bias: Float[Array, " O"]

    def __init__(self, n_in: int, n_out: int, key: PRNGKey, scale: float = 1.0):
        limit = scale * (6 / (n_in + n_out)) ** 0.5
        self.weight = jax.random.uniform(key, (n_in, n_out), minval=-limit, maxval=limit)
        self.bias = jnp.zeros(n_out)

    def __call__(self, x: Float[Array, " I"]) -> Float[Array, " O"]:
        """Apply to one vector."""
        return x @ self.weight + self.bias


class MLP(eqx.Module):
    """`n_hidden` ReLU layers of width `hidden`, then a linear layer to `n_out`.

    `out_scale` shrinks the last layer's initial weights: 0.01 makes an actor start uniform.
    """

    layers: list[Linear]

    def __init__(
        self,
        n_in: int,
        n_out: int,
        hidden: int,
        n_hidden: int,
        key: PRNGKey,
        out_scale: float = 1.0,
    ):
        widths = [n_in] + [hidden] * n_hidden + [n_out]
        scales = [1.0] * n_hidden + [out_scale]
        keys = jax.random.split(key, n_hidden + 1)
        self.layers = [
            Linear(i, o, k, s)
            for i, o, k, s in zip(widths[:-1], widths[1:], keys, scales, strict=True)
        ]

    def __call__(self, x: Float[Array, " I"]) -> Float[Array, " O"]:
        """Apply to one vector."""
        for layer in self.layers[:-1]:
            x = jax.nn.relu(layer(x))
        return self.layers[-1](x)
