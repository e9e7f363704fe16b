"""Observation model and auxiliary components (section 3.1.2): what a latent says of the world."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mabl.losses.two_hot import two_hot_mean
from mabl.nets.categorical import still
from mabl.nets.mlp import (
    MLP,
    Activation,
    Features,
    Linear,
    Part,
    Widths,
    activate,
    parts_of,
)
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
    reward_logits: Float[Array, "*b K"] | None = None
    """Logits of the bins whose mean is `reward`, with `reward_loss=two_hot`."""
    agent_reward_logits: Float[Array, "*b K"] | None = None
    """Logits of the bins whose mean is `agent_reward`."""
    win: Float[Array, "*b"] | None = None
    """Logit of p(win | the episode ends here), where scores tell wins."""
    state: Float[Array, "*b S"] | None = None
    """The environment's state, where global levels decode it."""


class Scalar(NamedTuple):
    """A predicted number, and the logits of its bins if it has any."""

    mean: Float[Array, ""]
    logits: Float[Array, " K"] | None


def scalar_of(output: Float[Array, " K"]) -> Scalar:
    """Read a head's output: one number as it is, several as the logits of bins."""
    if output.shape[-1] == 1:
        return Scalar(output[0], None)
    return Scalar(two_hot_mean(output), output)


class Heads(eqx.Module):
    """The decoders of one agent, of `n_hidden` hidden layers each (Table 2: two).

    With `both_levels_reward` a second reward predictor sees both levels; ADR 4 says why. Life comes
    from the decoder of availability, as one Bernoulli more (ADR 9). First layers that see the same
    are computed as one. With `wins` there is a predictor of wins, for diagnostics alone.
    """

    agent_in: Linear
    full_in: Linear
    obs: MLP | None
    """None where the filter has it."""
    agent_reward: MLP
    terminated: MLP
    available: MLP
    action: MLP
    full_reward: MLP | None
    win: MLP | None
    """A diagnostic: its loss trains nothing before it."""

    def __init__(
        self,
        agent: Widths,
        full: Widths,
        obs_dim: int | None,
        action_dim: int,
        hidden: int,
        n_hidden: int,
        both_levels_reward: bool,
        key: PRNGKey,
        activation: Activation = "relu",
        wins: bool = False,
        reward_bins: int = 1,
    ):
        """`agent` and `full` are the widths of what decoders see: its own level, and all levels.

        Without `obs_dim` there is no decoder of observations. Each predictor of rewards has
        `reward_bins` outputs: 1, or the logits of that many bins.
        """
        keys = jax.random.split(key, 7)

        def decoders(seen: Widths, sizes: tuple[int, ...], keys: Array) -> tuple[Linear, list[MLP]]:
            whole = [
                MLP(seen, n, hidden, n_hidden, k, activation=activation)
                for n, k in zip(sizes, keys, strict=True)
            ]
            first = jax.tree.map(
                lambda *x: jnp.concatenate(x, axis=-1), *(mlp.layers[0] for mlp in whole)
            )
            return first, [eqx.tree_at(lambda m: m.layers, m, m.layers[1:]) for m in whole]

        sizes = (reward_bins,) if obs_dim is None else (obs_dim, reward_bins)
        self.agent_in, own = decoders(agent, sizes, keys[2 - len(sizes) : 2])
        self.obs = None if obs_dim is None else own[0]
        self.agent_reward = own[-1]
        sizes = (1, action_dim + 1, action_dim) + (reward_bins,) * both_levels_reward
        self.full_in, rest = decoders(full, sizes, keys[2 : 2 + len(sizes)])
        self.terminated, self.available, self.action = rest[:3]
        self.full_reward = rest[3] if both_levels_reward else None
        self.win = None
        if wins:
            self.win = MLP(full, 1, hidden, n_hidden, keys[6], activation=activation)

    def __call__(self, agent: Features, full: Features, obs: Any = None) -> Predictions:
        """Decode one agent's latents: its own level, and all levels.

        `obs` `[O]` is the decoded observation where these heads have no decoder of it.
        """

        def split(first: Linear, seen: Features, n: int) -> list[Float[Array, " D"]]:
            parts = jnp.split(first(*parts_of(seen)), n, axis=-1)
            return [activate(part, self.agent_reward.activation) for part in parts]

        if self.obs is None:
            (reward,) = split(self.agent_in, agent, 1)
        else:
            hidden, reward = split(self.agent_in, agent, 2)
            obs = self.obs(hidden)
        terminated, available, action, *both = split(
            self.full_in, full, 4 if self.full_reward else 3
        )
        offered = self.available(available)
        own = scalar_of(self.agent_reward(reward))
        both_levels = scalar_of(self.full_reward(both[0])) if self.full_reward else None
        used = both_levels or own
        return Predictions(
            obs=obs,
            reward=used.mean,
            agent_reward=own.mean if both_levels else None,
            terminated=self.terminated(terminated)[0],
            available=offered[:-1],
            alive=offered[-1],
            action=self.action(action),
            reward_logits=used.logits,
            agent_reward_logits=own.logits if both_levels else None,
            win=None if self.win is None else self.win(*detached(full))[0],
        )


def detached(features: Features) -> tuple[Part, ...]:
    """Features through which no gradient flows."""
    return jax.lax.stop_gradient(still(parts_of(features)))
