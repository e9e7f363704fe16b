"""MAMBA [7]: the agent level, its agents talking through a transformer at every step.

What agents say to each other is needed to know where one is, so execution is centralised. With
`shared=False` every agent has parameters of its own, as in MAG [42].
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mabl.envs.base import EnvSpec
from mabl.errors import UserError, require_between, require_positive
from mabl.nets.attention import TransformerEncoder
from mabl.nets.categorical import CodeShape, draw, still
from mabl.nets.gru import GRU
from mabl.nets.mlp import MLP, Features, Linear, Part, activate
from mabl.nets.normaliser import Normaliser
from mabl.rows import TimeStep
from mabl.types import PRNGKey
from mabl.world_models.base import WorldModelConfig
from mabl.world_models.heads import Heads, Predictions
from mabl.world_models.levels import (
    Categoricals,
    Level,
    forget,
    restored,
    row_decoder,
    standardised,
    team_of,
)


@dataclass(frozen=True)
class CommunicationConfig:
    """The transformer over agents. Defaults are MAMBA's."""

    FLAG_PREFIX: ClassVar[str] = "communication."

    n_layers: int = 3
    """Layers, each as wide as the world model's hidden layers."""
    n_heads: int = 8
    """Heads of each layer's attention."""
    dropout: float = 0.1
    """Share of activations dropped in training the model; never in acting and imagination."""

    def __post_init__(self) -> None:
        require_positive(self, "n_layers", "n_heads")
        require_between(self, 0, 0.9, "dropout")


class Latent(NamedTuple):
    """The team's latent: a level `[N, ...]`, and who was alive to be heard."""

    level: Level
    alive: Bool[Array, " N"]


class Inputs(NamedTuple):
    """A row as the scan over time needs it."""

    prev_action: Float[Array, "N A"]
    obs: Float[Array, "N D"]
    alive: Bool[Array, " N"]
    is_first: Bool[Array, ""]


class Team(eqx.Module):
    """Networks of a team's agents: one set that all share, or one for each along axis 0."""

    nets: Any
    shared: bool = eqx.field(static=True)

    def __init__(self, make: Callable[[PRNGKey], Any], n_agents: int, shared: bool, key: PRNGKey):
        self.shared = shared
        keys = jax.random.split(key, n_agents)
        self.nets = make(keys[0]) if shared else eqx.filter_vmap(make)(keys)

    def map(self, function: Callable[..., Any], *inputs: Any) -> Any:
        """`function(nets, *inputs)` of every agent, with its own slice of the inputs."""
        axes = (None if self.shared else 0, *[0] * len(inputs))
        return jax.vmap(function, in_axes=axes)(self.nets, *inputs)


class FilterNets(eqx.Module):
    """What one agent needs to know where it is."""

    encoder: MLP
    inputs: Linear
    communication: TransformerEncoder
    cell: GRU
    posterior: Categoricals
    decoder: MLP | None
    """The observation's decoder, where policies see what it decodes."""

    def __init__(
        self,
        spec: EnvSpec,
        config: WorldModelConfig,
        communication: CommunicationConfig,
        key: PRNGKey,
    ):
        keys = jax.random.split(key, 6)
        hidden, latent = config.hidden, config.latent
        activation = config.activation
        self.encoder = MLP(spec.obs_dim, hidden, hidden, 2, keys[0], activation=activation)
        self.inputs = Linear((latent, spec.action_space.size), hidden, keys[1])
        self.communication = TransformerEncoder(
            hidden, communication.n_layers, communication.n_heads, communication.dropout, keys[2]
        )
        self.cell = GRU(hidden, hidden, keys[3])
        self.posterior = Categoricals((hidden, hidden), hidden, latent, keys[4], activation)
        self.decoder = None
        if config.filter_decodes:
            self.decoder = row_decoder(config, spec.obs_dim, keys[5])

    def listen(
        self, latent: Latent, action: Float[Array, "N A"], key: PRNGKey | None
    ) -> Float[Array, "N D"]:
        """What this agent's transformer makes of everybody's z and action."""
        said = jax.vmap(self.inputs)(latent.level.z, action)
        said = activate(said, self.encoder.activation)
        return self.communication(said, latent.alive, key)


class JointFilter(eqx.Module):
    """What a team runs to know where it is; every agent's latent depends on everybody's."""

    team: Team
    scale: Normaliser | None
    """Running mean and variance of observations, by which they are standardised."""
    n_agents: int = eqx.field(static=True)
    obs_dim: int = eqx.field(static=True)
    latent: CodeShape = eqx.field(static=True)
    hidden: int = eqx.field(static=True)

    def __init__(
        self,
        spec: EnvSpec,
        config: WorldModelConfig,
        communication: CommunicationConfig,
        shared: bool,
        key: PRNGKey,
    ):
        self.n_agents, self.obs_dim = spec.n_agents, spec.obs_dim
        self.latent, self.hidden = config.latent, config.hidden
        self.scale = Normaliser.fresh(spec.obs_dim) if config.standardise else None
        self.team = Team(
            lambda key: FilterNets(spec, config, communication, key), spec.n_agents, shared, key
        )

    def initial(self) -> Latent:
        """The team's latent before an episode's first row: zeros, nobody to be heard."""
        return still(self.learning())

    def learning(self) -> Latent:
        """The same, with a way for gradients."""
        level = team_of(self.n_agents, Level.none(self.hidden, self.latent))
        return Latent(level, jnp.zeros(self.n_agents, bool))

    def embed(self, obs: Float[Array, "N O"]) -> Float[Array, "N D"]:
        """Encode every agent's observation; independent of the past."""
        obs = standardised(obs, self.scale)
        return self.team.map(lambda nets, obs: nets.encoder.embed(obs), obs)

    def recur(
        self, latent: Latent, action: Float[Array, "N A"], key: PRNGKey | None = None
    ) -> Float[Array, "N D"]:
        """h^i_t = GRU(h^i_{t-1}, transformer(z_{t-1}, a_{t-1})^i); dropout if there is a key."""

        def one(nets: FilterNets, i: Array, h: Array) -> Array:
            return nets.cell(nets.listen(latent, action, key)[i], h)

        return self.team.map(one, jnp.arange(self.n_agents), latent.level.h)

    def infer(
        self,
        latent: Latent,
        prev_action: Float[Array, "N A"],
        embed: Float[Array, "N D"],
        alive: Bool[Array, " N"],
        key: PRNGKey,
        train: bool = False,
    ) -> tuple[Latent, Float[Array, "N K C"]]:
        """h_t as in `recur`, then z^i_t ~ q(z^i_t | o^i_t, h^i_t), and the logits."""
        key_draw, key_dropout = jax.random.split(key)
        h = self.recur(latent, prev_action, key_dropout if train else None)
        logits = self.team.map(lambda nets, *seen: nets.posterior(*seen), h, embed)
        return Latent(Level(h, draw(logits, key_draw)), alive), logits

    def joint(
        self,
        memory: Latent,
        prev_action: Float[Array, "N A"],
        obs: Float[Array, "N O"],
        alive: Bool[Array, " N"],
        key: PRNGKey,
    ) -> Latent:
        """One step of execution, with everybody's observations in one place."""
        return still(self.infer(memory, prev_action, self.embed(obs), alive, key)[0])

    def features(self, memory: Latent) -> Features:
        """Policy inputs: (z_t, h_t), and the decoded observation if there is a decoder."""

        def one(nets: FilterNets, level: Level) -> Features:
            decoded = () if nets.decoder is None else (nets.decoder(*level.features()),)
            return *level.features(), *decoded

        return self.team.map(one, memory.level)


class DecoderNets(eqx.Module):
    """What one agent imagines with, beside its filter."""

    prior: Categoricals
    heads: Heads

    def __init__(self, spec: EnvSpec, config: WorldModelConfig, key: PRNGKey):
        key_prior, key_heads = jax.random.split(key)
        hidden, latent = config.hidden, config.latent
        self.prior = Categoricals((hidden,), hidden, latent, key_prior, config.activation)
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
            key=key_heads,
            activation=config.activation,
        )


class MAMBA(eqx.Module):
    """One level for every agent, whose recurrent input is a transformer over agents."""

    filter: JointFilter
    decoders: Team
    spec: EnvSpec = eqx.field(static=True)

    def __init__(
        self,
        spec: EnvSpec,
        config: WorldModelConfig,
        key: PRNGKey,
        communication: CommunicationConfig,
        shared: bool = True,
    ):
        if config.hidden % communication.n_heads:
            raise UserError(
                f"--world-model.hidden is {config.hidden}: give a multiple of the "
                f"{communication.n_heads} --communication.n-heads"
            )
        if config.levels_hold_rows:
            raise UserError(
                "--world-model.policy-input observation and --world-model.recurrent-sees row are "
                "not for mamba and mag, whose agents act on what they tell each other, which only "
                "latents hold: give latent or decoded, and latent"
            )
        key_filter, key_decoders = jax.random.split(key)
        self.spec = spec
        self.filter = JointFilter(spec, config, communication, shared, key_filter)
        self.decoders = Team(
            lambda key: DecoderNets(spec, config, key), spec.n_agents, shared, key_decoders
        )

    def initial(self) -> Latent:
        """The team's latent before an episode's first row."""
        return self.filter.learning()

    def encode(self, row: TimeStep) -> Inputs:
        """Encode actions and observations of one row."""
        return Inputs(
            prev_action=self.spec.action_space.encode(row.prev_action),
            obs=self.filter.embed(row.obs),
            alive=row.alive,
            is_first=row.is_first,
        )

    def observe(
        self, latent: Latent, inputs: Inputs, key: PRNGKey, train: bool = False
    ) -> tuple[Latent, dict[str, Float[Array, "N K C"]]]:
        """Posterior latents of the next row, and their logits; see `JointFilter.infer`."""
        latent, prev_action = forget((latent, inputs.prev_action), inputs.is_first)
        latent, logits = self.filter.infer(
            latent, prev_action, inputs.obs, inputs.alive, key, train
        )
        return latent, {"agent": logits}

    def prior(
        self, latent: Latent, key: PRNGKey
    ) -> tuple[Latent, dict[str, Float[Array, "N K C"]]]:
        """z^i_t ~ p(z^i_t | h^i_t) of every agent."""
        logits = self.decoders.map(lambda nets, h: nets.prior(h), latent.level.h)
        level = Level(latent.level.h, draw(logits, key))
        return Latent(level, latent.alive), {"agent": logits}

    def imagine(self, latent: Latent, action: Float[Array, "N A"], key: PRNGKey) -> Latent:
        """Prior latents of the next row; agents likelier dead than alive are not heard after it."""
        h = self.filter.recur(latent, action)
        after = still(self.prior(Latent(Level(h, latent.level.z), latent.alive), key)[0])
        return after._replace(alive=latent.alive & (self.predict(after).alive > 0))

    def with_life(self, latent: Latent, alive: Bool[Array, " N"]) -> Latent:
        """An imagined latent when these agents live; the others are not heard from then on."""
        return latent._replace(alive=alive)

    def predict(self, latent: Latent) -> Predictions:
        """Decode a row for every agent from its own latent."""

        def decode(nets: DecoderNets, seen: tuple[Part, ...]) -> Predictions:
            return nets.heads(seen[:2], seen[:2], *seen[2:])

        predicted = self.decoders.map(decode, self.filter.features(latent))
        return predicted._replace(obs=restored(predicted.obs, self.filter.scale))

    def actor_features(self, latent: Latent) -> Features:
        """Policy inputs: (z, h), and the decoded observation if there is a decoder."""
        return self.filter.features(latent)

    def critic_features(self, latent: Latent) -> Features:
        """The policy inputs: they already hold what teammates said."""
        return self.filter.features(latent)
