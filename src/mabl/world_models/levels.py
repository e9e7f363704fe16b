"""The parts that one level of a latent-variable model is made of (section 3.1.1)."""

from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mabl.envs.base import EnvSpec
from mabl.nets.categorical import Code, CodeShape, draw, still, unflatten
from mabl.nets.gru import GRU
from mabl.nets.mlp import MLP, Activation, Features, Linear, Part, Widths, activate
from mabl.nets.normaliser import Normaliser
from mabl.types import PRNGKey
from mabl.world_models.base import WorldModelConfig

Tree = TypeVar("Tree")


class Level(NamedTuple):
    """The latent of one level: deterministic embedding and stochastic state."""

    h: Float[Array, "*b D"]
    z: Code
    row: Float[Array, "*b F"] | None = None
    """The observation (agent level) or the state (global level), standardised: the real one where
    the latent is inferred, the decoded one where it is imagined. None where no network sees it."""

    @classmethod
    def none(cls, hidden: int, shape: CodeShape, row_dim: int = 0) -> "Level":
        """Before an episode's first row: zeros. A `row_dim` of 0 is a level that holds no row."""
        row = jnp.zeros(row_dim) if row_dim else None
        return cls(jnp.zeros(hidden), Code.none(shape), row)

    def features(self) -> Features:
        """(z, h), as networks see them."""
        return self.z, self.h


class Embedded(NamedTuple):
    """An observation or a state of one row, as a level's posterior needs it."""

    code: Float[Array, "*b D"]
    """Its encoding."""
    row: Float[Array, "*b F"] | None
    """Itself, standardised, for levels that hold it."""


class Recurrent(eqx.Module):
    """Recurrent model h_t = f(h_{t-1}, z_{t-1}, a_{t-1}): a GRU behind one hidden layer.

    With `row_dim` it also sees what the level holds of the row before, of `row_dim` numbers.
    """

    inputs: Linear
    cell: GRU
    activation: Activation = eqx.field(static=True)
    sees_row: bool = eqx.field(static=True)

    def __init__(
        self,
        latent: CodeShape,
        action_dim: int,
        hidden: int,
        key: PRNGKey,
        activation: Activation = "relu",
        row_dim: int = 0,
    ):
        self.activation, self.sees_row = activation, row_dim > 0
        key_inputs, key_cell = jax.random.split(key)
        seen = (latent, action_dim, row_dim) if row_dim else (latent, action_dim)
        self.inputs = Linear(seen, hidden, key_inputs)
        self.cell = GRU(hidden, hidden, key_cell)

    def __call__(self, level: Level, action: Float[Array, " A"]) -> Float[Array, " D"]:
        """One step; `action` is encoded, the agent's own or the joint one."""
        row = (level.row,) if self.sees_row else ()
        x = activate(self.inputs(level.z, action, *row), self.activation)  # pyright: ignore[reportArgumentType]
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


def row_decoder(config: WorldModelConfig, row_dim: int, key: PRNGKey) -> MLP:
    """Decoder of what a level encodes of a row, `[row_dim]`, from its (z, h)."""
    seen, n = (config.latent, config.hidden), config.n_hidden
    return MLP(seen, row_dim, config.hidden, n, key, activation=config.activation)


def partly_decoded(level: Level, decoder: MLP | None, share: float, key: PRNGKey) -> Level:
    """Replace the row that one level holds by what it decodes, with probability `share`.

    The level is returned as it is where it holds no row or `share` is 0.
    """
    if level.row is None or decoder is None or share == 0:
        return level
    decoded = decoder(*level.features())
    return level._replace(row=jnp.where(jax.random.bernoulli(key, share), decoded, level.row))


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
        if isinstance(after, Level):
            return after._replace(z=before.z, row=before.row)
        return after

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
    """The observation's decoder, where policies or recurrent models see observations."""
    scale: Normaliser | None
    """Running mean and variance of observations, by which they are standardised."""
    obs_dim: int = eqx.field(static=True)
    latent: CodeShape = eqx.field(static=True)
    hidden: int = eqx.field(static=True)
    policy_input: str = eqx.field(static=True)
    holds_row: bool = eqx.field(static=True)
    decoded_share: float = eqx.field(static=True)

    def __init__(self, spec: EnvSpec, config: WorldModelConfig, key: PRNGKey):
        hidden, latent, activation = config.hidden, config.latent, config.activation
        self.obs_dim, self.hidden, self.latent = spec.obs_dim, hidden, latent
        self.policy_input, self.holds_row = config.policy_input, config.levels_hold_rows
        self.decoded_share = config.decoded_share
        self.scale = Normaliser.fresh(spec.obs_dim) if config.standardise else None
        key_own, key_decoder = jax.random.split(key)
        key_encoder, key_recurrent, key_posterior = jax.random.split(key_own, 3)
        self.encoder = MLP(spec.obs_dim, hidden, hidden, 2, key_encoder, activation=activation)
        self.recurrent = Recurrent(
            latent,
            spec.action_space.size,
            hidden,
            key_recurrent,
            activation,
            spec.obs_dim if config.recurrent_sees == "row" else 0,
        )
        self.posterior = Categoricals((hidden, hidden), hidden, latent, key_posterior, activation)
        self.decoder = None
        if config.filter_decodes:
            self.decoder = row_decoder(config, spec.obs_dim, key_decoder)

    def learning(self) -> Level:
        """The latent before an episode's first row: zeros, through which gradients can flow."""
        return Level.none(self.hidden, self.latent, self.obs_dim if self.holds_row else 0)

    def initial(self) -> Level:
        """The same for execution, without a way for gradients."""
        return still(self.learning())

    def embed(self, obs: Float[Array, " O"]) -> Embedded:
        """Encode o_t^i; independent of the past, so that training does it outside the scan."""
        obs = standardised(obs, self.scale)
        return Embedded(self.encoder.embed(obs), obs if self.holds_row else None)

    def infer(
        self, level: Level, prev_action: Float[Array, " A"], obs: Embedded, key: PRNGKey
    ) -> tuple[Level, Float[Array, "K C"]]:
        """h_t = f(h_{t-1}, z_{t-1}, a_{t-1}^i), then z_t ~ q(z_t | o_t^i, h_t) and its logits."""
        h = self.recurrent(level, prev_action)
        logits = self.posterior(h, obs.code)
        return Level(h, draw(logits, key), obs.row), logits

    def imagined(self, h: Float[Array, " D"], z: Code) -> Level:
        """The latent of an imagined row, with the decoded observation if levels hold rows; no
        gradient flows through that observation."""
        level = Level(h, z)
        if not self.holds_row:
            return level
        return level._replace(row=jax.lax.stop_gradient(self.decoded(level)[0]))

    def partly_decoded(self, level: Level, key: PRNGKey) -> Level:
        """One agent's latent as recurrent models are trained on it (`decoded_share`)."""
        return partly_decoded(level, self.decoder, self.decoded_share, key)

    def __call__(
        self, level: Level, prev_action: Float[Array, " A"], obs: Float[Array, " O"], key: PRNGKey
    ) -> Level:
        """One step of execution; the caller resets `level` and `prev_action` at a first row."""
        return still(self.infer(level, prev_action, self.embed(obs), key)[0])

    def decoded(self, level: Level) -> tuple[Float[Array, " O"], ...]:
        """The standardised observation that (z, h) decodes to; nothing without a decoder."""
        return () if self.decoder is None else (self.decoder(*level.features()),)

    def seen(self, level: Level) -> tuple[Float[Array, " O"], ...]:
        """The observation as policies see it: decoded, the one that the level holds, or none."""
        if self.policy_input == "decoded":
            return self.decoded(level)
        return (level.row,) if self.policy_input == "observation" else ()  # pyright: ignore[reportReturnType]

    def features(self, level: Level) -> Features:
        """Input of one agent's policy: (z_t, h_t), both and the decoded observation, or the
        observation alone (`WorldModelConfig.policy_input`)."""
        if self.policy_input == "observation":
            return self.seen(level)
        return *level.features(), *self.seen(level)
