"""Self-attention over agents [39]."""

import equinox as eqx
import jax
from einops import rearrange
from jaxtyping import Array, Float

from mabl.nets.mlp import Linear
from mabl.types import PRNGKey


class SelfAttention(eqx.Module):
    """Scaled dot-product attention with `n_heads` heads, without position or mask."""

    query: Linear
    key: Linear
    value: Linear
    out: Linear
    n_heads: int = eqx.field(static=True)

    def __init__(self, width: int, n_heads: int, key: PRNGKey):
        keys = jax.random.split(key, 4)
        self.query, self.key, self.value, self.out = (Linear(width, width, k) for k in keys)
        self.n_heads = n_heads

    def __call__(self, x: Float[Array, "N D"]) -> Float[Array, "N D"]:
        """Every row attends to all rows."""
        query, key, value = (
            rearrange(jax.vmap(layer)(x), "n (h d) -> n h d", h=self.n_heads)
            for layer in (self.query, self.key, self.value)
        )
        mixed = jax.nn.dot_product_attention(query, key, value)
        return jax.vmap(self.out)(rearrange(mixed, "n h d -> n (h d)"))
