"""QMIX on latents [31]: the paper's value-based way to learn in imagination (section 3.3)."""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from einops import rearrange
from jaxtyping import Array, Bool, Float, Int

from mabl.behaviour.actor import MaskedCategorical
from mabl.behaviour.base import minibatch_of, minibatch_steps, minibatches
from mabl.envs.base import ActionSpace
from mabl.errors import require_between, require_positive
from mabl.losses.returns import lambda_returns
from mabl.nets.mlp import MLP, Features, Part, Width, parts_of, widths_of
from mabl.nets.optimiser import guarded
from mabl.types import Metrics, PRNGKey, Progress, Replayed, TeamView, Trajectory

Networks = TypeVar("Networks")


@dataclass(frozen=True)
class QMIXConfig:
    """Agents' values, their mixer, and how they are learned. Sizes are the paper's MAPPO's."""

    FLAG_PREFIX: ClassVar[str] = "qmix."

    hidden: int = 256
    """Width of the agents' value network."""
    n_hidden: int = 2
    """Hidden layers of the agents' value network."""
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
    """How far target networks move towards the learned ones after each minibatch."""
    n_epochs: int = 5
    """Passes over the imagined rows in one policy update."""
    batch_size: int = 2000
    """Joint rows in a minibatch."""
    epsilon_start: float = 1.0
    """Probability of a random action at the start."""
    epsilon_end: float = 0.05
    """Probability of a random action at the end."""
    epsilon_share: float = 0.25
    """Share of the run over which it falls."""

    def __post_init__(self) -> None:
        require_positive(self, "hidden", "n_hidden", "mixer_hidden", "hypernet_hidden")
        require_positive(self, "learning_rate", "grad_clip", "n_epochs", "batch_size")
        require_positive(self, "epsilon_share")
        require_between(self, 0, 1, "gamma", "td_lambda", "target_rate")
        require_between(self, 0, 1, "epsilon_start")
        require_between(self, 0, self.epsilon_start, "epsilon_end")


class EpsilonGreedy(eqx.Module):
    """Agent i's policy: the best action of Q_i(z_agent, h_agent), or with epsilon any available.

    Q_i sees what `WorldModelConfig.policy_input` says.
    """

    q: MLP
    epsilon: Float[Array, ""]

    def __call__(self, features: Features, available: Bool[Array, " A"]) -> MaskedCategorical:
        """The policy at one agent's features; where nothing is available, everything is."""
        may = available | ~available.any()
        q = self.q(*parts_of(features))
        best = jax.nn.one_hot(jnp.where(may, q, -jnp.inf).argmax(), may.shape[0])
        epsilon = jnp.minimum(self.epsilon, 0.999)  # the best action stays the likeliest
        probs = (1 - epsilon) * best + epsilon * may / may.sum()
        return MaskedCategorical.of(jnp.log(jnp.maximum(probs, 1e-20)), available)


class Mixer(eqx.Module):
    """Q_tot(Q_1 .. Q_N, z^{g,1} .. z^{g,N}), which never falls when a Q_i rises.

    Two layers whose weights networks compute from the global latents; weights on the Q_i and on
    what is made of them are made positive by their absolute values.
    """

    weight_in: MLP
    bias_in: MLP
    weight_out: MLP
    bias_out: MLP

    def __init__(self, n_agents: int, seen: Width, hidden: int, hypernet: int, key: PRNGKey):
        """`seen` is the width of all agents' features together."""
        keys = jax.random.split(key, 4)
        self.weight_in = MLP(seen, n_agents * hidden, hypernet, 1, keys[0])
        self.bias_in = MLP(seen, hidden, hypernet, 0, keys[1])
        self.weight_out = MLP(seen, hidden, hypernet, 1, keys[2])
        self.bias_out = MLP(seen, 1, hypernet, 1, keys[3])

    def __call__(self, q: Float[Array, " N"], features: Part) -> Float[Array, ""]:
        """The team's value of the agents' values `q`, given features `[N, ...]`."""
        seen = features.ravel()
        weight = rearrange(jnp.abs(self.weight_in(seen)), "(n e) -> n e", n=q.shape[0])
        hidden = jax.nn.elu(q @ weight + self.bias_in(seen))
        return hidden @ jnp.abs(self.weight_out(seen)) + self.bias_out(seen)[0]


class Values(NamedTuple):
    """The networks that target networks copy."""

    q: MLP
    mixer: Mixer

    def chosen(self, view: TeamView, action: Int[Array, " N"]) -> Float[Array, ""]:
        """Q_tot of a joint action."""
        q = jnp.take_along_axis(self.agents(view), action[:, None], axis=-1)[:, 0]
        return self.mixer(q, view.critic_features)

    def agents(self, view: TeamView) -> Float[Array, "N A"]:
        """Every Q_i."""
        return jax.vmap(self.q)(*parts_of(view.actor_features))

    def best(self, view: TeamView) -> Int[Array, " N"]:
        """The available action with the highest Q_i, for each agent."""
        may = view.available | ~view.available.any(-1, keepdims=True)
        return jnp.where(may, self.agents(view), -jnp.inf).argmax(-1)


class QState(NamedTuple):
    """Everything that learning to act changes."""

    values: Values
    target: Values
    opt: optax.OptState
    epsilon: Float[Array, ""]


class QRows(NamedTuple):
    """Joint rows of experience `[M, ...]`; targets and weights are the team's."""

    view: TeamView
    action: Array
    target: Float[Array, " M"]
    weight: Float[Array, " M"]


class QMIX(NamedTuple):
    """Values of each agent, mixed monotonically by what the global latents know."""

    config: QMIXConfig

    def init(self, view: TeamView, space: ActionSpace, key: PRNGKey) -> QState:
        """Fresh networks for features of the view's sizes."""
        config = self.config
        key_q, key_mixer = jax.random.split(key)
        (seen,) = widths_of(view.critic_features.ravel())
        seen_q = widths_of(view.actor_features)
        values = Values(
            MLP(seen_q, space.size, config.hidden, config.n_hidden, key_q),
            Mixer(
                view.alive.shape[0], seen, config.mixer_hidden, config.hypernet_hidden, key_mixer
            ),
        )
        target = jax.tree.map(jnp.copy, values)
        opt = self._optimiser().init(eqx.filter(values, eqx.is_array))
        return QState(values, target, opt, jnp.float32(config.epsilon_start))

    def actor(self, state: QState) -> EpsilonGreedy:
        """Epsilon-greedy; its mode is greedy."""
        return EpsilonGreedy(state.values.q, state.epsilon)

    def critic_features(self, model: Any, latent: Any) -> Part:
        """z_global of every agent, for the mixer. Raises TypeError for a model without them."""
        if not hasattr(model, "global_features"):
            raise TypeError(f"QMIX mixes by global latents, and {type(model).__name__} has none")
        return model.global_features(latent)

    def value(self, state: QState, view: TeamView) -> Float[Array, " N"]:
        """Q_tot of the best joint action, for everybody."""
        total = state.values.chosen(view, state.values.best(view))
        return jnp.broadcast_to(total, view.alive.shape)

    def gradient_steps(self, n_rows: int) -> int:
        """Minibatches of all epochs."""
        return minibatch_steps(n_rows, self.config.batch_size, self.config.n_epochs)

    def update(
        self,
        state: QState,
        trajectory: Trajectory,
        replayed: Replayed,
        key: PRNGKey,
        progress: Progress = 0.0,
    ) -> tuple[QState, Metrics]:
        """`n_epochs` of minibatch regression on one set of trajectories."""
        del replayed
        config = self.config
        rows, metrics = experience(state, trajectory, config)
        batches = minibatches(key, rows.target.shape[0], config.batch_size, config.n_epochs)

        def minibatch(state: QState, index: Array) -> tuple[QState, Metrics]:
            batch = minibatch_of(rows, index)
            gradient, metrics = eqx.filter_grad(td_loss, has_aux=True)(state.values, batch)
            step, opt = self._optimiser().update(gradient, state.opt)
            values = eqx.apply_updates(state.values, step)
            target = moved(state.target, values, config.target_rate)
            return QState(values, target, opt, state.epsilon), metrics

        state, history = jax.lax.scan(minibatch, state, batches)
        epsilon = annealed_epsilon(
            config.epsilon_start, config.epsilon_end, config.epsilon_share, progress
        )
        metrics |= jax.tree.map(jnp.mean, history) | {"behaviour/epsilon": epsilon}
        return state._replace(epsilon=epsilon), metrics

    def _optimiser(self) -> optax.GradientTransformation:
        return optimiser(self.config.learning_rate, self.config.grad_clip)


def annealed_epsilon(
    start: float, end: float, share: float, progress: Progress
) -> Float[Array, ""]:
    """Probability of a random action: it falls linearly over the first `share` of the run."""
    return start + (end - start) * jnp.clip(jnp.float32(progress) / share, 0, 1)


def optimiser(learning_rate: float, grad_clip: float) -> optax.GradientTransformation:
    """Adam behind gradient clipping."""
    return guarded(optax.chain(optax.clip_by_global_norm(grad_clip), optax.adam(learning_rate)))


def moved(target: Networks, learned: Networks, rate: float) -> Networks:
    """Target networks after a soft update: `rate` of the way to the learned ones."""
    return jax.tree.map(lambda old, new: old + rate * (new - old), target, learned)


def experience(state: QState, trajectory: Trajectory, config: QMIXConfig) -> tuple[QRows, Metrics]:
    """Double-Q targets of trajectories, flattened to joint rows.

    y_t = r_t+1 + gamma c_t+1 ((1 - lambda) Q_tot^-(t+1, argmax Q_i) + lambda y_t+1); rewards and
    the model's probabilities to go on are the team's mean.
    """

    def next_value(view: TeamView) -> Float[Array, ""]:
        return state.target.chosen(view, state.values.best(view))

    ahead = jax.tree.map(lambda x: x[1:], trajectory.view)
    reward, weight = trajectory.reward.mean(-1), trajectory.weight.mean(-1)
    target = lambda_returns(
        reward,
        config.gamma * trajectory.continues.mean(-1),
        jax.lax.map(jax.vmap(next_value), ahead),
        config.td_lambda,
    )
    view = jax.tree.map(lambda x: x[:-1], trajectory.view)
    rows = QRows(view, trajectory.action, target, weight)
    total = weight.sum() + 1e-8
    metrics = {
        "behaviour/imagined_reward": (weight * reward).sum() / total,
        "behaviour/imagined_return": (weight[0] * target[0]).sum() / (weight[0].sum() + 1e-8),
    }
    return jax.tree.map(lambda x: rearrange(x, "h b ... -> (h b) ..."), rows), metrics


def td_loss(values: Values, rows: QRows) -> tuple[Float[Array, ""], Metrics]:
    """Half the squared error of Q_tot to its targets."""
    value, total = jax.vmap(values.chosen)(rows.view, rows.action), rows.weight.sum() + 1e-8
    loss = 0.5 * (rows.weight * (value - rows.target) ** 2).sum() / total
    return loss, {
        "behaviour/critic_loss": loss,
        "behaviour/value": (rows.weight * value).sum() / total,
    }
