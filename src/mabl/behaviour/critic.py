"""The shared centralised critic, with self-attention over agents (section 3.3, [39])."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mabl.nets.attention import SelfAttention
from mabl.nets.mlp import MLP, Features, Linear, Widths, parts_of
from mabl.types import PRNGKey


class Critic(eqx.Module):
    """V of each agent given its features, e.g. (z_agent, z_global, h_agent, h_global).

    It attends to the features of everybody, or of those alone that it is to hear.
    """

    embed: Linear
    attention: SelfAttention
    mlp: MLP

    def __init__(self, seen: Widths, hidden: int, n_hidden: int, n_heads: int, key: PRNGKey):
        key_embed, key_attention, key_mlp = jax.random.split(key, 3)
        self.embed = Linear(seen, hidden, key_embed)
        self.attention = SelfAttention(hidden, n_heads, key_attention)
        self.mlp = MLP(hidden, 1, hidden, n_hidden, key_mlp)

    def __call__(
        self, features: Features, heard: Bool[Array, " N"] | None = None
    ) -> Float[Array, " N"]:
        """One value for each agent of a team, from features `[N, ...]`."""
        x = jax.nn.relu(jax.vmap(self.embed)(*parts_of(features)))
        heard = jnp.ones(x.shape[0], bool) if heard is None else heard
        x = x + self.attention(x, heard)
        return jax.vmap(self.mlp)(x)[:, 0]
