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
    """What imagination uses."""
    agent_reward: Float[Array, "*b"] | None
    """From the agent level alone, where imagination uses more than that."""
    terminated: Float[Array, "*b"]
    """Logit of p(terminated)."""
    available: Float[Array, "*b A"]
    """Logits of p(available), one Bernoulli for each action."""
    alive: Float[Array, "*b"]
    """Logit of p(alive)."""
    action: Float[Array, "*b A"]
    """The agent's own previous action: logits if discrete, mean if continuous."""


class Heads(eqx.Module):
    """The decoders of one agent, of `n_hidden` hidden layers each (Table 2: two).

    With `both_levels_reward` a second reward predictor sees both levels; ADR 4 says why. Life comes
    from the decoder of availability, as one Bernoulli more (ADR 9).
    """

    obs: MLP
    agent_reward: MLP
    full_reward: MLP | None
    terminated: MLP
    available: MLP
    action: MLP

    def __init__(
        self,
        agent_dim: int,
        full_dim: int,
        obs_dim: int,
        action_dim: int,
        hidden: int,
        n_hidden: int,
        both_levels_reward: bool,
        key: PRNGKey,
    ):
        keys = jax.random.split(key, 6)
        self.obs = MLP(agent_dim, obs_dim, hidden, n_hidden, keys[0])
        self.agent_reward = MLP(agent_dim, 1, hidden, n_hidden, keys[1])
        self.terminated = MLP(full_dim, 1, hidden, n_hidden, keys[2])
        self.available = MLP(full_dim, action_dim + 1, hidden, n_hidden, keys[3])
        self.action = MLP(full_dim, action_dim, hidden, n_hidden, keys[4])
        self.full_reward = (
            MLP(full_dim, 1, hidden, n_hidden, keys[5]) if both_levels_reward else None
        )

    def __call__(self, agent: Float[Array, " F"], full: Float[Array, " G"]) -> Predictions:
        """Decode one agent's latents: its own level, and all levels."""
        agent_reward = self.agent_reward(agent)[0]
        available = self.available(full)
        return Predictions(
            obs=self.obs(agent),
            reward=self.full_reward(full)[0] if self.full_reward else agent_reward,
            agent_reward=agent_reward if self.full_reward else None,
            terminated=self.terminated(full)[0],
            available=available[:-1],
            alive=available[-1],
            action=self.action(full),
        )
