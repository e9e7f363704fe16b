"""Fully connected networks, with ReLU (appendix B.1) or RMS normalisation and SiLU [DreamerV3]."""

from itertools import accumulate, pairwise
from math import prod
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mabl.nets.categorical import Code, CodeShape
from mabl.nets.product import product
from mabl.types import PRNGKey

Part = Float[Array, "*b _"] | Code
"""Some of what a network sees."""
Features = Any
"""All that a network sees: a part, or a tuple of parts, as good as their concatenation."""
Width = int | CodeShape
"""Of a part: a vector's length, or what a code is made of."""
Widths = Width | tuple[Width, ...]
"""Of one part, or of all."""


def parts_of(features: Features) -> tuple[Part, ...]:
    """The one part, or those that there are."""
    return features if isinstance(features, tuple) else (features,)


def widths_of(features: Features) -> tuple[Width, ...]:
    """Of all parts."""
    return tuple(x.shape if isinstance(x, Code) else x.shape[-1] for x in parts_of(features))


def dense(features: Features) -> Float[Array, "*b F"]:
    """All parts as one vector."""
    parts = [x.onehot() if isinstance(x, Code) else x for x in parts_of(features)]
    return jnp.concatenate(parts, axis=-1)


class Linear(eqx.Module):
    """y = W x + b with Xavier-uniform weights (decision 12) and zero bias; x may come in parts."""

    weight: Any
    """`[I, O]`, or `[K, C, O]` for a code; a tuple of these where x comes in several parts."""
    bias: Float[Array, " O"]

    def __init__(self, n_in: Widths, n_out: int, key: PRNGKey, scale: float = 1.0):
        one = isinstance(n_in, int | CodeShape)
        widths: tuple[Any, ...] = (n_in,) if one else n_in
        shapes = [tuple(w) if isinstance(w, CodeShape) else (w,) for w in widths]
        ends = list(accumulate(prod(shape) for shape in shapes))
        limit = scale * (6 / (ends[-1] + n_out)) ** 0.5
        whole = jax.random.uniform(key, (ends[-1], n_out), minval=-limit, maxval=limit)
        blocks = [
            rows.reshape(*shape, n_out)
            for shape, rows in zip(shapes, jnp.split(whole, ends[:-1]), strict=True)
        ]
        self.weight = tuple(blocks) if len(blocks) > 1 else blocks[0]
        self.bias = jnp.zeros(n_out)

    def __call__(self, *parts: Part) -> Float[Array, "*b O"]:
        """Apply to one vector, in as many parts as there are blocks of weights."""
        total = self.bias
        blocks = self.weight if isinstance(self.weight, tuple) else (self.weight,)
        for part, block in zip(parts, blocks, strict=True):
            total = total + (part.times(block) if isinstance(part, Code) else product(part, block))
        return total


Activation = Literal["relu", "rms_silu"]
"""Function of hidden layers: ReLU, or RMS normalisation followed by SiLU."""


def activate(x: Float[Array, "*b D"], activation: Activation) -> Float[Array, "*b D"]:
    """Output of a hidden layer from its linear part.

    RMS normalisation divides by the root of the mean square over features [Zhang and Sennrich
    2019]; a gain would be one with the weights of the next layer but for SiLU, and is left out.
    """
    if activation == "relu":
        return jax.nn.relu(x)
    return jax.nn.silu(x * jax.lax.rsqrt((x * x).mean(-1, keepdims=True) + 1e-4))


class MLP(eqx.Module):
    """`n_hidden` hidden layers of width `hidden`, then a linear layer to `n_out`.

    `out_scale` shrinks the last layer's initial weights: 0.01 makes an actor start uniform.
    """

    layers: list[Linear]
    activation: Activation = eqx.field(static=True)

    def __init__(
        self,
        n_in: Widths,
        n_out: int,
        hidden: int,
        n_hidden: int,
        key: PRNGKey,
        out_scale: float = 1.0,
        activation: Activation = "relu",
    ):
        self.activation = activation
        widths = [n_in, *[hidden] * n_hidden, n_out]
        scales = [1.0] * n_hidden + [out_scale]
        keys = jax.random.split(key, n_hidden + 1)
        self.layers = [
            Linear(i, o, k, s) for (i, o), k, s in zip(pairwise(widths), keys, scales, strict=True)
        ]

    def __call__(self, *parts: Part) -> Float[Array, "*b O"]:
        """Apply to one vector, which may come in parts."""
        first, *rest = self.layers
        x = first(*parts)
        for layer in rest:
            x = layer(activate(x, self.activation))
        return x

    def embed(self, *parts: Part) -> Float[Array, "*b O"]:
        """Apply, and activate the output as one more hidden layer."""
        return activate(self(*parts), self.activation)
