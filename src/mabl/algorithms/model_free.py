"""MAPPO without a world model [46]: recurrent policies, learned on the newest real rows alone."""

from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from einops import rearrange
from jaxtyping import Array

from mabl.algorithms.base import Experience
from mabl.algorithms.config import Config
from mabl.behaviour.actor import actor_for
from mabl.behaviour.base import minibatch_of, minibatch_steps, minibatches
from mabl.behaviour.critic import Critic
from mabl.behaviour.ppo import PPORows, real_returns, weighted_mean
from mabl.behaviour.recurrent import (
    Chunks,
    RecurrentFilter,
    policies,
    recurrent_policy_loss,
    recurrent_update_kl,
    value_loss,
)
from mabl.envs.base import EnvSpec
from mabl.errors import UserError
from mabl.execution import Policy
from mabl.nets.normaliser import Normaliser
from mabl.nets.optimiser import guarded
from mabl.replay import Replay
from mabl.rows import TimeStep
from mabl.types import Metrics, PRNGKey, TeamView


class PolicyLearner(NamedTuple):
    """All that learning changes."""

    policy: Policy
    critic: Critic
    policy_opt: optax.OptState
    critic_opt: optax.OptState
    returns: Normaliser


@dataclass(frozen=True)
class ModelFree:
    """Recurrent MAPPO on real episodes; each update sees the rows of one cycle only.

    Raises UserError for rows of a cycle that do not divide into chunks, and for a schedule that
    would have it learn from rows of an earlier policy.
    """

    spec: EnvSpec
    config: Config

    def __post_init__(self) -> None:
        rows, length = self.config.training.collect_steps, self.config.recurrent_mappo.chunk_length
        if rows is None or rows % length:
            raise UserError(
                f"--training.collect-steps is {rows}: give a multiple of the {length} rows of "
                "--recurrent-mappo.chunk-length"
            )
        require_none(
            self.config,
            *("model_updates", "pretrain_updates", "prefill_steps"),
            reason="has no model and learns from all it does",
        )
        updates = self.config.training.policy_updates
        if updates != 1:
            raise UserError(
                f"--training.policy-updates is {updates}: {self.config.algo} learns "
                "once from what it has just done: give 1, and --recurrent-mappo.n-epochs"
            )

    @property
    def rows_needed(self) -> int:
        """Whatever a cycle collects."""
        return 1

    @property
    def imagined_steps(self) -> int:
        """None: there is no model."""
        return 0

    @property
    def policy_gradient_steps(self) -> int:
        """Minibatches of all epochs over the chunks of a cycle."""
        plan, config = self.config.training, self.config.recurrent_mappo
        n_chunks = plan.num_envs * ((plan.collect_steps or 0) // config.chunk_length)
        return minibatch_steps(n_chunks, -(-n_chunks // config.n_minibatches), config.n_epochs)

    @property
    def model_rows(self) -> int:
        """None: there is no model."""
        return 0

    @property
    def memory_rows(self) -> int:
        """None: what is collected is learned from with the memories that it was collected with."""
        return 0

    def init(self, key: PRNGKey) -> PolicyLearner:
        """Fresh parameters and optimisers."""
        config, spec = self.config.recurrent_mappo, self.spec
        key_filter, key_actor, key_critic = jax.random.split(key, 3)
        policy = Policy(
            RecurrentFilter(spec.obs_dim, config.hidden, key_filter),
            actor_for(
                spec.action_space,
                config.hidden,
                config.hidden,
                0,
                config.actor_out_scale,
                config.initial_std,
                key_actor,
            ),
        )
        n_critic = spec.obs_dim + spec.state_dim
        critic = Critic(n_critic, config.hidden, 1, config.n_heads, key_critic)
        optimiser = self._optimiser()
        return PolicyLearner(
            policy,
            critic,
            optimiser.init(eqx.filter(policy, eqx.is_array)),
            optimiser.init(eqx.filter(critic, eqx.is_array)),
            Normaliser.fresh(),
        )

    def policy(self, learner: PolicyLearner) -> Policy:
        """The recurrent policy."""
        return learner.policy

    def update_model(
        self, learner: PolicyLearner, experience: Experience, key: PRNGKey
    ) -> tuple[PolicyLearner, Metrics]:
        """There is no model."""
        del experience, key
        return learner, {}

    def update_policy(
        self, learner: PolicyLearner, experience: Experience, key: PRNGKey
    ) -> tuple[PolicyLearner, Metrics]:
        """`n_epochs` of minibatch PPO on the rows that the present policy has just collected."""
        config = self.config.recurrent_mappo
        chunks, metrics = self.chunks(learner, experience)
        targets, weights = chunks.rows.target, chunks.rows.weight
        learner = learner._replace(
            returns=learner.returns.update(targets, weights, config.value_decay)
        )
        n_chunks = chunks.memory.shape[0]
        size = -(-n_chunks // config.n_minibatches)
        batches = minibatches(key, n_chunks, size, config.n_epochs)
        optimiser = self._optimiser()

        def minibatch(learner: PolicyLearner, index: Array) -> tuple[PolicyLearner, Metrics]:
            batch = minibatch_of(chunks, index)
            policy_grad, policy_metrics = eqx.filter_grad(recurrent_policy_loss, has_aux=True)(
                learner.policy, batch, jnp.float32(config.ent_coef), config.clip
            )
            critic_grad, critic_metrics = eqx.filter_grad(value_loss, has_aux=True)(
                learner.critic, batch.rows, learner.returns, config.value_coef
            )
            policy_step, policy_opt = optimiser.update(policy_grad, learner.policy_opt)
            critic_step, critic_opt = optimiser.update(critic_grad, learner.critic_opt)
            learner = learner._replace(
                policy=eqx.apply_updates(learner.policy, policy_step),
                critic=eqx.apply_updates(learner.critic, critic_step),
                policy_opt=policy_opt,
                critic_opt=critic_opt,
            )
            return learner, policy_metrics | critic_metrics

        learner, history = jax.lax.scan(minibatch, learner, batches)
        first = minibatch_of(chunks, batches[0])
        return learner, metrics | jax.tree.map(jnp.mean, history) | {
            "behaviour/update_kl": recurrent_update_kl(learner.policy, first)
        }

    def chunks(self, learner: PolicyLearner, experience: Experience) -> tuple[Chunks, Metrics]:
        """The newest rows with their memories, log-probabilities, returns and advantages.

        Rows start with the one at which the first new action was chosen.
        """
        config = self.config.recurrent_mappo
        rows = jax.tree.map(
            lambda row, rows: jnp.concatenate([row[:, None], rows], axis=1),
            experience.before.row,
            experience.newest.rows,
        )
        unroll = jax.vmap(learner.policy.filter.unroll, in_axes=(0, 1, None), out_axes=1)
        before, after = jax.vmap(unroll)(experience.before.memory, rows.obs, rows.is_first)
        view = TeamView(after, critic_features(rows), rows.available, rows.alive)
        value = jax.vmap(jax.vmap(learner.critic))(view.critic_features, view.alive)
        value = learner.returns.restore(value)
        target, weight = jax.vmap(
            lambda value, rows: real_returns(
                value, rows, config.gamma, config.gae_lambda, config.team_reward
            )
        )(value, rows)
        advantage = target - value[:, :-1]
        counted = weight * rows.alive[:, :-1]
        mean = weighted_mean(advantage, counted)
        std = jnp.sqrt(weighted_mean((advantage - mean) ** 2, counted))
        view = jax.tree.map(lambda x: x[:, :-1], view)
        policy = policies(learner.policy.filter, learner.policy.actor, view)
        action = rows.prev_action[:, 1:]
        ppo = PPORows(
            view,
            action,
            policy.log_prob(action),
            (advantage - mean) / (std + 1e-5),
            target,
            weight,
            value_weight=weight,
        )
        length = config.chunk_length

        def cut(x: Array) -> Array:
            return rearrange(x, "e (c l) ... -> (e c) l ...", l=length)

        chunks = Chunks(
            memory=cut(before[:, :-1])[:, 0],
            obs=cut(rows.obs[:, :-1]),
            is_first=cut(rows.is_first[:, :-1]),
            rows=jax.tree.map(cut, ppo),
        )
        metrics = {
            "behaviour/value": weighted_mean(value[:, :-1], weight),
            "behaviour/return": weighted_mean(target, weight),
            "behaviour/advantage_std": std,
        }
        return chunks, metrics

    def diagnose(self, learner: PolicyLearner, replay: Replay, key: PRNGKey) -> Metrics:
        """Nothing: there is no model."""
        del learner, replay, key
        return {}

    def _optimiser(self) -> optax.GradientTransformation:
        config = self.config.recurrent_mappo
        return guarded(
            optax.chain(
                optax.clip_by_global_norm(config.grad_clip),
                optax.adam(config.learning_rate, eps=1e-5),
            )
        )


def require_none(config: Config, *names: str, reason: str) -> None:
    """Raise UserError where a field of the training schedule is not 0, as it would do nothing."""
    for name in names:
        if getattr(config.training, name):
            raise UserError(
                f"--training.{name.replace('_', '-')} is {getattr(config.training, name)}: "
                f"{config.algo} {reason}: give 0"
            )


def critic_features(rows: TimeStep) -> Array:
    """The state beside each agent's observation: `[*b, N, O + S]`."""
    state = jnp.broadcast_to(rows.state[..., None, :], (*rows.obs.shape[:-1], rows.state.shape[-1]))
    return jnp.concatenate([rows.obs, state], axis=-1)
