"""The shared actor: pi(a | z_agent, h_agent), and nothing else of the world (section 3.3)."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mabl.nets.categorical import sample_index
from mabl.nets.mlp import MLP
from mabl.types import PRNGKey


class MaskedCategorical(NamedTuple):
    """A policy over discrete actions from which the unavailable ones are excluded."""

    log_probs: Float[Array, "*b A"]

    @classmethod
    def of(
        cls, logits: Float[Array, "*b A"], available: Bool[Array, "*b A"]
    ) -> "MaskedCategorical":
        """Mask `logits`; where no action is available, none is masked."""
        available = available | ~available.any(-1, keepdims=True)
        return cls(jax.nn.log_softmax(jnp.where(available, logits, -1e9)))

    def sample(self, key: PRNGKey) -> Int[Array, "*b"]:
        """Draw an action."""
        return sample_index(jnp.exp(self.log_probs), key)

    def mode(self) -> Int[Array, "*b"]:
        """The likeliest action."""
        return self.log_probs.argmax(-1)

    def log_prob(self, action: Int[Array, "*b"]) -> Float[Array, "*b"]:
        """log pi(action)."""
        return jnp.take_along_axis(self.log_probs, action[..., None], axis=-1)[..., 0]

    def entropy(self) -> Float[Array, "*b"]:
        """In nats."""
        return -(jnp.exp(self.log_probs) * self.log_probs).sum(-1)


class Actor(eqx.Module):
    """Policy of one agent; parameters shared by all."""

    mlp: MLP

    def __init__(
        self,
        n_features: int,
        n_actions: int,
        hidden: int,
        n_hidden: int,
        out_scale: float,
        key: PRNGKey,
    ):
        self.mlp = MLP(n_features, n_actions, hidden, n_hidden, key, out_scale)

    def __call__(
        self, features: Float[Array, " F"], available: Bool[Array, " A"]
    ) -> MaskedCategorical:
        """The policy at one agent's features."""
        return MaskedCategorical.of(self.mlp(features), available)
