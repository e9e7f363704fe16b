"""Observation model and auxiliary components (section 3.1.2): what a latent says of the world."""

from typing import NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array, Float

from mabl.nets.mlp import MLP
from mabl.types import PRNGKey


class Predictions(NamedTuple):
    """What a world model predicts of one row."""

    obs: Float[Array, "*b O"]
    reward: Float[Array, "*b"]
    terminated: Float[Array, "*b"]
    """Logit of p(terminated)."""
    available: Float[Array, "*b A"]
    """Logits of p(available), one Bernoulli for each action."""
    action: Float[Array, "*b A"]
    """The agent's own previous action: logits if discrete, mean if continuous."""


class Heads(eqx.Module):
    """The five decoders of one agent: two hidden layers each (Table 2)."""

    obs: MLP
    reward: MLP
    terminated: MLP
    available: MLP
    action: MLP

    def __init__(
        self,
        agent_dim: int,
        reward_dim: int,
        full_dim: int,
        obs_dim: int,
        action_dim: int,
        hidden: int,
        n_hidden: int,
        key: PRNGKey,
    ):
        keys = jax.random.split(key, 5)
        self.obs = MLP(agent_dim, obs_dim, hidden, n_hidden, keys[0])
        self.reward = MLP(reward_dim, 1, hidden, n_hidden, keys[1])
        self.terminated = MLP(full_dim, 1, hidden, n_hidden, keys[2])
        self.available = MLP(full_dim, action_dim, hidden, n_hidden, keys[3])
        self.action = MLP(full_dim, action_dim, hidden, n_hidden, keys[4])

    def __call__(
        self,
        agent: Float[Array, " F"],
        reward_input: Float[Array, " R"],
        full: Float[Array, " G"],
    ) -> Predictions:
        """Decode one agent's latents: the agent level, the reward's input, and all levels."""
        return Predictions(
            obs=self.obs(agent),
            reward=self.reward(reward_input)[0],
            terminated=self.terminated(full)[0],
            available=self.available(full),
            action=self.action(full),
        )
