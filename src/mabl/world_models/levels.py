"""The parts that one level of a latent-variable model is made of (section 3.1.1)."""

from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mabl.nets.categorical import flatten, sample_straight_through, unflatten
from mabl.nets.mlp import MLP, Linear
from mabl.types import PRNGKey

Tree = TypeVar("Tree")


class Level(NamedTuple):
    """The latent of one level: deterministic embedding and stochastic state."""

    h: Float[Array, "*b D"]
    z: Float[Array, "*b KC"]

    def features(self) -> Float[Array, "*b F"]:
        """(z, h), as networks see them."""
        return jnp.concatenate([self.z, self.h], axis=-1)


class Recurrent(eqx.Module):
    """Recurrent model h_t = f(h_{t-1}, z_{t-1}, a_{t-1}): a GRU behind one ReLU layer."""

    inputs: Linear
    cell: eqx.nn.GRUCell

    def __init__(self, latent_dim: int, action_dim: int, hidden: int, key: PRNGKey):
        key_inputs, key_cell = jax.random.split(key)
        self.inputs = Linear(latent_dim + action_dim, hidden, key_inputs)
        self.cell = eqx.nn.GRUCell(hidden, hidden, key=key_cell)

    def __call__(self, level: Level, action: Float[Array, " A"]) -> Float[Array, " D"]:
        """One step; `action` is encoded, the agent's own or the joint one."""
        x = jax.nn.relu(self.inputs(jnp.concatenate([level.z, action])))
        return self.cell(x, level.h)


class Categoricals(eqx.Module):
    """Logits of K categoricals with C classes: a prior or a posterior."""

    mlp: MLP
    n_classes: int = eqx.field(static=True)

    def __init__(self, n_in: int, hidden: int, n_categoricals: int, n_classes: int, key: PRNGKey):
        self.mlp = MLP(n_in, n_categoricals * n_classes, hidden, 1, key)
        self.n_classes = n_classes

    def __call__(self, *inputs: Float[Array, " _"]) -> Float[Array, "K C"]:
        """Logits given the concatenation of the inputs."""
        return unflatten(self.mlp(jnp.concatenate(inputs)), self.n_classes)


def draw(logits: Float[Array, "*b K C"], key: PRNGKey) -> Float[Array, "*b KC"]:
    """Sample a latent state z, with straight-through gradients."""
    return flatten(sample_straight_through(logits, key))


def team_of(n_agents: int, own: Tree) -> Tree:
    """One agent's arrays, repeated along a new axis of agents."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (n_agents, *x.shape)), own)


def forget(past: Tree, is_first: Bool[Array, ""]) -> Tree:
    """Zeros at an episode's first row, else the past as it is."""
    return jax.tree.map(lambda x: jnp.where(is_first, jnp.zeros_like(x), x), past)


class AgentFilter(eqx.Module):
    """What an agent runs to know where it is: from its own observations and actions alone.

    There is no agent axis, no state and no teammate in its inputs, so that execution is
    decentralised by type.
    """

    encoder: MLP
    recurrent: Recurrent
    posterior: Categoricals
    obs_dim: int = eqx.field(static=True)
    latent_dim: int = eqx.field(static=True)
    hidden: int = eqx.field(static=True)

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        hidden: int,
        n_categoricals: int,
        n_classes: int,
        key: PRNGKey,
    ):
        key_encoder, key_recurrent, key_posterior = jax.random.split(key, 3)
        self.obs_dim = obs_dim
        self.latent_dim = n_categoricals * n_classes
        self.hidden = hidden
        self.encoder = MLP(obs_dim, hidden, hidden, 2, key_encoder)
        self.recurrent = Recurrent(self.latent_dim, action_dim, hidden, key_recurrent)
        self.posterior = Categoricals(2 * hidden, hidden, n_categoricals, n_classes, key_posterior)

    def initial(self) -> Level:
        """The latent before an episode's first row: zeros."""
        return Level(jnp.zeros(self.hidden), jnp.zeros(self.latent_dim))

    def embed(self, obs: Float[Array, " O"]) -> Float[Array, " D"]:
        """Encode o_t^i; independent of the past, so that training does it outside the scan."""
        return jax.nn.relu(self.encoder(obs))

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
        return self.infer(level, prev_action, self.embed(obs), key)[0]

    def features(self, level: Level) -> Float[Array, " F"]:
        """(z_t, h_t): what the policy sees."""
        return level.features()
