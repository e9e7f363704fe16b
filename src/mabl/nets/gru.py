"""A gated recurrent unit whose weights are laid out for `product`."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mabl.nets.product import product
from mabl.types import PRNGKey


class GRU(eqx.Module):
    """r, u = sigmoid(W x + U h + b), n = tanh(W x + b + r (U h + c)), h' = n + u (h - n).

    Of the three blocks of columns the first is for r, the second for u, the third for n.
    """

    weight_in: Float[Array, "I 3D"]
    weight_hidden: Float[Array, "D 3D"]
    bias: Float[Array, " 3D"]
    bias_new: Float[Array, " D"]

    def __init__(self, n_in: int, hidden: int, key: PRNGKey):
        """Equinox's initial weights, uniform up to 1 / sqrt(D)."""
        cell = eqx.nn.GRUCell(n_in, hidden, key=key)
        self.weight_in, self.weight_hidden = cell.weight_ih.T, cell.weight_hh.T
        assert cell.bias is not None and cell.bias_n is not None
        self.bias, self.bias_new = cell.bias, cell.bias_n

    def __call__(self, x: Float[Array, " I"], h: Float[Array, " D"]) -> Float[Array, " D"]:
        """One step."""
        seen = jnp.split(product(x, self.weight_in) + self.bias, 3)
        kept = jnp.split(product(h, self.weight_hidden), 3)
        reset = jax.nn.sigmoid(seen[0] + kept[0])
        update = jax.nn.sigmoid(seen[1] + kept[1])
        new = jnp.tanh(seen[2] + reset * (kept[2] + self.bias_new))
        return new + update * (h - new)
