"""Networks of an agent level and a global level, and their inputs, for MABL and MABL-SG."""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mabl.envs.base import EnvSpec
from mabl.nets.categorical import Code
from mabl.nets.mlp import MLP, Features
from mabl.nets.normaliser import Normaliser
from mabl.rows import TimeStep
from mabl.types import PRNGKey
from mabl.world_models.base import WorldModelConfig
from mabl.world_models.heads import Heads, Predictions
from mabl.world_models.levels import (
    AgentFilter,
    Categoricals,
    Embedded,
    Level,
    Recurrent,
    partly_decoded,
    restored,
    row_decoder,
    standardised,
)


class Latent(NamedTuple):
    """Both levels; whose they are, the model says."""

    agent: Level
    global_: Level


class Inputs(NamedTuple):
    """A row as the scan over time needs it: all that does not recur is computed beforehand."""

    prev_action: Float[Array, "N A"]
    obs: Embedded
    state: Embedded
    is_first: Bool[Array, ""]


class BiLevel(eqx.Module):
    """Networks of the agent level and of the global level; parameters shared by all agents."""

    filter: AgentFilter
    state_encoder: MLP
    state_scale: Normaliser | None
    """Running mean and variance of the state, by which it is standardised."""
    global_recurrent: Recurrent
    global_posterior: Categoricals
    global_prior: Categoricals
    state_decoder: MLP | None
    """The state's decoder, where recurrent models see rows."""
    agent_prior: Categoricals
    heads: Heads
    agent_prior_sees: Literal["sample", "level"] = eqx.field(static=True)
    state_dim: int = eqx.field(static=True)
    """Width of the state that global levels hold; 0 if they hold none."""

    def __init__(
        self,
        spec: EnvSpec,
        config: WorldModelConfig,
        n_seen: int,
        joint_dim: int,
        identity_dim: int,
        key: PRNGKey,
    ):
        """Initialise all networks.

        Args:
            n_seen: agents whose z^a the global posterior sees.
            joint_dim: width of the joint action that the global level sees.
            identity_dim: width of the one-hot index that agent priors see; 0 if they see none.
        """
        keys = jax.random.split(key, 8)
        hidden, latent = config.hidden, config.latent
        action_dim = spec.action_space.size
        self.filter = AgentFilter(spec, config, keys[0])
        self.state_scale = Normaliser.fresh(spec.state_dim) if config.standardise else None
        activation = config.activation
        self.state_encoder = MLP(spec.state_dim, hidden, hidden, 2, keys[1], activation=activation)
        self.state_dim = spec.state_dim if config.recurrent_sees == "row" else 0
        self.global_recurrent = Recurrent(
            latent, joint_dim, hidden, keys[2], activation, self.state_dim
        )
        self.state_decoder = None
        if self.state_dim:
            self.state_decoder = row_decoder(config, spec.state_dim, keys[7])
        seen = latent._replace(n_categoricals=n_seen * latent.n_categoricals)
        self.global_posterior = Categoricals(
            (hidden, seen, hidden), hidden, latent, keys[3], activation
        )
        self.global_prior = Categoricals((hidden,), hidden, latent, keys[4], activation)
        above = (latent, hidden) if config.agent_prior_sees == "level" else (latent,)
        above += (identity_dim,) if identity_dim else ()
        self.agent_prior = Categoricals((hidden, *above), hidden, latent, keys[5], activation)
        self.agent_prior_sees = config.agent_prior_sees
        self.heads = Heads(
            agent=(latent, hidden),
            full=(latent, latent, hidden, hidden),
            obs_dim=None if config.filter_decodes else spec.obs_dim,
            action_dim=action_dim,
            hidden=hidden,
            n_hidden=config.n_hidden,
            both_levels_reward=config.reward_input == "both",
            wins=spec.scores_wins,
            reward_bins=config.reward_bins,
            key=keys[6],
            activation=activation,
        )

    def agent_logits(
        self, h: Float[Array, " D"], global_: Level, *identity: Float[Array, " N"]
    ) -> Float[Array, "K C"]:
        """Logits of one agent's prior: of p(z^a | h^a, z^g), or of p(z^a | h^a, z^g, h^g).

        `identity` is the agent's one-hot index, for priors that see it.
        """
        above = global_.features() if self.agent_prior_sees == "level" else (global_.z,)
        return self.agent_prior(h, *above, *identity)

    def initial_global(self) -> Level:
        """A global level before an episode's first row: zeros."""
        return Level.none(self.filter.hidden, self.filter.latent, self.state_dim)

    def imagined_global(self, h: Float[Array, " D"], z: Code) -> Level:
        """A global level of an imagined row, with the decoded state if levels hold rows; no
        gradient flows through that state."""
        level = Level(h, z)
        if self.state_decoder is None:
            return level
        return level._replace(row=jax.lax.stop_gradient(self.state_decoder(*level.features())))

    def partly_decoded_global(self, level: Level, key: PRNGKey) -> Level:
        """A global level as its recurrent model is trained on it (`decoded_share`)."""
        return partly_decoded(level, self.state_decoder, self.filter.decoded_share, key)

    def predict(self, agent: Level, global_: Level) -> Predictions:
        """One agent's predictions of a row, in the environment's units."""
        full = (agent.z, global_.z, agent.h, global_.h)
        predicted = self.heads(agent.features(), full, *self.filter.decoded(agent))
        if self.state_decoder is not None:
            state = self.state_decoder(*global_.features())
            predicted = predicted._replace(state=restored(state, self.state_scale))
        return predicted._replace(obs=restored(predicted.obs, self.filter.scale))

    def critic_features(self, agent: Level, global_: Level) -> Features:
        """(z^a, z^g, h^a, h^g) of one agent, its observation if policies see it, and the state if
        the global level holds it."""
        state = () if global_.row is None else (global_.row,)
        return agent.z, global_.z, agent.h, global_.h, *self.filter.seen(agent), *state

    def encode(self, row: TimeStep, spec: EnvSpec) -> Inputs:
        """Encode actions, observations and the state of one row."""
        state = standardised(row.state, self.state_scale)
        return Inputs(
            prev_action=spec.action_space.encode(row.prev_action),
            obs=jax.vmap(self.filter.embed)(row.obs),
            state=Embedded(self.state_encoder.embed(state), state if self.state_dim else None),
            is_first=row.is_first,
        )


def own_first(action: Float[Array, "N A"]) -> Float[Array, "N M"]:
    """Arrange the joint action for each agent: its own, the others' by index, its one-hot index.

    Args:
        action: encoded actions of N agents, A numbers each.

    Returns:
        One row for each agent, of M = N * A + N numbers.
    """
    n = action.shape[0]
    order = jnp.array([[i, *(j for j in range(n) if j != i)] for i in range(n)])
    return jnp.concatenate([action[order].reshape(n, -1), jnp.eye(n)], axis=-1)
