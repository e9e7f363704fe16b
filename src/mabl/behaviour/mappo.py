"""Multi-agent PPO on latent trajectories (section 3.3, Table 3, [46])."""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from einops import rearrange
from jaxtyping import Array, Float

from mabl.behaviour.actor import Actor, ContinuousActor, actor_for, has_choice
from mabl.behaviour.base import (
    ActorFunction,
    annealed,
    divided,
    minibatch_of,
    minibatch_steps,
    minibatches,
)
from mabl.behaviour.critic import Critic
from mabl.behaviour.ppo import (
    PPORows,
    kl_of_choices,
    policy_loss,
    real_returns,
    shared_reward,
    weighted_mean,
)
from mabl.envs.base import ActionSpace
from mabl.errors import UserError, require_between, require_positive
from mabl.losses.returns import lambda_returns
from mabl.nets.mlp import Features, widths_of
from mabl.nets.normaliser import Normaliser
from mabl.nets.optimiser import guarded
from mabl.types import Metrics, PRNGKey, Progress, Replayed, TeamView, Trajectory


@dataclass(frozen=True)
class MAPPOConfig:
    """Actor, critic and PPO. Defaults are the paper's (Tables 3 and 4)."""

    FLAG_PREFIX: ClassVar[str] = "mappo."

    hidden: int = 256
    """Width of actor and critic."""
    n_hidden: int = 2
    """Hidden layers of actor and critic."""
    n_heads: int = 8
    """Heads of the critic's self-attention over agents."""
    actor_out_scale: float = 1.0
    """Scale of the actor's last layer at the start; 0.01 starts with a uniform policy."""
    initial_std: float = 0.5
    """Standard deviation of continuous actions, which lie in [-1, 1], at the start."""
    actor_learning_rate: float = 1e-4
    """Adam's learning rate for the actor."""
    critic_learning_rate: float = 1e-3
    """Adam's learning rate for the critic."""
    actor_weight_decay: float = 1e-5
    """L2 penalty on the actor's weights, through the gradient."""
    grad_clip: float = 100.0
    """Largest global norm of actor's and critic's gradients."""
    gamma: float = 0.99
    """Discount factor."""
    gae_lambda: float = 0.95
    """Lambda of the returns."""
    clip: float = 0.2
    """PPO's clipping range of the probability ratio."""
    n_epochs: int = 5
    """Passes over the imagined rows in one policy update."""
    batch_size: int = 2000
    """Joint rows in a PPO minibatch."""
    ent_coef: float = 0.001
    """Entropy bonus at the start."""
    ent_final: float | None = None
    """Entropy bonus at the end of the run, which it approaches geometrically with the share of
    `total_steps` that is done; None: it falls by `ent_decay`, as in the paper."""
    ent_decay: float = 0.99998
    """Factor on the entropy bonus after every minibatch, where there is no `ent_final`."""
    value_coef: float = 0.5
    """Factor on the critic's squared error."""
    value_decay: float = 1.0
    """What remains, after each policy update, of the running mean and variance that returns are
    normalised by; 1 in the paper: they are not normalised."""
    replay_value_coef: float = 0.0
    """Weight of the critic's error on replayed sequences beside that on imagined ones (ADR 8); 0 in
    the paper."""
    critic_rows: Literal["all", "starts"] = "all"
    """Imagined rows that the critic learns from: all, as in the paper, or the start rows alone,
    whose latents are inferred from real observations (ADR 22)."""
    normalise_advantage: bool = True
    """Give advantages zero mean and unit variance over the imagined rows that the policy's loss
    counts."""
    advantage_floor: float = 0.0
    """Smallest standard deviation that advantages are divided by, in scaled rewards: differences
    below it are treated as noise. 0 in the paper."""
    team_reward: bool = True
    """Average predicted rewards over agents (SMAC, MAMuJoCo)."""
    global_critic: bool = False
    """Show critics the global latent alone (Flatland, appendix B.1), where a model has one."""

    def __post_init__(self) -> None:
        require_positive(self, "hidden", "n_hidden", "n_heads", "n_epochs", "batch_size")
        require_positive(
            self, "initial_std", "actor_learning_rate", "critic_learning_rate", "grad_clip", "clip"
        )
        require_between(self, 0, 1, "gamma", "gae_lambda", "ent_decay", "value_decay")
        require_between(self, 0, inf, "actor_weight_decay", "ent_coef", "value_coef")
        require_between(self, 0, inf, "replay_value_coef", "advantage_floor", "ent_final")
        if self.hidden % self.n_heads:
            raise UserError(
                f"--mappo.hidden is {self.hidden}: give a multiple of its {self.n_heads} heads"
            )


ValueFunction = Callable[[Features], Float[Array, " N"]]
"""What a critic is to the losses: features of a team to a value for each agent.

The dead are heard too: their latents are no padding, and know of the team (ADR 9).
"""


class ActorCritic(NamedTuple):
    """Everything that learning to act changes."""

    actor: Actor | ContinuousActor
    critic: Critic
    actor_opt: optax.OptState
    critic_opt: optax.OptState
    ent_coef: Float[Array, ""]
    returns: Normaliser
    """Of what the critic learns."""

    def value(self, features: Features) -> Float[Array, " N"]:
        """The critic's, in the rewards' units."""
        return self.returns.restore(self.critic(features))


class ValueRows(NamedTuple):
    """Joint rows, real or imagined, `[*b, N, ...]`, as the critic learns from them."""

    view: TeamView
    target: Array
    value_weight: Array


class MAPPO(NamedTuple):
    """Multi-agent PPO: a shared actor, and a shared centralised critic on what all models offer."""

    config: MAPPOConfig

    def init(self, view: TeamView, space: ActionSpace, key: PRNGKey) -> ActorCritic:
        """Fresh networks for features of the view's sizes."""
        config = self.config
        key_actor, key_critic = jax.random.split(key)
        actor = actor_for(
            space,
            widths_of(view.actor_features),
            config.hidden,
            config.n_hidden,
            config.actor_out_scale,
            config.initial_std,
            key_actor,
        )
        seen = widths_of(view.critic_features)
        critic = Critic(seen, config.hidden, config.n_hidden, config.n_heads, key_critic)
        actor_optimiser, critic_optimiser = optimisers(config)
        return ActorCritic(
            actor=actor,
            critic=critic,
            actor_opt=actor_optimiser.init(eqx.filter(actor, eqx.is_array)),
            critic_opt=critic_optimiser.init(eqx.filter(critic, eqx.is_array)),
            ent_coef=jnp.float32(config.ent_coef),
            returns=Normaliser.fresh(),
        )

    def actor(self, state: ActorCritic) -> Actor | ContinuousActor:
        """The policy."""
        return state.actor

    def critic_features(self, model: Any, latent: Any) -> Features:
        """All that the model has for critics, or its global latents alone."""
        if self.config.global_critic and hasattr(model, "global_features"):
            return model.global_features(latent)
        return model.critic_features(latent)

    def value(self, state: ActorCritic, view: TeamView) -> Float[Array, " N"]:
        """The critic's."""
        return state.value(view.critic_features)

    def gradient_steps(self, n_rows: int) -> int:
        """Minibatches of all epochs."""
        return minibatch_steps(n_rows, self.config.batch_size, self.config.n_epochs)

    def update(
        self,
        state: ActorCritic,
        trajectory: Trajectory,
        replayed: Replayed,
        key: PRNGKey,
        progress: Progress = 0.0,
    ) -> tuple[ActorCritic, Metrics]:
        """`n_epochs` of minibatch PPO on one set of trajectories (Algorithm 1, lines 12-13).

        With `replay_value_coef` the critic learns from replayed rows too, which each epoch divides
        among its minibatches.
        """
        if self.config.ent_final is not None:
            ent_coef = annealed(self.config.ent_coef, self.config.ent_final, progress)
            state = state._replace(ent_coef=ent_coef)
        real = None
        if self.config.replay_value_coef:
            real = jax.vmap(lambda replayed: replayed_values(state.value, replayed, self.config))(
                replayed
            )
            real = jax.tree.map(lambda x: rearrange(x, "b t ... -> (b t) ..."), real)
        return update(state, trajectory, key, self.config, real)


def optimisers(
    config: MAPPOConfig,
) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """Adam for the actor (with weight decay) and the critic, behind gradient clipping."""
    actor = optax.chain(
        optax.clip_by_global_norm(config.grad_clip),
        optax.add_decayed_weights(config.actor_weight_decay),
        optax.adam(config.actor_learning_rate),
    )
    critic = optax.chain(
        optax.clip_by_global_norm(config.grad_clip), optax.adam(config.critic_learning_rate)
    )
    return guarded(actor), guarded(critic)


def experience(
    critic: ValueFunction, trajectory: Trajectory, config: MAPPOConfig
) -> tuple[PPORows, Metrics]:
    """Lambda-returns and advantages of trajectories, flattened to joint rows, start rows first."""
    weight, reward = trajectory.weight, shared_reward(trajectory.reward, config.team_reward)
    view = trajectory.view
    # Row by row of the horizon: the networks in between take more memory than all they see.
    value = jax.lax.map(jax.vmap(critic), view.critic_features)
    target = lambda_returns(
        reward, config.gamma * trajectory.continues, value[1:], config.gae_lambda
    )
    advantage = target - value[:-1]
    counted = weight * view.alive[:-1] * has_choice(trajectory.action, view.available[:-1])
    centred = advantage - weighted_mean(advantage, counted)
    std = jnp.sqrt(weighted_mean(centred**2, counted))
    metrics = {
        "behaviour/imagined_reward": weighted_mean(reward, weight),
        "behaviour/imagined_return": weighted_mean(target[0], weight[0]),
        "behaviour/value": weighted_mean(value[:-1], weight),
        "behaviour/advantage_std": std,
    }
    rows = PPORows(
        jax.tree.map(lambda x: x[:-1], view),
        trajectory.action,
        trajectory.log_prob,
        centred / (jnp.maximum(std, config.advantage_floor) + 1e-5)
        if config.normalise_advantage
        else advantage,
        target,
        weight,
        weight,
    )
    return jax.tree.map(lambda x: rearrange(x, "h b ... -> (h b) ..."), rows), metrics


def replayed_values(critic: ValueFunction, replayed: Replayed, config: MAPPOConfig) -> ValueRows:
    """Lambda-returns along one real sequence `[T, ...]`, whoever acted in it (ADR 8)."""
    view, rows = replayed
    value = jax.vmap(critic)(view.critic_features)
    target, weight = real_returns(value, rows, config.gamma, config.gae_lambda, config.team_reward)
    return ValueRows(jax.tree.map(lambda x: x[:-1], view), target, weight)


def actor_loss(
    actor: ActorFunction, rows: PPORows, ent_coef: Float[Array, ""], clip: float
) -> tuple[Float[Array, ""], Metrics]:
    """PPO's loss of the policy that an actor has at `rows`."""
    policy = jax.vmap(jax.vmap(actor))(rows.view.actor_features, rows.view.available)
    return policy_loss(policy, rows, ent_coef, clip)


def critic_loss(
    critic: ValueFunction, rows: PPORows | ValueRows, value_coef: float
) -> tuple[Float[Array, ""], Metrics]:
    """`value_coef` times the squared error to the lambda-returns."""
    error = jax.vmap(critic)(rows.view.critic_features) - rows.target
    loss = value_coef * weighted_mean(error**2, rows.value_weight)
    return loss, {"behaviour/critic_loss": loss}


def update(
    state: ActorCritic,
    trajectory: Trajectory,
    key: PRNGKey,
    config: MAPPOConfig,
    replayed: ValueRows | None = None,
) -> tuple[ActorCritic, Metrics]:
    """`n_epochs` of minibatch PPO on one set of trajectories (Algorithm 1, lines 12-13).

    The critic learns from `replayed` rows too, if there are any: each epoch divides them among its
    minibatches. `behaviour/update_kl` is KL(old || new) of the policy before and after the whole
    update, estimated on one minibatch's actions (`kl_of_choices`).
    """
    rows, metrics = experience(state.value, trajectory, config)
    key_rows, key_replayed, key_starts = jax.random.split(key, 3)
    batches = minibatches(key_rows, rows.target.shape[0], config.batch_size, config.n_epochs)
    per_epoch = batches.shape[0] // config.n_epochs
    imagined, imagined_batches = ValueRows(rows.view, rows.target, rows.value_weight), batches
    if config.critic_rows == "starts":
        n_starts = trajectory.weight.shape[1]
        imagined = jax.tree.map(lambda x: x[:n_starts], imagined)
        imagined_batches = divided(key_starts, n_starts, per_epoch, config.n_epochs)
    returns = state.returns.update(imagined.target, imagined.value_weight, config.value_decay)
    imagined = imagined._replace(target=returns.normalise(imagined.target))
    real_batches = None
    if replayed is not None:
        replayed = replayed._replace(target=returns.normalise(replayed.target))
        real_batches = divided(key_replayed, replayed.target.shape[0], per_epoch, config.n_epochs)
    actor_optimiser, critic_optimiser = optimisers(config)

    def critic_objective(
        critic: Critic, batch: ValueRows, replayed: ValueRows | None
    ) -> tuple[Float[Array, ""], Metrics]:
        loss, metrics = critic_loss(critic, batch, config.value_coef)
        if replayed is not None:
            real, _ = critic_loss(critic, replayed, config.replay_value_coef * config.value_coef)
            loss, metrics = loss + real, metrics | {"behaviour/replay_critic_loss": real}
        return loss, metrics

    def minibatch(
        state: ActorCritic, index: tuple[Array, Array, Array | None]
    ) -> tuple[ActorCritic, Metrics]:
        batch, of_critic = minibatch_of(rows, index[0]), minibatch_of(imagined, index[1])
        real = None if index[2] is None else minibatch_of(replayed, index[2])
        actor_grad, actor_metrics = eqx.filter_grad(actor_loss, has_aux=True)(
            state.actor, batch, state.ent_coef, config.clip
        )
        critic_grad, critic_metrics = eqx.filter_grad(critic_objective, has_aux=True)(
            state.critic, of_critic, real
        )
        actor_step, actor_opt = actor_optimiser.update(actor_grad, state.actor_opt, state.actor)  # pyright: ignore[reportArgumentType]
        critic_step, critic_opt = critic_optimiser.update(critic_grad, state.critic_opt)
        state = ActorCritic(
            actor=eqx.apply_updates(state.actor, actor_step),
            critic=eqx.apply_updates(state.critic, critic_step),
            actor_opt=actor_opt,
            critic_opt=critic_opt,
            ent_coef=state.ent_coef * (config.ent_decay if config.ent_final is None else 1.0),
            returns=returns,
        )
        return state, actor_metrics | critic_metrics

    state, history = jax.lax.scan(minibatch, state, (batches, imagined_batches, real_batches))
    return state, metrics | jax.tree.map(jnp.mean, history) | {
        "behaviour/ent_coef": state.ent_coef,
        "behaviour/update_kl": update_kl(state.actor, minibatch_of(rows, batches[0])),
    }


def update_kl(actor: ActorFunction, rows: PPORows) -> Float[Array, ""]:
    """KL(old || new) on `rows`, whose actions the old policy drew."""
    policy = jax.vmap(jax.vmap(actor))(rows.view.actor_features, rows.view.available)
    return kl_of_choices(policy, rows)
