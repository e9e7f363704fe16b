"""MAG [42]: of several imagined latents, the one from which the model is expected to err least."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from mabl.algorithms.base import Experience
from mabl.algorithms.config import Config, LookaheadConfig
from mabl.algorithms.model_based import Learner, ModelBased
from mabl.envs.base import EnvSpec
from mabl.execution import Policy
from mabl.imagination import Dream, Imagined
from mabl.nets.mlp import MLP, Features, parts_of, widths_of
from mabl.nets.optimiser import guarded
from mabl.replay import Replay, sample_sequences
from mabl.types import Metrics, PRNGKey, Progress, Replayed, Trajectory
from mabl.world_models.heads import Predictions
from mabl.world_models.loss import decoder_losses, kl_losses
from mabl.world_models.mamba import Team
from mabl.world_models.sequences import obs_std, observe_batch, predict_sequence


class LookaheadLearner(NamedTuple):
    """All that learning changes."""

    base: Learner
    error: Team
    """Predicts the model's loss from what it imagines; one network for each agent."""
    error_opt: optax.OptState


class MAG(NamedTuple):
    """A model-based algorithm whose imagination looks ahead."""

    base: ModelBased

    @property
    def spec(self) -> EnvSpec:
        """The environment's."""
        return self.base.spec

    @property
    def config(self) -> Config:
        """The run's."""
        return self.base.config

    @property
    def rows_needed(self) -> int:
        """A sequence of the model's."""
        return self.base.rows_needed

    @property
    def imagined_steps(self) -> int:
        """Those learned from; candidates and lookahead are not counted."""
        return self.base.imagined_steps

    @property
    def policy_gradient_steps(self) -> int:
        """The behaviour's, from all imagined rows."""
        return self.base.policy_gradient_steps

    @property
    def model_rows(self) -> int:
        """Rows of a batch; those that the error predictor learns from are not counted."""
        return self.base.model_rows

    @property
    def memory_rows(self) -> int:
        """A sequence of the model's."""
        return self.base.memory_rows

    def init(self, key: PRNGKey) -> LookaheadLearner:
        """Fresh parameters and optimisers."""
        config = self.config.lookahead
        key_base, key_error = jax.random.split(key)
        base = self.base.init(key_base)
        seen = widths_of(base.model.actor_features(base.model.initial()))
        error = Team(
            lambda key: MLP(seen, 1, config.hidden, config.n_hidden, key),
            self.spec.n_agents,
            False,
            key_error,
        )
        opt = guarded(optax.adam(config.learning_rate)).init(eqx.filter(error, eqx.is_array))
        return LookaheadLearner(base, error, opt)

    def policy(self, learner: LookaheadLearner) -> Policy:
        """What of the learner is needed to act."""
        return self.base.policy(learner.base)

    def update_model(
        self, learner: LookaheadLearner, experience: Experience, key: PRNGKey
    ) -> tuple[LookaheadLearner, Metrics]:
        """One step of the world model, then one of the predictor of its errors."""
        key_model, key_sample, key_observe = jax.random.split(key, 3)
        base, metrics = self.base.update_model(learner.base, experience, key_model)
        config = self.config.world_model
        rows = sample_sequences(
            experience.replay,
            key_sample,
            config.batch_size,
            config.batch_length,
            config.recency,
        )
        rows = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), rows)
        observed = observe_batch(base.model, rows, key_observe)
        predicted = predict_sequence(base.model, observed.latents, config)
        losses = decoder_losses(
            predicted, rows, config, self.spec.action_space, obs_std(base.model)
        )
        realised = sum(losses[name] for name in ("obs", "reward", "terminated", "available")) + sum(
            kl_losses(observed, config).values()
        )
        features = jax.vmap(jax.vmap(base.model.actor_features))(observed.prior_latents)

        def loss(error: Team) -> Float[Array, ""]:
            guess = jax.vmap(jax.vmap(lambda x: predict_error(error, x)))(features)
            return optax.huber_loss(guess, realised).mean()

        value, gradient = eqx.filter_value_and_grad(loss)(learner.error)
        optimiser = guarded(optax.adam(self.config.lookahead.learning_rate))
        step, error_opt = optimiser.update(gradient, learner.error_opt)
        metrics["world_model/loss_predicted_error"] = value
        return LookaheadLearner(base, eqx.apply_updates(learner.error, step), error_opt), metrics

    def update_policy(
        self, learner: LookaheadLearner, experience: Experience, key: PRNGKey
    ) -> tuple[LookaheadLearner, Metrics]:
        """As without lookahead, but for how imagination goes on."""
        key_imagine, key_learn = jax.random.split(key)
        imagined = self.imagine(learner, experience.replay, key_imagine)
        return self.learn(learner, *imagined, key_learn, experience.progress)

    def imagine(
        self, learner: LookaheadLearner, replay: Replay, key: PRNGKey
    ) -> tuple[Trajectory, Replayed]:
        """Trajectories of chosen candidates, and the sequences that they began in."""

        def step(
            dream: Dream, state: Imagined, action: Array, key: PRNGKey
        ) -> tuple[Imagined, Predictions]:
            return best_candidate(dream, learner.error, self.config.lookahead, state, action, key)

        return self.base.imagine(learner.base, replay, key, step)

    def learn(
        self,
        learner: LookaheadLearner,
        trajectory: Trajectory,
        replayed: Replayed,
        key: PRNGKey,
        progress: Progress = 0.0,
    ) -> tuple[LookaheadLearner, Metrics]:
        """Train the policy on trajectories."""
        base, metrics = self.base.learn(learner.base, trajectory, replayed, key, progress)
        return learner._replace(base=base), metrics

    def diagnose(self, learner: LookaheadLearner, replay: Replay, key: PRNGKey) -> Metrics:
        """Compute the diagnostics of `ModelBased.diagnose`."""
        return self.base.diagnose(learner.base, replay, key)


def predict_error(error: Team, features: Features) -> Float[Array, " N"]:
    """Each agent's predicted model loss at imagined features."""
    return error.map(lambda net, x: net(*parts_of(x))[0], features)


def best_candidate(
    dream: Dream,
    error: Any,
    config: LookaheadConfig,
    state: Imagined,
    action: Array,
    key: PRNGKey,
) -> tuple[Imagined, Predictions]:
    """Of `candidates` draws of the next state, the one with the smallest predicted errors ahead.

    From each draw the policy goes on for `steps` steps; the errors predicted there are summed over
    steps and agents. Every start state chooses for itself (ADR 10).
    """
    key_draw, key_future = jax.random.split(key)

    def draw(key: PRNGKey) -> tuple[Imagined, Predictions]:
        return dream.step(state, action, key)

    def errors_ahead(state: Imagined, key: PRNGKey) -> Float[Array, ""]:
        def advance(state: Imagined, key: PRNGKey) -> tuple[Imagined, Float[Array, ""]]:
            key_action, key_step = jax.random.split(key)
            action, _ = dream.act(state, key_action)
            state, _ = dream.step(state, action, key_step)
            return state, predict_error(error, dream.model.actor_features(state.latent)).sum()

        return jax.lax.scan(advance, state, jax.random.split(key, config.steps))[1].sum()

    drawn = jax.vmap(draw)(jax.random.split(key_draw, config.candidates))
    keys = jax.random.split(key_future, config.candidates)
    best = jax.vmap(errors_ahead)(drawn[0], keys).argmin()
    return jax.tree.map(lambda x: x[best], drawn)
