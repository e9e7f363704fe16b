"""Learning a world model from replayed rows, and behaviour inside it (Algorithm 1, lines 5-14)."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from einops import rearrange
from jaxtyping import Array, Float

from mabl.algorithms.config import Config
from mabl.algorithms.diagnostics import DIAGNOSED_ROWS, diagnose, masked_mean
from mabl.behaviour import mappo
from mabl.behaviour.mappo import MAPPO
from mabl.envs.base import EnvSpec
from mabl.execution import LocalExecutor, LocalPolicy
from mabl.imagination import imagine_trajectory
from mabl.replay import Replay, sample_sequences
from mabl.types import Metrics, PRNGKey, TimeStep, is_last
from mabl.world_models.base import WorldModel, model_loss, observe_sequence

N_DIAGNOSED = 128
"""Sequences that diagnostics look at."""


class Learner(NamedTuple):
    """All that learning changes."""

    model: WorldModel
    model_opt: optax.OptState
    behaviour: MAPPO


class ModelBased(NamedTuple):
    """A world model and MAPPO inside its imagination."""

    world_model: type
    spec: EnvSpec
    config: Config

    def init(self, key: PRNGKey) -> Learner:
        """Fresh parameters and optimisers."""
        key_model, key_behaviour = jax.random.split(key)
        model = self.world_model(self.spec, self.config.world_model, key_model)
        latent = model.initial()
        behaviour = mappo.init(
            self.config.mappo,
            n_actor=model.actor_features(latent).shape[-1],
            n_critic=model.critic_features(latent).shape[-1],
            n_actions=self.spec.action_space.size,
            key=key_behaviour,
        )
        return Learner(model, self._optimiser().init(eqx.filter(model, eqx.is_array)), behaviour)

    def policy(self, learner: Learner) -> LocalPolicy:
        """What of the learner is needed to act: all that is exported or deployed."""
        return LocalPolicy(learner.model.filter, learner.behaviour.actor)

    def executor(self, policy: LocalPolicy, greedy: bool = False) -> LocalExecutor:
        """How a policy acts in the environment."""
        return LocalExecutor(policy, self.spec.action_space, greedy)

    def update_model(
        self, learner: Learner, replay: Replay, key: PRNGKey
    ) -> tuple[Learner, Metrics]:
        """Draw B_M sequences and train psi on L(psi) (lines 6-7)."""
        config = self.config.world_model
        key_sample, key_loss = jax.random.split(key)
        rows = sample_sequences(replay, key_sample, config.batch_size, config.batch_length)
        gradient, metrics = eqx.filter_grad(model_loss, has_aux=True)(
            learner.model, rows, key_loss, config, self.spec.action_space
        )
        step, model_opt = self._optimiser().update(gradient, learner.model_opt)
        metrics["world_model/gradient_norm"] = optax.tree.norm(gradient)
        model = eqx.apply_updates(learner.model, step)
        return learner._replace(model=model, model_opt=model_opt), metrics

    def update_policy(
        self, learner: Learner, replay: Replay, key: PRNGKey
    ) -> tuple[Learner, Metrics]:
        """Draw B_R sequences, imagine from their latents, train theta and phi (lines 10-13)."""
        sizes, config = self.config.world_model, self.config.mappo
        key_sample, key_observe, key_start, key_imagine, key_ppo = jax.random.split(key, 5)
        rows = sample_sequences(replay, key_sample, sizes.batch_size, sizes.batch_length)
        latents, _ = jax.vmap(observe_sequence, in_axes=(None, 0, 0))(
            learner.model, rows, jax.random.split(key_observe, sizes.batch_size)
        )
        start, available, weight = starts((latents, rows), key_start, config.n_starts)
        trajectory = jax.vmap(
            lambda start, available, weight, key: imagine_trajectory(
                learner.model,
                learner.behaviour.actor,
                start,
                available,
                weight,
                key,
                config.horizon,
                self.spec.action_space,
                config.sample_availability,
            ),
            out_axes=1,
        )(start, available, weight, jax.random.split(key_imagine, weight.shape[0]))
        replayed = None
        if config.replay_value_coef:
            features = jax.vmap(jax.vmap(learner.model.critic_features))(latents)
            replayed = jax.vmap(
                lambda features, rows: mappo.replayed_values(
                    learner.behaviour.critic, features, rows, config
                )
            )(features, rows)
            replayed = jax.tree.map(lambda x: rearrange(x, "b t ... -> (b t) ..."), replayed)
        behaviour, metrics = mappo.update(learner.behaviour, trajectory, key_ppo, config, replayed)
        return learner._replace(behaviour=behaviour), metrics

    def diagnose(self, learner: Learner, replay: Replay, key: PRNGKey) -> Metrics:
        """How well the world model predicts sequences of the replay, and what the critic expects.

        `behaviour/value_at_reset` is in the environment's units: it compares with episode returns.
        """
        key_sample, key_observe, key_diagnose = jax.random.split(key, 3)
        rows = sample_sequences(replay, key_sample, N_DIAGNOSED, DIAGNOSED_ROWS)
        latents, _ = jax.vmap(observe_sequence, in_axes=(None, 0, 0))(
            learner.model, rows, jax.random.split(key_observe, N_DIAGNOSED)
        )
        metrics = diagnose(learner.model, latents, rows, key_diagnose, self.spec.action_space)
        features = jax.vmap(jax.vmap(learner.model.critic_features))(latents)
        value = jax.vmap(jax.vmap(learner.behaviour.critic))(features).mean(-1)
        metrics["behaviour/value_at_reset"] = (
            masked_mean(value, rows.is_first) / self.config.training.reward_scale
        )
        return metrics

    def _optimiser(self) -> optax.GradientTransformation:
        config = self.config.world_model
        return optax.chain(
            optax.clip_by_global_norm(config.grad_clip), optax.adam(config.learning_rate)
        )


def starts(
    observed: tuple[object, TimeStep], key: PRNGKey, n_starts: int | None
) -> tuple[object, Array, Float[Array, " S"]]:
    """Start latents `[S, ...]`, their real availability, and 0 where the row ends an episode.

    All posterior states of the batch `[B, T]`, or `n_starts` of them drawn without replacement,
    rows that do not end an episode first.
    """
    flat = jax.tree.map(lambda x: rearrange(x, "b t ... -> (b t) ..."), observed)
    latents, rows = flat
    weight = 1.0 - is_last(rows)
    chosen = (latents, rows.available, weight)
    if n_starts is None:
        return chosen
    order = jnp.argsort(jax.random.uniform(key, weight.shape) - 2 * weight)[:n_starts]
    return jax.tree.map(lambda x: x[order], chosen)
