"""What a model-free agent remembers: an encoder and a GRU that learn through PPO alone [46]."""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from mabl.behaviour.actor import Choice
from mabl.behaviour.base import ActorFunction
from mabl.behaviour.ppo import PPORows, kl_of_choices, policy_loss, weighted_mean
from mabl.errors import UserError, require_between, require_positive
from mabl.nets.gru import GRU
from mabl.nets.mlp import Linear
from mabl.nets.normaliser import Normaliser
from mabl.types import Metrics, PRNGKey, TeamView

HUBER_DELTA = 10.0
"""Beyond it the critic's loss is linear; in standard deviations of the returns."""

ValueFunction = Callable[[Float[Array, "N G"], Bool[Array, " N"]], Float[Array, " N"]]
"""What a critic is to the loss: observations of a team, and who is alive to be heard, to a value
for each agent. The dead see nothing that others do not."""


@dataclass(frozen=True)
class RecurrentMAPPOConfig:
    """MAPPO on real rows. Defaults are its published recipe for SMAC [46]."""

    FLAG_PREFIX: ClassVar[str] = "recurrent-mappo."

    hidden: int = 64
    """Width of policy and critic."""
    n_heads: int = 8
    """Heads of the critic's self-attention over agents."""
    actor_out_scale: float = 0.01
    """Scale of the policy's last layer at the start."""
    initial_std: float = 0.5
    """Standard deviation of continuous actions, which lie in [-1, 1], at the start."""
    learning_rate: float = 5e-4
    """Adam's learning rate for policy and critic."""
    grad_clip: float = 10.0
    """Largest global norm of the policy's and the critic's gradient."""
    gamma: float = 0.99
    """Discount factor."""
    gae_lambda: float = 0.95
    """Lambda of the returns."""
    clip: float = 0.2
    """PPO's clipping range of the probability ratio."""
    n_epochs: int = 5
    """Passes over the rows of a cycle."""
    n_minibatches: int = 1
    """Minibatches of a pass, at most."""
    chunk_length: int = 10
    """Rows through which gradients flow back in time; a divisor of --training.collect-steps."""
    ent_coef: float = 0.01
    """Entropy bonus."""
    value_coef: float = 1.0
    """Factor on the critic's loss."""
    value_decay: float = 0.99
    """What remains, after each cycle, of the running mean and variance that returns are normalised
    by."""
    team_reward: bool = True
    """Average rewards over agents."""

    def __post_init__(self) -> None:
        require_positive(self, "hidden", "n_heads", "learning_rate", "grad_clip", "clip")
        require_positive(self, "initial_std")
        require_positive(self, "n_epochs", "n_minibatches", "chunk_length")
        require_between(self, 0, 1, "gamma", "gae_lambda", "value_decay")
        require_between(self, 0, inf, "actor_out_scale", "ent_coef", "value_coef")
        if self.hidden % self.n_heads:
            raise UserError(
                f"--recurrent-mappo.hidden is {self.hidden}: give a multiple of its "
                f"{self.n_heads} heads"
            )


class RecurrentFilter(eqx.Module):
    """LayerNorm, two layers with LayerNorm after ReLU, a GRU, LayerNorm: one agent's own past.

    A `LocalFilter`: its memory is the GRU's hidden state.
    """

    norm_in: eqx.nn.LayerNorm
    layers: list[Linear]
    norms: list[eqx.nn.LayerNorm]
    cell: GRU
    norm_out: eqx.nn.LayerNorm
    obs_dim: int = eqx.field(static=True)
    hidden: int = eqx.field(static=True)

    def __init__(self, obs_dim: int, hidden: int, key: PRNGKey):
        key_in, key_hidden, key_cell = jax.random.split(key, 3)
        self.obs_dim, self.hidden = obs_dim, hidden
        self.norm_in = eqx.nn.LayerNorm(obs_dim)
        self.layers = [Linear(obs_dim, hidden, key_in), Linear(hidden, hidden, key_hidden)]
        self.norms = [eqx.nn.LayerNorm(hidden) for _ in self.layers]
        self.cell = GRU(hidden, hidden, key_cell)
        self.norm_out = eqx.nn.LayerNorm(hidden)

    def initial(self) -> Float[Array, " D"]:
        """Nothing to remember: zeros."""
        return jnp.zeros(self.hidden)

    def embed(self, obs: Float[Array, " O"]) -> Float[Array, " D"]:
        """Encode o_t; independent of the past."""
        x = self.norm_in(obs)
        for layer, norm in zip(self.layers, self.norms, strict=True):
            x = norm(jax.nn.relu(layer(x)))
        return x

    def __call__(
        self, memory: Array, prev_action: Array, obs: Float[Array, " O"], key: PRNGKey
    ) -> Float[Array, " D"]:
        """One step of execution, by the observation alone."""
        del prev_action, key
        return self.cell(self.embed(obs), memory)

    def features(self, memory: Float[Array, "*b D"]) -> Float[Array, "*b D"]:
        """What the policy sees."""
        return jnp.vectorize(self.norm_out, signature="(d)->(d)")(memory)

    def unroll(
        self,
        memory: Float[Array, " D"],
        obs: Float[Array, "T O"],
        is_first: Bool[Array, " T"],
    ) -> tuple[Float[Array, "T D"], Float[Array, "T D"]]:
        """Memories before and after each row of one agent's sequence; forgotten at first rows."""

        def step(memory: Array, at: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
            embed, is_first = at
            before = jnp.where(is_first, self.initial(), memory)
            after = self.cell(embed, before)
            return after, (before, after)

        return jax.lax.scan(step, memory, (jax.vmap(self.embed)(obs), is_first))[1]


class Chunks(NamedTuple):
    """Pieces of real sequences `[M, L, ...]`, and each agent's memory where they begin."""

    memory: Float[Array, "M N D"]
    obs: Float[Array, "M L N O"]
    is_first: Bool[Array, "M L"]
    rows: PPORows
    """`[M, L, N, ...]`; actor features are memories that the collecting policy had."""


def policies(filter: RecurrentFilter, actor: ActorFunction, view: TeamView) -> Choice:
    """The policy at memories `[*b, T, N, D]` and availabilities of a view with two leading axes."""
    features = filter.features(view.actor_features)
    return jax.vmap(jax.vmap(jax.vmap(actor)))(features, view.available)


def recurrent_policy_loss(
    policy: Any, chunks: Chunks, ent_coef: Float[Array, ""], clip: float
) -> tuple[Float[Array, ""], Metrics]:
    """PPO's loss of a recurrent policy (a filter and an actor), unrolled from stored memories."""
    return policy_loss(unrolled(policy, chunks), chunks.rows, ent_coef, clip)


def recurrent_update_kl(policy: Any, chunks: Chunks) -> Float[Array, ""]:
    """KL(old || new) on chunks whose actions the old policy drew; see `mappo.update_kl`."""
    return kl_of_choices(unrolled(policy, chunks), chunks.rows)


def unrolled(policy: Any, chunks: Chunks) -> Choice:
    """The policy at every row of chunks, from the memories stored where they begin."""
    unroll = jax.vmap(policy.filter.unroll, in_axes=(0, 1, None), out_axes=1)
    _, memory = jax.vmap(unroll)(chunks.memory, chunks.obs, chunks.is_first)
    view = chunks.rows.view._replace(actor_features=memory)
    return policies(policy.filter, policy.actor, view)


def value_loss(
    critic: ValueFunction, rows: PPORows, returns: Normaliser, value_coef: float
) -> tuple[Float[Array, ""], Metrics]:
    """`value_coef` times the Huber loss to the normalised returns; the critic speaks normalised."""
    value = jax.vmap(jax.vmap(critic))(rows.view.critic_features, rows.view.alive)
    loss = optax.huber_loss(value, returns.normalise(rows.target), delta=HUBER_DELTA)
    loss = value_coef * weighted_mean(loss, rows.value_weight)
    return loss, {"behaviour/critic_loss": loss}
