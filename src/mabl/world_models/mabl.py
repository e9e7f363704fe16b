"""MABL's bi-level world model (section 3.1): written for agent i, then vmapped over agents."""

import equinox as eqx
import jax
from jaxtyping import Array, Float

from mabl.envs.base import EnvSpec
from mabl.nets.categorical import Code, draw, still
from mabl.nets.mlp import Features
from mabl.nets.normaliser import Normaliser
from mabl.rows import TimeStep
from mabl.types import PRNGKey
from mabl.world_models.base import WorldModelConfig
from mabl.world_models.bilevel import BiLevel, Inputs, Latent, own_first
from mabl.world_models.heads import Predictions
from mabl.world_models.levels import AgentFilter, Embedded, Level, forget, team_of


class MABL(eqx.Module):
    """Bi-level latent-variable world model; parameters shared by all agents.

    Each agent has a global latent of its own: both levels of a `Latent` are `[N, ...]`, or of one
    agent inside the per-agent functions.
    """

    nets: BiLevel
    spec: EnvSpec = eqx.field(static=True)
    config: WorldModelConfig = eqx.field(static=True)

    def __init__(self, spec: EnvSpec, config: WorldModelConfig, key: PRNGKey):
        self.spec, self.config = spec, config
        n, size = spec.n_agents, spec.action_space.size
        joint_dim = n * size + (n if config.agent_identity else 0)
        self.nets = BiLevel(spec, config, 1, joint_dim, 0, key)

    @property
    def filter(self) -> AgentFilter:
        """The agent level's posterior: all of the model that execution needs."""
        return self.nets.filter

    @property
    def state_scale(self) -> Normaliser | None:
        """Running mean and variance of the state."""
        return self.nets.state_scale

    def initial(self) -> Latent:
        """The team's latent before an episode's first row: zeros."""
        level = Latent(self.filter.learning(), self.nets.initial_global())
        return team_of(self.spec.n_agents, level)

    def encode(self, row: TimeStep) -> Inputs:
        """Encode actions, observations and the state of one row."""
        return self.nets.encode(row, self.spec)

    def observe(
        self, latent: Latent, inputs: Inputs, key: PRNGKey, train: bool = False
    ) -> tuple[Latent, dict[str, Float[Array, "N K C"]]]:
        """Posterior latents of the next row, and their logits by level (representation model).

        h^a_t = f(h^a_{t-1}, z^a_{t-1}, a^i_{t-1}),   z^a_t ~ q(z^a_t | o^i_t, h^a_t)
        h^g_t = f(h^g_{t-1}, z^g_{t-1}, a_{t-1}),     z^g_t ~ q(z^g_t | s_t, z^a_t, h^g_t)
        """
        if train and self.filter.decoded_share:
            key, key_rows = jax.random.split(key)
            keys = jax.random.split(key_rows, self.spec.n_agents)
            latent = jax.vmap(self._partly_decoded)(latent, keys)
        latent, prev_action = forget((latent, inputs.prev_action), inputs.is_first)

        def observe_agent(
            latent: Latent, prev_action: Array, joint_action: Array, obs: Embedded, key: PRNGKey
        ) -> tuple[Latent, dict[str, Array]]:
            key_agent, key_global = jax.random.split(key)
            agent, agent_logits = self.filter.infer(latent.agent, prev_action, obs, key_agent)
            h = self.nets.global_recurrent(latent.global_, joint_action)
            global_logits = self.nets.global_posterior(inputs.state.code, agent.z, h)
            global_ = Level(h, draw(global_logits, key_global), inputs.state.row)
            return Latent(agent, global_), {"agent": agent_logits, "global": global_logits}

        keys = jax.random.split(key, self.spec.n_agents)
        joint_action, axis = self._joint_action(prev_action)
        return jax.vmap(observe_agent, in_axes=(0, 0, axis, 0, 0))(
            latent, prev_action, joint_action, inputs.obs, keys
        )

    def prior(
        self, latent: Latent, key: PRNGKey
    ) -> tuple[Latent, dict[str, Float[Array, "N K C"]]]:
        """Prior latent of the row whose embeddings `latent` holds, and its logits by level.

        p(z^g_t | h^g_t) and p(z^a_t | h^a_t, z^g_t) with z^g_t a sample of the global prior
        (section 3.2). `config.agent_prior_input` can have the agent's logits, which the KL compares
        with the posterior, see the posterior sample of z^g_t instead (appendix A); the latent is
        what imagination draws in both cases.
        """
        by_posterior = self.config.agent_prior_input == "posterior"

        def prior_agent(latent: Latent, key: PRNGKey) -> tuple[Latent, dict[str, Array]]:
            prior, logits = self._transition(latent.agent.h, latent.global_.h, key)
            if by_posterior:
                logits["agent"] = self.nets.agent_logits(latent.agent.h, latent.global_)
            return prior, logits

        return jax.vmap(prior_agent)(latent, jax.random.split(key, self.spec.n_agents))

    def imagine(self, latent: Latent, action: Float[Array, "N A"], key: PRNGKey) -> Latent:
        """Prior latents of the next row after the joint (encoded) action: no observation, no state.

        h_{t+1} as in `observe`, then z^g ~ p(z^g | h^g) and z^a ~ p(z^a | h^a, z^g).
        """

        def imagine_agent(
            latent: Latent, action: Array, joint_action: Array, key: PRNGKey
        ) -> Latent:
            h_agent = self.filter.recurrent(latent.agent, action)
            h_global = self.nets.global_recurrent(latent.global_, joint_action)
            return self._transition(h_agent, h_global, key)[0]

        keys = jax.random.split(key, self.spec.n_agents)
        joint_action, axis = self._joint_action(action)
        imagine = jax.vmap(imagine_agent, in_axes=(0, 0, axis, 0))
        return still(imagine(latent, action, joint_action, keys))

    def _joint_action(self, action: Float[Array, "N A"]) -> tuple[Float[Array, "*n M"], int | None]:
        """The joint action as global levels see it, and its axis of agents, if they differ."""
        return (own_first(action), 0) if self.config.agent_identity else (action.ravel(), None)

    def _partly_decoded(self, latent: Latent, key: PRNGKey) -> Latent:
        """One agent's latent with decoded rows at a share of the real ones (`decoded_share`)."""
        key_agent, key_global = jax.random.split(key)
        return Latent(
            self.filter.partly_decoded(latent.agent, key_agent),
            self.nets.partly_decoded_global(latent.global_, key_global),
        )

    def _transition(
        self,
        h_agent: Float[Array, " D"],
        h_global: Float[Array, " D"],
        key: PRNGKey,
    ) -> tuple[Latent, dict[str, Float[Array, "K C"]]]:
        """One agent's transition model (section 3.1.1): a sample and its logits.

        z^g_t ~ p(z^g_t | h^g_t),   z^a_t ~ p(z^a_t | h^a_t, z^g_t)
        """
        key_agent, key_global = jax.random.split(key)
        global_logits = self.nets.global_prior(h_global)
        global_ = self.nets.imagined_global(h_global, draw(global_logits, key_global))
        agent_logits = self.nets.agent_logits(h_agent, global_)
        agent = self.filter.imagined(h_agent, draw(agent_logits, key_agent))
        return Latent(agent, global_), {
            "agent": agent_logits,
            "global": global_logits,
        }

    def predict(self, latent: Latent) -> Predictions:
        """Decode a row for every agent: fields `[N, ...]`.

        o^i_t from (z^a, h^a); r^i_t likewise (`config.reward_input`); termination, availability and
        a^i_{t-1} from both levels.
        """
        return jax.vmap(self.nets.predict)(latent.agent, latent.global_)

    def actor_features(self, latent: Latent) -> Features:
        """Policy inputs: (z^a, h^a) (section 3.3), or as `config.policy_input` says."""
        return jax.vmap(self.filter.features)(latent.agent)

    def critic_features(self, latent: Latent) -> Features:
        """Critic inputs: both levels, and what networks see of the row."""
        return jax.vmap(self.nets.critic_features)(latent.agent, latent.global_)

    def global_features(self, latent: Latent) -> Code:
        """z^g: what QMIX's mixer sees (section 3.3)."""
        return latent.global_.z
