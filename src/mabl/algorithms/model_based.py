"""Learning a world model from replayed rows, and behaviour inside it (Algorithm 1, lines 5-14)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from einops import rearrange
from jaxtyping import Array, Float

from mabl.algorithms.base import Experience
from mabl.algorithms.config import Config
from mabl.algorithms.diagnostics import DIAGNOSED_ROWS, diagnose, value_metrics
from mabl.algorithms.imagined_episodes import imagined_episodes
from mabl.behaviour.base import Behaviour
from mabl.devices import spread
from mabl.envs.base import EnvSpec
from mabl.execution import Policy
from mabl.imagination import Dream, Imagined, Step, imagine_trajectory
from mabl.nets.categorical import still
from mabl.nets.normaliser import Normaliser
from mabl.nets.optimiser import guarded
from mabl.replay import Replay, sample_sequences
from mabl.rows import TimeStep, is_last
from mabl.types import Metrics, PRNGKey, Progress, Replayed, TeamView, Trajectory
from mabl.world_models.base import WorldModel, WorldModelConfig
from mabl.world_models.loss import model_loss
from mabl.world_models.sequences import observe_sequence, with_scales

N_DIAGNOSED = 128
"""Sequences that diagnostics look at."""


class Learner(NamedTuple):
    """All that learning changes."""

    model: WorldModel
    """Acts and imagines."""
    model_opt: optax.OptState
    behaviour: Any
    trained: WorldModel | None = None
    """Newest parameters, which gradients change; None without averaging, where `model` has them."""


class ModelBased(NamedTuple):
    """A world model, and a behaviour that is learned in its imagination."""

    world_model: Callable[[EnvSpec, WorldModelConfig, PRNGKey], WorldModel]
    behaviour: Behaviour
    spec: EnvSpec
    config: Config

    @property
    def rows_needed(self) -> int:
        """A sequence of the model's."""
        return self.config.world_model.batch_length

    @property
    def imagined_steps(self) -> int:
        """Of the trajectories from all start states."""
        sizes, plan = self.config.world_model, self.config.imagination
        rows = sizes.batch_size * sizes.batch_length
        return min(rows, plan.n_starts or rows) * (plan.horizon - 1)

    @property
    def policy_gradient_steps(self) -> int:
        """The behaviour's, from all imagined rows."""
        return self.behaviour.gradient_steps(self.imagined_steps)

    @property
    def model_rows(self) -> int:
        """Rows of a batch of sequences."""
        return self.config.world_model.batch_size * self.config.world_model.batch_length

    @property
    def memory_rows(self) -> int:
        """A sequence of the model's."""
        return self.config.world_model.batch_length

    def init(self, key: PRNGKey) -> Learner:
        """Fresh parameters and optimisers."""
        key_model, key_behaviour = jax.random.split(key)
        model = self.world_model(self.spec, self.config.world_model, key_model)
        shape = (self.spec.n_agents, self.spec.action_space.size)
        view = self.view(model, model.initial(), jnp.ones(shape, bool), jnp.ones(shape[0], bool))
        behaviour = self.behaviour.init(view, self.spec.action_space, key_behaviour)
        opt = self._optimiser().init(eqx.filter(model, eqx.is_array))
        trained = jax.tree.map(jnp.copy, model) if self.config.world_model.averaging else None
        return Learner(model, opt, behaviour, trained)

    def policy(self, learner: Learner) -> Policy:
        """What of the learner is needed to act: all that is exported or deployed."""
        return Policy(learner.model.filter, self.behaviour.actor(learner.behaviour))

    def update_model(
        self, learner: Learner, experience: Experience, key: PRNGKey
    ) -> tuple[Learner, Metrics]:
        """Draw B_M sequences and train psi on L(psi) (lines 6-7).

        With `config.world_model.averaging`, what acts and imagines is a moving average of psi.
        """
        config = self.config.world_model
        key_sample, key_loss = jax.random.split(key)
        rows = sample_sequences(
            experience.replay,
            key_sample,
            config.batch_size,
            config.batch_length,
            config.recency,
        )
        model = with_scales(learner.model if learner.trained is None else learner.trained, rows)
        gradient, metrics = eqx.filter_grad(model_loss, has_aux=True)(
            model, rows, key_loss, config, self.spec.action_space
        )
        step, model_opt = self._optimiser().update(gradient, learner.model_opt)
        metrics["world_model/gradient_norm"] = optax.tree.norm(gradient)
        model = eqx.apply_updates(model, step)
        if learner.trained is not None:
            learner = learner._replace(trained=model)
            model = averaged(learner.model, model, 1 - config.averaging)
        return learner._replace(model=model, model_opt=model_opt), metrics

    def update_policy(
        self, learner: Learner, experience: Experience, key: PRNGKey
    ) -> tuple[Learner, Metrics]:
        """Draw B_R sequences, imagine from their latents, train theta and phi (lines 10-13)."""
        key_imagine, key_learn = jax.random.split(key)
        imagined = self.imagine(learner, experience.replay, key_imagine)
        return self.learn(learner, *imagined, key_learn, experience.progress)

    def imagine(
        self, learner: Learner, replay: Replay, key: PRNGKey, step: Step = Dream.step
    ) -> tuple[Trajectory, Replayed]:
        """Trajectories from the latents of B_R sequences, and these sequences (lines 10-11)."""
        sizes = self.config.world_model
        key_sample, key_observe, key_start, key_imagine = jax.random.split(key, 4)
        rows = sample_sequences(
            replay,
            key_sample,
            sizes.batch_size,
            sizes.batch_length,
            self.config.imagination.recency,
        )
        latents = self._observe(learner, rows, key_observe)
        start, weight = spread(starts(latents, rows, key_start, self.config.imagination.n_starts))
        dream = self.dream(learner)
        trajectory = jax.vmap(
            lambda *start: imagine_trajectory(dream, *start, step=step), out_axes=1
        )(start, weight, jax.random.split(key_imagine, weight.shape[0]))
        view = jax.vmap(jax.vmap(lambda *state: self.view(learner.model, *state)))(
            latents, rows.available, rows.alive
        )
        return trajectory, Replayed(view, rows)

    def learn(
        self,
        learner: Learner,
        trajectory: Trajectory,
        replayed: Replayed,
        key: PRNGKey,
        progress: Progress = 0.0,
    ) -> tuple[Learner, Metrics]:
        """Train theta and phi on trajectories (lines 12-13)."""
        behaviour, metrics = self.behaviour.update(
            learner.behaviour, trajectory, replayed, key, progress
        )
        return learner._replace(behaviour=behaviour), metrics

    def diagnose(self, learner: Learner, replay: Replay, key: PRNGKey) -> Metrics:
        """Compute diagnostics of the world model on sequences of the replay and imagined episodes.

        Values at resets and imagined episodes are in the environment's units, to compare with the
        episodes of training.
        """
        key_sample, key_observe, key_diagnose, key_play, key_value = jax.random.split(key, 5)
        rows = sample_sequences(replay, key_sample, N_DIAGNOSED, DIAGNOSED_ROWS)
        latents = self._observe(learner, rows, key_observe)
        metrics = diagnose(
            learner.model,
            latents,
            rows,
            key_diagnose,
            self.spec.action_space,
            self.config.world_model,
        )

        def value(latent: Any, row: TimeStep) -> Array:
            view = self.view(learner.model, latent, row.available, row.alive)
            return self.behaviour.value(learner.behaviour, view).mean()

        scale = self.config.training.reward_scale
        metrics |= value_metrics(
            learner.model, value, latents, rows, key_value, self.spec.action_space, scale
        )
        imagined = imagined_episodes(
            self.dream(learner),
            Imagined(latents, rows.available, rows.alive),
            rows.is_first,
            self.spec.episode_limit,
            scale,
            key_play,
        )
        if not self.spec.scores_wins:
            del imagined["behaviour/imagined_win_rate"]
        return metrics | imagined

    def dream(self, learner: Learner) -> Dream:
        """The learner's model and policy, ready to imagine."""
        return Dream(
            learner.model,
            self.behaviour.actor(learner.behaviour),
            self.spec.action_space,
            self.config.imagination,
            self.config.world_model,
            lambda latent: self.behaviour.critic_features(learner.model, latent),
        )

    def _observe(self, learner: Learner, rows: TimeStep, key: PRNGKey) -> Any:
        """Posterior latents of sequences `[B, T, ...]`, through which no gradient flows."""
        keys = jax.random.split(key, rows.is_first.shape[0])
        return still(jax.vmap(lambda *at: observe_sequence(learner.model, *at)[0])(rows, keys))

    def view(self, model: WorldModel, latent: Any, available: Array, alive: Array) -> TeamView:
        """What behaviour sees of one row's latent."""
        features = self.behaviour.critic_features(model, latent)
        return TeamView(model.actor_features(latent), features, available, alive)

    def _optimiser(self) -> optax.GradientTransformation:
        config = self.config.world_model
        return guarded(
            optax.chain(
                optax.clip_by_global_norm(config.grad_clip), optax.adam(config.learning_rate)
            )
        )


def starts(
    latents: Any, rows: TimeStep, key: PRNGKey, n_starts: int | None
) -> tuple[Imagined, Float[Array, " S"]]:
    """Where imagination begins, `[S, ...]`, and 0 where the row ends an episode.

    All posterior states of the batch `[B, T]`, those that end an episode replaced by others at
    random; or `n_starts` of them drawn without replacement, rows that do not end an episode first.
    Availability and life are the real ones.
    """
    states = Imagined(latents, rows.available, rows.alive)
    states, weight = jax.tree.map(
        lambda x: rearrange(x, "b t ... -> (b t) ..."), (states, 1.0 - is_last(rows))
    )
    if n_starts is None:
        spare = jax.random.categorical(key, jnp.log(weight), shape=weight.shape)
        order = jnp.where(weight > 0, jnp.arange(weight.shape[0]), spare)
        return jax.tree.map(lambda x: x[order], (states, weight))
    order = jnp.argsort(jax.random.uniform(key, weight.shape) - 2 * weight)[:n_starts]
    return jax.tree.map(lambda x: x[order], (states, weight))


def averaged(average: WorldModel, newest: WorldModel, rate: float) -> WorldModel:
    """Move an average `rate` of the way to the newest parameters.

    Scales of inputs, which are running means already, are the newest.
    """

    def is_scale(node: Any) -> bool:
        return isinstance(node, Normaliser)

    return jax.tree.map(
        lambda old, new: new if is_scale(new) else old + rate * (new - old),
        average,
        newest,
        is_leaf=is_scale,
    )
