"""The shared actor: pi(a | z_agent, h_agent), and nothing else of the world (section 3.3)."""

from math import log
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float, Int

from mabl.envs.base import ActionSpace, Continuous
from mabl.nets.categorical import sample_index
from mabl.nets.mlp import MLP, Features, Widths, parts_of
from mabl.types import PRNGKey

LEAST_LOG_STD = -5.0
"""Below it, likelihoods at the bounds are lost in float32."""


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

    @staticmethod
    def most_entropy(available: Bool[Array, "*b A"]) -> Float[Array, "*b"]:
        """Entropy of the uniform policy over what is available, in nats."""
        n = available.sum(-1)
        return jnp.log(jnp.where(n > 0, n, available.shape[-1]))

    @staticmethod
    def free(available: Bool[Array, "*b A"]) -> Bool[Array, "*b"]:
        """Where there is a choice: more than one action, or none, which masks none."""
        return available.sum(-1) != 1


class CensoredNormal(NamedTuple):
    """A policy over actions in [-1, 1]: normal, and what falls outside is done at the bound.

    Bounds have the probability of all that lies beyond, so that the likelihood of an action that
    was really taken is exact (ADR 12). Dimensions that an agent lacks are 0.
    """

    mean: Float[Array, "*b A"]
    std: Float[Array, "*b A"]
    exists: Bool[Array, "*b A"]

    def sample(self, key: PRNGKey) -> Float[Array, "*b A"]:
        """Draw an action."""
        return self._bounded(self.mean + self.std * jax.random.normal(key, self.mean.shape))

    def mode(self) -> Float[Array, "*b A"]:
        """The mean, or the bound nearest to it."""
        return self._bounded(self.mean)

    def log_prob(self, action: Float[Array, "*b A"]) -> Float[Array, "*b"]:
        """log pi(action): densities within the bounds, probabilities on them."""
        inside = norm.logpdf(action, self.mean, self.std)
        above = log_ndtr((self.mean - 1) / self.std)
        below = log_ndtr((-1 - self.mean) / self.std)
        each = jnp.where(action >= 1, above, jnp.where(action <= -1, below, inside))
        return (each * self.exists).sum(-1)

    def entropy(self) -> Float[Array, "*b"]:
        """Of the normal distribution, before the bounds; in nats."""
        each = jnp.log(self.std) + 0.5 * jnp.log(2 * jnp.pi * jnp.e)
        return (each * self.exists).sum(-1)

    @staticmethod
    def most_entropy(available: Bool[Array, "*b A"]) -> Float[Array, "*b"]:
        """Entropy of the uniform distribution over [-1, 1] in each dimension, in nats."""
        return available.sum(-1) * log(2.0)

    @staticmethod
    def free(available: Bool[Array, "*b A"]) -> Bool[Array, "*b"]:
        """Where there is a choice: a dimension at least."""
        return available.any(-1)

    def _bounded(self, action: Float[Array, "*b A"]) -> Float[Array, "*b A"]:
        return jnp.clip(action, -1, 1) * self.exists


Choice = MaskedCategorical | CensoredNormal
"""What a policy is at one agent's features."""


def has_choice(action: Array, available: Bool[Array, "*b A"]) -> Bool[Array, "*b"]:
    """Mask of agents that have a choice; `action` only tells the kind of space."""
    kind = MaskedCategorical if jnp.issubdtype(action.dtype, jnp.integer) else CensoredNormal
    return kind.free(available)


class Actor(eqx.Module):
    """Policy of one agent over discrete actions; parameters shared by all."""

    mlp: MLP

    def __init__(
        self,
        seen: Widths,
        n_actions: int,
        hidden: int,
        n_hidden: int,
        out_scale: float,
        key: PRNGKey,
    ):
        self.mlp = MLP(seen, n_actions, hidden, n_hidden, key, out_scale)

    def __call__(self, features: Features, available: Bool[Array, " A"]) -> MaskedCategorical:
        """The policy at one agent's features."""
        return MaskedCategorical.of(self.mlp(*parts_of(features)), available)


class ContinuousActor(eqx.Module):
    """Policy of one agent over continuous actions; parameters shared by all.

    The mean depends on what is seen, the standard deviation does not (decision 19).
    """

    mlp: MLP
    log_std: Float[Array, " A"]

    def __init__(
        self,
        seen: Widths,
        n_actions: int,
        hidden: int,
        n_hidden: int,
        out_scale: float,
        initial_std: float,
        key: PRNGKey,
    ):
        self.mlp = MLP(seen, n_actions, hidden, n_hidden, key, out_scale)
        self.log_std = jnp.full(n_actions, log(initial_std), jnp.float32)

    def __call__(self, features: Features, available: Bool[Array, " A"]) -> CensoredNormal:
        """The policy at one agent's features; `available` are the dimensions that it has."""
        std = jnp.exp(jnp.maximum(self.log_std, LEAST_LOG_STD))
        return CensoredNormal(self.mlp(*parts_of(features)), std, available)


def actor_for(
    space: ActionSpace,
    seen: Widths,
    hidden: int,
    n_hidden: int,
    out_scale: float,
    initial_std: float,
    key: PRNGKey,
) -> Actor | ContinuousActor:
    """A fresh policy over a space of actions; `seen` are the widths of its features."""
    sizes = seen, space.size, hidden, n_hidden, out_scale
    if isinstance(space, Continuous):
        return ContinuousActor(*sizes, initial_std, key)
    return Actor(*sizes, key)
