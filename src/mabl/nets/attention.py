"""Attention over agents [39] that leaves out those that are dead or absent."""

import equinox as eqx
import jax
import jax.numpy as jnp
from einops import rearrange
from jaxtyping import Array, Bool, Float

from mabl.nets.mlp import Linear
from mabl.types import PRNGKey


class SelfAttention(eqx.Module):
    """Scaled dot-product attention with `n_heads` heads, without position."""

    query: Linear
    key: Linear
    value: Linear
    out: Linear
    n_heads: int = eqx.field(static=True)

    def __init__(self, width: int, n_heads: int, key: PRNGKey):
        keys = jax.random.split(key, 4)
        self.query, self.key, self.value, self.out = (Linear(width, width, k) for k in keys)
        self.n_heads = n_heads

    def __call__(
        self,
        x: Float[Array, "N D"],
        alive: Bool[Array, " N"],
        dropout: float = 0.0,
        key: PRNGKey | None = None,
    ) -> Float[Array, "N D"]:
        """Every row attends to itself and to the rows that are alive.

        `dropout` falls on the attention's weights if there is a key.
        """
        query, keys, value = (
            rearrange(jax.vmap(layer)(x), "n (h d) -> h n d", h=self.n_heads)
            for layer in (self.query, self.key, self.value)
        )
        score = jnp.einsum("hnd,hmd->hnm", query, keys) / query.shape[-1] ** 0.5
        seen = alive[None] | jnp.eye(x.shape[0], dtype=bool)
        weight = jax.nn.softmax(jnp.where(seen[None], score, -jnp.inf))
        mixed = jnp.einsum("hnm,hmd->hnd", drop(weight, dropout, key), value)
        return jax.vmap(self.out)(rearrange(mixed, "h n d -> n (h d)"))


class TransformerLayer(eqx.Module):
    """Self-attention, then one hidden layer, each with a residual and LayerNorm after it."""

    attention: SelfAttention
    hidden: Linear
    out: Linear
    norm_attention: eqx.nn.LayerNorm
    norm_out: eqx.nn.LayerNorm

    def __init__(self, width: int, n_heads: int, key: PRNGKey):
        keys = jax.random.split(key, 3)
        self.attention = SelfAttention(width, n_heads, keys[0])
        self.hidden, self.out = Linear(width, width, keys[1]), Linear(width, width, keys[2])
        self.norm_attention, self.norm_out = eqx.nn.LayerNorm(width), eqx.nn.LayerNorm(width)

    def __call__(
        self, x: Float[Array, "N D"], alive: Bool[Array, " N"], dropout: float, key: PRNGKey | None
    ) -> Float[Array, "N D"]:
        """Dropout falls on the attention's weights and output and on both layers after it."""
        keys = [None] * 4 if key is None else list(jax.random.split(key, 4))
        mixed = self.attention(x, alive, dropout, keys[0])
        x = jax.vmap(self.norm_attention)(x + drop(mixed, dropout, keys[1]))
        hidden = drop(jax.nn.relu(jax.vmap(self.hidden)(x)), dropout, keys[2])
        return jax.vmap(self.norm_out)(x + drop(jax.vmap(self.out)(hidden), dropout, keys[3]))


class TransformerEncoder(eqx.Module):
    """Layers of attention over agents, whose index is their position."""

    layers: list[TransformerLayer]
    dropout: float = eqx.field(static=True)

    def __init__(self, width: int, n_layers: int, n_heads: int, dropout: float, key: PRNGKey):
        keys = jax.random.split(key, n_layers)
        self.layers = [TransformerLayer(width, n_heads, k) for k in keys]
        self.dropout = dropout

    def __call__(
        self, x: Float[Array, "N D"], alive: Bool[Array, " N"], key: PRNGKey | None = None
    ) -> Float[Array, "N D"]:
        """What each agent hears of itself and of the living; without a key, without dropout."""
        x = x + positions(*x.shape)
        for i, layer in enumerate(self.layers):
            x = layer(x, alive, self.dropout, None if key is None else jax.random.fold_in(key, i))
        return x


def positions(n: int, width: int) -> Float[Array, "N D"]:
    """Sinusoidal positions [39]: sin and cos of index / 10000^(2k / D), alternating."""
    k = jnp.arange(width)
    angle = jnp.arange(n)[:, None] / 10_000 ** ((k - k % 2) / width)[None]
    return jnp.where((k % 2 == 0)[None], jnp.sin(angle), jnp.cos(angle))


def drop(x: Float[Array, "*b"], rate: float, key: PRNGKey | None) -> Float[Array, "*b"]:
    """Dropout: zeros at `rate`, the rest scaled up; nothing without a key."""
    if key is None or not rate:
        return x
    return jnp.where(jax.random.bernoulli(key, 1 - rate, x.shape), x / (1 - rate), 0.0)
