"""QMIX without a world model [31]: recurrent agents, learned on replayed sequences of real rows."""

from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from mabl.algorithms.base import Experience
from mabl.algorithms.config import Config
from mabl.algorithms.diagnostics import masked_mean
from mabl.algorithms.model_free import require_none
from mabl.behaviour.qmix import EpsilonGreedy, annealed_epsilon, moved, optimiser
from mabl.behaviour.recurrent_qmix import QNetworks, replay_loss
from mabl.envs.base import EnvSpec
from mabl.execution import Policy
from mabl.replay import Replay, sample_sequences
from mabl.types import Metrics, PRNGKey

N_DIAGNOSED = 128
"""Sequences that diagnostics look at."""


class QLearner(NamedTuple):
    """Networks, target networks, optimiser state and epsilon."""

    online: QNetworks
    target: QNetworks
    opt: optax.OptState
    epsilon: Float[Array, ""]


@dataclass(frozen=True)
class RecurrentQMIX:
    """Recurrent QMIX on real episodes; each policy update is one gradient step on a fresh batch.

    With several `training.policy_updates` for each episode collected, a higher replay ratio than
    QMIX's [L. Xu et al., "Higher Replay Ratio Empowers Sample-Efficient Multi-Agent Reinforcement
    Learning"]. Raises UserError for a schedule with updates of a model.
    """

    spec: EnvSpec
    config: Config

    def __post_init__(self) -> None:
        require_none(self.config, "model_updates", "pretrain_updates", reason="has no model")

    @property
    def rows_needed(self) -> int:
        """A sequence."""
        return self.config.recurrent_qmix.batch_length

    @property
    def imagined_steps(self) -> int:
        """None: there is no model."""
        return 0

    @property
    def policy_gradient_steps(self) -> int:
        """One, on a batch of the replay."""
        return 1

    @property
    def model_rows(self) -> int:
        """None: there is no model."""
        return 0

    @property
    def memory_rows(self) -> int:
        """A sequence that it learns from."""
        return self.config.recurrent_qmix.batch_length

    def init(self, key: PRNGKey) -> QLearner:
        """Fresh networks, targets that are their copies, and an optimiser."""
        config = self.config.recurrent_qmix
        online = QNetworks.fresh(self.spec, config, key)
        return QLearner(
            online,
            jax.tree.map(jnp.copy, online),
            self._optimiser().init(eqx.filter(online, eqx.is_array)),
            jnp.float32(config.epsilon_start),
        )

    def policy(self, learner: QLearner) -> Policy:
        """Epsilon-greedy in each agent's own values; its mode is greedy."""
        online = learner.online
        return Policy(online.filter, EpsilonGreedy(online.values.q, learner.epsilon))

    def update_model(
        self, learner: QLearner, experience: Experience, key: PRNGKey
    ) -> tuple[QLearner, Metrics]:
        """There is no model."""
        del experience, key
        return learner, {}

    def update_policy(
        self, learner: QLearner, experience: Experience, key: PRNGKey
    ) -> tuple[QLearner, Metrics]:
        """One gradient step on sequences of the replay, then one soft update of the targets."""
        config = self.config.recurrent_qmix
        rows = sample_sequences(experience.replay, key, config.batch_size, config.batch_length)
        gradient, metrics = eqx.filter_grad(replay_loss, has_aux=True)(
            learner.online, learner.target, rows, config
        )
        step, opt = self._optimiser().update(gradient, learner.opt)
        online = eqx.apply_updates(learner.online, step)
        target = moved(learner.target, online, config.target_rate)
        epsilon = annealed_epsilon(
            config.epsilon_start, config.epsilon_end, config.epsilon_share, experience.progress
        )
        metrics["behaviour/epsilon"] = epsilon
        return QLearner(online, target, opt, epsilon), metrics

    def diagnose(self, learner: QLearner, replay: Replay, key: PRNGKey) -> Metrics:
        """The greedy policy's value at resets, in the environment's units."""
        rows = sample_sequences(replay, key, N_DIAGNOSED, self.config.recurrent_qmix.batch_length)
        value = masked_mean(jax.vmap(learner.online.greedy)(rows), rows.is_first)
        return {"behaviour/value_at_reset": value / self.config.training.reward_scale}

    def _optimiser(self) -> optax.GradientTransformation:
        config = self.config.recurrent_qmix
        return optimiser(config.learning_rate, config.grad_clip)
