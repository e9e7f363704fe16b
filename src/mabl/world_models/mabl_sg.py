"""MABL-SG (section 4.3): the bi-level model with one global latent, shared by the whole team."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mabl.envs.base import EnvSpec
from mabl.nets.categorical import Code, draw, still
from mabl.nets.mlp import Features
from mabl.nets.normaliser import Normaliser
from mabl.rows import TimeStep
from mabl.types import PRNGKey
from mabl.world_models.base import WorldModelConfig
from mabl.world_models.bilevel import BiLevel, Inputs, Latent
from mabl.world_models.heads import Predictions
from mabl.world_models.levels import AgentFilter, Level, forget, team_of


class MABLSG(eqx.Module):
    """Bi-level latent-variable world model with a single global latent of the team.

    Of its `Latent`, the agent level is `[N, ...]` and the global one has no agent axis.
    """

    nets: BiLevel
    spec: EnvSpec = eqx.field(static=True)
    config: WorldModelConfig = eqx.field(static=True)

    def __init__(self, spec: EnvSpec, config: WorldModelConfig, key: PRNGKey):
        self.spec, self.config = spec, config
        n = spec.n_agents
        identity_dim = n if config.agent_identity else 0
        self.nets = BiLevel(spec, config, n, n * spec.action_space.size, identity_dim, key)

    @property
    def filter(self) -> AgentFilter:
        """The agent level's posterior: all of the model that execution needs."""
        return self.nets.filter

    @property
    def state_scale(self) -> Normaliser | None:
        """Running mean and variance of the state."""
        return self.nets.state_scale

    def initial(self) -> Latent:
        """The latents before an episode's first row: zeros."""
        agents = team_of(self.spec.n_agents, self.filter.learning())
        return Latent(agent=agents, global_=self.nets.initial_global())

    def encode(self, row: TimeStep) -> Inputs:
        """Encode actions, observations and the state of one row."""
        return self.nets.encode(row, self.spec)

    def observe(
        self, latent: Latent, inputs: Inputs, key: PRNGKey, train: bool = False
    ) -> tuple[Latent, dict[str, Array]]:
        """Posterior latents of the next row, and their logits by level.

        h^a_t = f(h^a_{t-1}, z^a_{t-1}, a^i_{t-1}),   z^a_t ~ q(z^a_t | o^i_t, h^a_t) for each agent
        h^g_t = f(h^g_{t-1}, z^g_{t-1}, a_{t-1}),     z^g_t ~ q(z^g_t | s_t, z^{a,1..N}_t, h^g_t)
        """
        if train and self.filter.decoded_share:
            key, key_rows = jax.random.split(key)
            latent = self._partly_decoded(latent, key_rows)
        latent, prev_action = forget((latent, inputs.prev_action), inputs.is_first)
        key_agents, key_global = jax.random.split(key)
        keys = jax.random.split(key_agents, self.spec.n_agents)
        agent, agent_logits = jax.vmap(self.filter.infer)(
            latent.agent, prev_action, inputs.obs, keys
        )
        h = self.nets.global_recurrent(latent.global_, prev_action.ravel())
        global_logits = self.nets.global_posterior(inputs.state.code, agent.z.ravel(), h)
        global_ = Level(h, draw(global_logits, key_global), inputs.state.row)
        return Latent(agent, global_), {"agent": agent_logits, "global": global_logits}

    def prior(self, latent: Latent, key: PRNGKey) -> tuple[Latent, dict[str, Array]]:
        """z^g_t ~ p(z^g_t | h^g_t), and every agent's z^a_t ~ p(z^a_t | h^a_t, z^g_t).

        `config.agent_prior_input` says which z^g the agents' logits see, as in MABL.
        """
        prior, logits = self._transition(latent, key)
        if self.config.agent_prior_input == "posterior":
            logits["agent"] = self._agent_logits(latent.agent.h, latent.global_)
        return prior, logits

    def imagine(self, latent: Latent, action: Float[Array, "N A"], key: PRNGKey) -> Latent:
        """Prior latents of the next row after the joint (encoded) action."""
        h_agent = jax.vmap(self.filter.recurrent)(latent.agent, action)
        h_global = self.nets.global_recurrent(latent.global_, action.ravel())
        moved = Latent(latent.agent._replace(h=h_agent), latent.global_._replace(h=h_global))
        return still(self._transition(moved, key)[0])

    def _partly_decoded(self, latent: Latent, key: PRNGKey) -> Latent:
        """The latent with decoded rows at a share of the real ones (`decoded_share`)."""
        key_agents, key_global = jax.random.split(key)
        keys = jax.random.split(key_agents, self.spec.n_agents)
        return Latent(
            jax.vmap(self.filter.partly_decoded)(latent.agent, keys),
            self.nets.partly_decoded_global(latent.global_, key_global),
        )

    def _transition(self, latent: Latent, key: PRNGKey) -> tuple[Latent, dict[str, Array]]:
        """Samples and logits given the deterministic parts of `latent`."""
        key_agents, key_global = jax.random.split(key)
        global_logits = self.nets.global_prior(latent.global_.h)
        global_ = self.nets.imagined_global(latent.global_.h, draw(global_logits, key_global))
        agent_logits = self._agent_logits(latent.agent.h, global_)
        agent = jax.vmap(self.filter.imagined)(latent.agent.h, draw(agent_logits, key_agents))
        return Latent(agent, global_), {"agent": agent_logits, "global": global_logits}

    def _agent_logits(self, h: Float[Array, "N D"], team: Level) -> Float[Array, "N K C"]:
        """Logits of every agent's prior."""
        identity = (jnp.eye(self.spec.n_agents),) if self.config.agent_identity else ()
        return jax.vmap(lambda h, *own: self.nets.agent_logits(h, team, *own))(h, *identity)

    def predict(self, latent: Latent) -> Predictions:
        """Decode a row for every agent from its own level and the team's."""
        return jax.vmap(self.nets.predict, in_axes=(0, None))(latent.agent, latent.global_)

    def actor_features(self, latent: Latent) -> Features:
        """Policy inputs: (z^a, h^a), or as `config.policy_input` says."""
        return jax.vmap(self.filter.features)(latent.agent)

    def critic_features(self, latent: Latent) -> Features:
        """Critic inputs: both levels, and what networks see of the row."""
        team = team_of(self.spec.n_agents, latent.global_)
        return jax.vmap(self.nets.critic_features)(latent.agent, team)

    def global_features(self, latent: Latent) -> Code:
        """z^g, the same for every agent."""
        return team_of(self.spec.n_agents, latent.global_.z)
