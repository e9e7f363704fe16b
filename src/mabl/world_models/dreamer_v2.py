"""Multi-agent Dreamer-v2 [13]: the agent level of MABL alone, parameters shared by all agents."""

from typing import NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array, Bool, Float

from mabl.envs.base import EnvSpec
from mabl.nets.categorical import draw, still
from mabl.nets.mlp import Features
from mabl.rows import TimeStep
from mabl.types import PRNGKey
from mabl.world_models.base import WorldModelConfig
from mabl.world_models.heads import Heads, Predictions
from mabl.world_models.levels import (
    AgentFilter,
    Categoricals,
    Embedded,
    Level,
    forget,
    restored,
    team_of,
)


class Inputs(NamedTuple):
    """A row as the scan over time needs it."""

    prev_action: Float[Array, "N A"]
    obs: Embedded
    is_first: Bool[Array, ""]


class DreamerV2(eqx.Module):
    """One latent-variable model for every agent, of its own observations and actions only.

    Its latent is one `Level` with fields `[N, ...]`.
    """

    filter: AgentFilter
    agent_prior: Categoricals
    heads: Heads
    spec: EnvSpec = eqx.field(static=True)

    def __init__(self, spec: EnvSpec, config: WorldModelConfig, key: PRNGKey):
        keys = jax.random.split(key, 3)
        hidden, latent = config.hidden, config.latent
        self.spec = spec
        self.filter = AgentFilter(spec, config, keys[0])
        self.agent_prior = Categoricals((hidden,), hidden, latent, keys[1], config.activation)
        self.heads = Heads(
            agent=(latent, hidden),
            full=(latent, hidden),
            obs_dim=None if config.filter_decodes else spec.obs_dim,
            action_dim=spec.action_space.size,
            hidden=hidden,
            n_hidden=config.n_hidden,
            both_levels_reward=False,
            wins=spec.scores_wins,
            reward_bins=config.reward_bins,
            key=keys[2],
            activation=config.activation,
        )

    def initial(self) -> Level:
        """The team's latent before an episode's first row: zeros."""
        return team_of(self.spec.n_agents, self.filter.learning())

    def encode(self, row: TimeStep) -> Inputs:
        """Encode actions and observations of one row."""
        return Inputs(
            prev_action=self.spec.action_space.encode(row.prev_action),
            obs=jax.vmap(self.filter.embed)(row.obs),
            is_first=row.is_first,
        )

    def observe(
        self, latent: Level, inputs: Inputs, key: PRNGKey, train: bool = False
    ) -> tuple[Level, dict[str, Float[Array, "N K C"]]]:
        """h_t = f(h_{t-1}, z_{t-1}, a^i_{t-1}), z_t ~ q(z_t | o^i_t, h_t) of every agent."""
        if train and self.filter.decoded_share:
            key, key_rows = jax.random.split(key)
            keys = jax.random.split(key_rows, self.spec.n_agents)
            latent = jax.vmap(self.filter.partly_decoded)(latent, keys)
        latent, prev_action = forget((latent, inputs.prev_action), inputs.is_first)
        keys = jax.random.split(key, self.spec.n_agents)
        latent, logits = jax.vmap(self.filter.infer)(latent, prev_action, inputs.obs, keys)
        return latent, {"agent": logits}

    def prior(self, latent: Level, key: PRNGKey) -> tuple[Level, dict[str, Float[Array, "N K C"]]]:
        """z_t ~ p(z_t | h_t) of every agent."""
        logits = jax.vmap(self.agent_prior)(latent.h)
        level = jax.vmap(self.filter.imagined)(latent.h, draw(logits, key))
        return level, {"agent": logits}

    def imagine(self, latent: Level, action: Float[Array, "N A"], key: PRNGKey) -> Level:
        """Prior latents of the next row, every agent's after its own action."""
        h = jax.vmap(self.filter.recurrent)(latent, action)
        return still(self.prior(latent._replace(h=h), key)[0])

    def predict(self, latent: Level) -> Predictions:
        """Decode a row for every agent from its own latent."""

        def decode(level: Level) -> Predictions:
            seen = level.features()
            predicted = self.heads(seen, seen, *self.filter.decoded(level))
            return predicted._replace(obs=restored(predicted.obs, self.filter.scale))

        return jax.vmap(decode)(latent)

    def actor_features(self, latent: Level) -> Features:
        """Policy inputs: (z, h), or as `WorldModelConfig.policy_input` says."""
        return jax.vmap(self.filter.features)(latent)

    def critic_features(self, latent: Level) -> Features:
        """(z, h), and the observation if policies see it: there is no other level."""
        return *latent.features(), *jax.vmap(self.filter.seen)(latent)
