"""Recurrent QMIX on real rows [31]: its networks, TD(lambda) targets and the loss of a batch."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from einops import rearrange
from jaxtyping import Array, Bool, Float

from mabl.behaviour.qmix import Mixer, QRows, Values, td_loss
from mabl.behaviour.recurrent import RecurrentFilter
from mabl.envs.base import Discrete, EnvSpec
from mabl.errors import UserError, require_between, require_positive
from mabl.losses.returns import returns_across_resets
from mabl.nets.mlp import MLP
from mabl.rows import TimeStep
from mabl.types import Metrics, PRNGKey, TeamView


@dataclass(frozen=True)
class RecurrentQMIXConfig:
    """QMIX on replayed episodes. Sizes, learning rate and lambda are PyMARL's for SMAC."""

    FLAG_PREFIX: ClassVar[str] = "recurrent-qmix."

    hidden: int = 64
    """Width of the agents' recurrent network."""
    mixer_hidden: int = 32
    """Width of the mixer."""
    hypernet_hidden: int = 64
    """Width of the networks that make the mixer's weights."""
    learning_rate: float = 5e-4
    """Adam's learning rate."""
    grad_clip: float = 10.0
    """Largest global norm of the gradient."""
    gamma: float = 0.99
    """Discount factor."""
    td_lambda: float = 0.6
    """Lambda of the returns that values are regressed on; 0: one-step targets."""
    target_rate: float = 0.01
    """Share of the way that target networks move towards the learned ones after each update."""
    batch_size: int = 32
    """Sequences in the batch of an update."""
    batch_length: int = 50
    """Rows of a sequence, through which gradients flow back in time."""
    burn_in: int = 10
    """Rows at the start of a sequence that only fill the memory, and count for no loss; rows from a
    reset on count."""
    epsilon_start: float = 1.0
    """Probability of a random action at the start."""
    epsilon_end: float = 0.05
    """Probability of a random action at the end."""
    epsilon_share: float = 0.25
    """Share of the run over which it falls."""

    def __post_init__(self) -> None:
        require_positive(self, "hidden", "mixer_hidden", "hypernet_hidden")
        require_positive(self, "learning_rate", "grad_clip", "batch_size", "batch_length")
        require_positive(self, "epsilon_share")
        require_between(self, 0, 1, "gamma", "td_lambda", "target_rate", "epsilon_start")
        require_between(self, 0, self.epsilon_start, "epsilon_end")
        if not 0 <= self.burn_in <= self.batch_length - 2:
            raise UserError(
                f"--recurrent-qmix.burn-in is {self.burn_in}: give a number from 0 to 2 less than "
                f"the {self.batch_length} rows of --recurrent-qmix.batch-length"
            )


class ActionFilter(eqx.Module):
    """A `RecurrentFilter` of an agent's own observations and previous actions.

    A `LocalFilter`: its memory is the GRU's hidden state.
    """

    recurrent: RecurrentFilter
    obs_dim: int = eqx.field(static=True)

    def __init__(self, obs_dim: int, n_actions: int, hidden: int, key: PRNGKey):
        self.obs_dim = obs_dim
        self.recurrent = RecurrentFilter(obs_dim + n_actions, hidden, key)

    def initial(self) -> Float[Array, " D"]:
        """The memory before an episode's first row: zeros."""
        return self.recurrent.initial()

    def __call__(
        self, memory: Array, prev_action: Float[Array, " A"], obs: Float[Array, " O"], key: PRNGKey
    ) -> Float[Array, " D"]:
        """One step of execution; the previous action is one-hot, and zeros at a first row."""
        return self.recurrent(memory, prev_action, jnp.concatenate([obs, prev_action]), key)

    def features(self, memory: Float[Array, "*b D"]) -> Float[Array, "*b D"]:
        """The input of the agent's values."""
        return self.recurrent.features(memory)

    def unroll(
        self,
        memory: Float[Array, " D"],
        prev_action: Float[Array, "T A"],
        obs: Float[Array, "T O"],
        is_first: Bool[Array, " T"],
    ) -> Float[Array, "T D"]:
        """Memories after each row of one agent's sequence; first rows reset memory and action."""
        prev_action = jnp.where(is_first[:, None], 0.0, prev_action)
        seen = jnp.concatenate([obs, prev_action], axis=-1)
        return self.recurrent.unroll(memory, seen, is_first)[1]


class QNetworks(NamedTuple):
    """The networks that target networks copy: the agents' memory, their values and the mixer."""

    filter: ActionFilter
    values: Values

    @classmethod
    def fresh(cls, spec: EnvSpec, config: RecurrentQMIXConfig, key: PRNGKey) -> "QNetworks":
        """Initialise for an environment with discrete actions; values are linear in memories."""
        key_filter, key_q, key_mixer = jax.random.split(key, 3)
        n_actions = spec.action_space.size
        return cls(
            ActionFilter(spec.obs_dim, n_actions, config.hidden, key_filter),
            Values(
                MLP(config.hidden, n_actions, config.hidden, 0, key_q),
                Mixer(
                    spec.n_agents,
                    spec.state_dim,
                    config.mixer_hidden,
                    config.hypernet_hidden,
                    key_mixer,
                ),
            ),
        )

    def view(self, rows: TimeStep) -> TeamView:
        """Inputs of values and mixer along one sequence `[T, ...]`, from an empty memory.

        The mixer's input is the state, `[T, S]`.
        """
        actions = Discrete(rows.available.shape[-1]).encode(rows.prev_action)
        unroll = jax.vmap(self.filter.unroll, in_axes=(None, 1, 1, None), out_axes=1)
        memory = unroll(self.filter.initial(), actions, rows.obs, rows.is_first)
        return TeamView(self.filter.features(memory), rows.state, rows.available, rows.alive)

    def greedy(self, rows: TimeStep) -> Float[Array, " T"]:
        """Q_tot of the best available joint action at each row of one sequence."""
        view = self.view(rows)
        return jax.vmap(self.values.chosen)(view, jax.vmap(self.values.best)(view))


def td_targets(
    value: Float[Array, " T"], rows: TimeStep, config: RecurrentQMIXConfig
) -> tuple[Float[Array, "T-1"], Float[Array, "T-1"]]:
    """Lambda-returns of the team at all rows of a sequence but the last, and how much they count.

    y_t = r_{t+1} + gamma c_{t+1} ((1 - lambda) V_{t+1} + lambda y_{t+1}) as in Peng's Q(lambda),
    without importance weights, where `value` is V and r the mean of the agents' rewards. The team's
    episode is terminated (c = 0) when all its agents are. Transitions to a reset weigh 0, and so do
    those from the first `burn_in` rows, as far as no reset precedes them in the sequence.
    """
    is_first = rows.is_first[1:]
    target = returns_across_resets(
        value,
        rows.reward[1:].mean(-1),
        rows.terminated[1:].all(-1),
        is_first,
        config.gamma,
        config.td_lambda,
    )
    from_reset = jnp.cumsum(rows.is_first[:-1]) > 0
    warm = from_reset | (jnp.arange(target.shape[0]) >= config.burn_in)
    return target, 1.0 * (warm & ~is_first)


def replay_loss(
    online: QNetworks, target: QNetworks, rows: TimeStep, config: RecurrentQMIXConfig
) -> tuple[Float[Array, ""], Metrics]:
    """Half the squared error of Q_tot to double-Q targets, on real sequences `[B, T, ...]`.

    V_t in the targets is the target networks' value of the joint action that the online networks
    prefer, each on memories of their own [H. van Hasselt et al., "Deep Reinforcement Learning with
    Double Q-learning"]. No gradient flows into the targets.
    """
    view = jax.vmap(online.view)(rows)
    best = jax.vmap(jax.vmap(online.values.best))(view)
    value = jax.vmap(jax.vmap(target.values.chosen))(jax.vmap(target.view)(rows), best)
    returns, weight = jax.vmap(lambda value, rows: td_targets(value, rows, config))(
        jax.lax.stop_gradient(value), rows
    )
    before = jax.tree.map(lambda x: x[:, :-1], view)
    batch = QRows(before, rows.prev_action[:, 1:], returns, weight)
    batch = jax.tree.map(lambda x: rearrange(x, "b t ... -> (b t) ..."), batch)
    loss, metrics = td_loss(online.values, batch)
    metrics["behaviour/return"] = (weight * returns).sum() / (weight.sum() + 1e-8)
    return loss, metrics
