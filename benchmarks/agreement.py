"""Compare how the world model and the simulator rank joint actions.

For some replayed states and several joint actions in each, one step is taken in the model and one
in the simulator; the critic values what either leads to. Policies learn from differences between
the actions of a state, so that their correlation within states says how well imagination teaches.
"""

from typing import Any

import jax
import jax.numpy as jnp
from einops import rearrange
from jaxtyping import Array, Float

from mabl import replay as replays
from mabl.envs.base import Discrete
from mabl.imagination import Imagined
from mabl.nets.categorical import still
from mabl.rows import is_last
from mabl.types import Metrics, PRNGKey
from mabl.world_models.sequences import observe_sequence

SEQUENCES = 64
STATES = 192
ACTIONS = 8
"""Joint actions in each state: each is drawn by the policy or uniformly, with equal chances."""
DRAWS = 8
"""Steps of either world that an action's value averages over."""
HISTORY = 5
"""Rows of a sequence before a state; a reset may lie between."""


def agreement(oracle: Any, state: Any, key: PRNGKey) -> Metrics:
    """Compare one-step values of joint actions, r + gamma V(next), in the model and the simulator.

    Returns `action_correlation` of r + gamma V, `action_reward_correlation` of r,
    `action_value_correlation` of gamma V, `action_std` and `action_std_model` (standard deviations
    over the actions of a state), and `action_value_bias`: how much higher gamma V is in the model,
    in scaled rewards.
    """
    key_sample, key_observe, key_choose, key_act = jax.random.split(key, 4)
    algorithm, learner = oracle.algorithm, state.learner
    recorded = replays.sample_sequences(
        state.replay, key_sample, SEQUENCES, algorithm.config.world_model.batch_length
    )
    latents = still(
        jax.vmap(lambda *at: observe_sequence(learner.model, *at)[0])(
            recorded.row, jax.random.split(key_observe, SEQUENCES)
        )
    )
    states = jax.tree.map(
        lambda x: rearrange(x[:, HISTORY:], "b t ... -> (b t) ..."),
        (recorded.env_state, recorded.row, latents),
    )
    last = is_last(states[1])
    order = jnp.argsort(jax.random.uniform(key_choose, last.shape) + 2 * last)[:STATES]
    chosen = jax.tree.map(lambda x: x[order], states)
    keys = jax.random.split(key_act, order.shape[0])
    values = jax.lax.map(lambda at: action_values(oracle, learner, *at), (*chosen, keys))
    true, said = values[..., 0, :], values[..., 1, :]  # [S, A, (reward, value)]
    return {
        "action_correlation": within_states(true.sum(-1), said.sum(-1)),
        "action_reward_correlation": within_states(true[..., 0], said[..., 0]),
        "action_value_correlation": within_states(true[..., 1], said[..., 1]),
        "action_std": true.sum(-1).std(1).mean(),
        "action_std_model": said.sum(-1).std(1).mean(),
        "action_value_bias": (said[..., 1] - true[..., 1]).mean(),
    }


def action_values(
    oracle: Any, learner: Any, env_state: Any, row: Any, latent: Any, key: PRNGKey
) -> Float[Array, "A 2 2"]:
    """Mean reward and discounted value after some joint actions: by the simulator, by the model."""
    algorithm, behaviour = oracle.algorithm, oracle.algorithm.behaviour
    dream, space = algorithm.dream(learner), algorithm.spec.action_space
    scale, gamma = algorithm.config.training.reward_scale, algorithm.config.mappo.gamma
    now = Imagined(latent, row.available, row.alive)

    def value(view: Any) -> Array:
        return gamma * behaviour.value(learner.behaviour, view).mean()

    def draw(action: Array, key: PRNGKey) -> Float[Array, "2 2"]:
        key_env, key_model, key_observe = jax.random.split(key, 3)
        _, after = oracle.env.step(key_env, env_state, action.astype(space.dtype))
        seen = learner.model.observe(latent, learner.model.encode(after), key_observe)[0]
        view = algorithm.view(learner.model, still(seen), after.available, after.alive)
        true = after.reward.mean() * scale, (1 - after.terminated.mean()) * value(view)
        imagined, said = dream.step(now, action, key_model)
        goes_on = dream.continues(said).mean()
        model = said.reward.mean(), goes_on * value(dream.view(imagined))
        return jnp.array([true, model])

    def one(key: PRNGKey) -> Float[Array, "2 2"]:
        key_policy, key_uniform, key_which, key_draws = jax.random.split(key, 4)
        action, _ = dream.act(now, key_policy)
        uniform = uniform_action(space, row.available, key_uniform)
        action = jnp.where(jax.random.bernoulli(key_which), action, uniform)
        return jax.vmap(lambda key: draw(action, key))(jax.random.split(key_draws, DRAWS)).mean(0)

    return jax.vmap(one)(jax.random.split(key, ACTIONS))


def uniform_action(space: Any, available: Array, key: PRNGKey) -> Array:
    """A joint action, every available one with the same probability."""
    if isinstance(space, Discrete):
        return jax.random.categorical(key, jnp.where(available, 0.0, -jnp.inf))
    return jax.random.uniform(key, available.shape, minval=-1.0, maxval=1.0)


def within_states(a: Float[Array, "S A"], b: Float[Array, "S A"]) -> Float[Array, ""]:
    """Correlation over all actions after each state's mean is taken away."""
    a, b = a - a.mean(1, keepdims=True), b - b.mean(1, keepdims=True)
    return (a * b).sum() / jnp.sqrt((a**2).sum() * (b**2).sum() + 1e-12)
