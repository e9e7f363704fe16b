"""The parts that one level of a latent-variable model is made of (section 3.1.1)."""

from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mabl.envs.base import EnvSpec
from mabl.nets.categorical import Code, CodeShape, draw, still, unflatten
from mabl.nets.gru import GRU
from mabl.nets.mlp import MLP, Activation, Features, Linear, Part, Widths, activate, parts_of
from mabl.nets.normaliser import Normaliser
from mabl.types import PRNGKey
from mabl.world_models.base import WorldModelConfig

Tree = TypeVar("Tree")


class Level(NamedTuple):
    """The latent of one level: deterministic embedding and stochastic state."""

    h: Float[Array, "*b D"]
    z: Code

    @classmethod
    def none(cls, hidden: int, shape: CodeShape) -> "Level":
        """Before an episode's first row: zeros."""
        return cls(jnp.zeros(hidden), Code.none(shape))

    def features(self) -> Features:
        """(z, h), as networks see them."""
        return self.z, self.h


class Recurrent(eqx.Module):
    """Recurrent model h_t = f(h_{t-1}, z_{t-1}, a_{t-1}): a GRU behind one hidden layer."""

    inputs: Linear
    cell: GRU
    activation: Activation = eqx.field(static=True)

    def __init__(
        self,
        latent: CodeShape,
        action_dim: int,
        hidden: int,
        key: PRNGKey,
        activation: Activation = "relu",
    ):
        self.activation = activation
        key_inputs, key_cell = jax.random.split(key)
        self.inputs = Linear((latent, action_dim), hidden, key_inputs)
        self.cell = GRU(hidden, hidden, key_cell)

    def __call__(self, level: Level, action: Float[Array, " A"]) -> Float[Array, " D"]:
        """One step; `action` is encoded, the agent's own or the joint one."""
        x = activate(self.inputs(level.z, action), self.activation)
        return self.cell(x, level.h)


class Categoricals(eqx.Module):
    """Logits of K categoricals with C classes: a prior or a posterior."""

    mlp: MLP
    n_classes: int = eqx.field(static=True)

    def __init__(
        self,
        n_in: Widths,
        hidden: int,
        shape: CodeShape,
        key: PRNGKey,
        activation: Activation = "relu",
    ):
        n_out = shape.n_categoricals * shape.n_classes
        self.mlp = MLP(n_in, n_out, hidden, 1, key, activation=activation)
        self.n_classes = shape.n_classes

    def __call__(self, *inputs: Part) -> Float[Array, "K C"]:
        """Logits given the inputs."""
        return unflatten(self.mlp(*inputs), self.n_classes)


def policy_decoder(config: WorldModelConfig, obs_dim: int, key: PRNGKey) -> MLP | None:
    """Decoder of observations for the filter, or None if policies see the latent alone."""
    if config.policy_input == "latent":
        return None
    seen, n = (config.latent, config.hidden), config.n_hidden
    return MLP(seen, obs_dim, config.hidden, n, key, activation=config.activation)


def with_decoded(features: Features, decoder: MLP | None) -> Features:
    """(z, h) and, if there is a decoder, the observation decoded from them."""
    return features if decoder is None else (*parts_of(features), decoder(*parts_of(features)))


def team_of(n_agents: int, own: Tree) -> Tree:
    """One agent's arrays, repeated along a new axis of agents."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (n_agents, *x.shape)), own)


def forget(past: Tree, is_first: Bool[Array, ""]) -> Tree:
    """Zeros, and codes of nothing, at an episode's first row, else the past as it is."""

    def zeros(x: Any) -> Any:
        if isinstance(x, Code):
            index = jnp.where(is_first, x.n_classes, x.index)
            return Code(index, forget(x.tilt, is_first), x.n_classes)
        return jnp.where(is_first, jnp.zeros_like(x), x)

    return jax.tree.map(zeros, past, is_leaf=lambda x: isinstance(x, Code))


def arriving(before: Tree, after: Tree) -> Tree:
    """Latent of a transition: z of the row before, h of the row after, at every level.

    It knows the action and the past, and nothing that the row after shows.
    """

    def mix(before: Any, after: Any) -> Any:
        return Level(after.h, before.z) if isinstance(after, Level) else after

    return jax.tree.map(mix, before, after, is_leaf=lambda x: isinstance(x, Level))


def standardised(x: Float[Array, "*b F"], scale: Normaliser | None) -> Float[Array, "*b F"]:
    """Features with zero mean and unit variance, if there is a scale; it is not trained."""
    return x if scale is None else jax.lax.stop_gradient(scale).normalise(x)


def restored(x: Float[Array, "*b F"], scale: Normaliser | None) -> Float[Array, "*b F"]:
    """The inverse of `standardised`."""
    return x if scale is None else jax.lax.stop_gradient(scale).restore(x)


class AgentFilter(eqx.Module):
    """What an agent runs to know where it is: from its own observations and actions alone.

    There is no agent axis, no state and no teammate in its inputs, so that execution is
    decentralised by type.
    """

    encoder: MLP
    recurrent: Recurrent
    posterior: Categoricals
    decoder: MLP | None
    """The observation's decoder, where policies see what it decodes."""
    scale: Normaliser | None
    """Running mean and variance of observations, by which they are standardised."""
    obs_dim: int = eqx.field(static=True)
    latent: CodeShape = eqx.field(static=True)
    hidden: int = eqx.field(static=True)

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        hidden: int,
        latent: CodeShape,
        key: PRNGKey,
        standardise: bool = False,
        activation: Activation = "relu",
        decoder: MLP | None = None,
    ):
        self.decoder = decoder
        self.scale = Normaliser.fresh(obs_dim) if standardise else None
        key_encoder, key_recurrent, key_posterior = jax.random.split(key, 3)
        self.obs_dim, self.latent, self.hidden = obs_dim, latent, hidden
        self.encoder = MLP(obs_dim, hidden, hidden, 2, key_encoder, activation=activation)
        self.recurrent = Recurrent(latent, action_dim, hidden, key_recurrent, activation)
        self.posterior = Categoricals((hidden, hidden), hidden, latent, key_posterior, activation)

    @classmethod
    def of(cls, spec: EnvSpec, config: WorldModelConfig, key: PRNGKey) -> "AgentFilter":
        """The filter of an environment's agents, as `config` sizes it."""
        key_own, key_decoder = jax.random.split(key)
        return cls(
            spec.obs_dim,
            spec.action_space.size,
            config.hidden,
            config.latent,
            key_own,
            config.standardise,
            config.activation,
            policy_decoder(config, spec.obs_dim, key_decoder),
        )

    def initial(self) -> Level:
        """The latent before an episode's first row: zeros."""
        return still(Level.none(self.hidden, self.latent))

    def embed(self, obs: Float[Array, " O"]) -> Float[Array, " D"]:
        """Encode o_t^i; independent of the past, so that training does it outside the scan."""
        return self.encoder.embed(standardised(obs, self.scale))

    def infer(
        self, level: Level, prev_action: Float[Array, " A"], embed: Float[Array, " D"], key: PRNGKey
    ) -> tuple[Level, Float[Array, "K C"]]:
        """h_t = f(h_{t-1}, z_{t-1}, a_{t-1}^i), then z_t ~ q(z_t | o_t^i, h_t) and its logits."""
        h = self.recurrent(level, prev_action)
        logits = self.posterior(h, embed)
        return Level(h, draw(logits, key)), logits

    def __call__(
        self, level: Level, prev_action: Float[Array, " A"], obs: Float[Array, " O"], key: PRNGKey
    ) -> Level:
        """One step of execution; the caller resets `level` and `prev_action` at a first row."""
        return still(self.infer(level, prev_action, self.embed(obs), key)[0])

    def features(self, level: Level) -> Features:
        """Input of one agent's policy: (z_t, h_t), and the decoded observation if there is a
        decoder."""
        return with_decoded(level.features(), self.decoder)
