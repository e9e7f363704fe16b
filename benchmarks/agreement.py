"""Compare how the world model and the simulator rank joint actions.

Takes a joint action in a replayed state and then follows the policy, in the model and in the
simulator, and compares the values of what they lead to. Policies learn from differences between the
actions of a state, so that their correlation within states says how well imagination teaches.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from einops import rearrange
from jaxtyping import Array, Float

from mabl import replay as replays
from mabl.algorithms.diagnostics import DIAGNOSED_ROWS, WARM_UP
from mabl.envs.base import Discrete
from mabl.imagination import Imagined
from mabl.nets.categorical import still
from mabl.rows import is_last
from mabl.types import Metrics, PRNGKey
from mabl.world_models.sequences import observe_sequence

SEQUENCES = 64
STATES = 192
BY_POLICY, UNIFORM = 8, 4
"""Joint actions in each state that the policy draws, and that are drawn uniformly."""
DRAWS = 8
"""Trajectories of either world that an action's value averages over."""
STEPS = (1, 5)
"""Steps after which the critic values what an action has led to."""

State = Any
Outcome = tuple[State, Float[Array, ""], Float[Array, ""], Float[Array, ""]]
"""State of a world after a step, its reward, its probability of going on, and the state's value."""


def agreement(oracle: Any, state: Any, key: PRNGKey) -> Metrics:
    """Compare k-step values of joint actions, in the model and in the simulator.

    Of action a at row t it is the mean of r_{t+1} + ... + gamma^k V(row t + k), where the actions
    after a are the policy's. Returns for each k of `STEPS`

    - `action_correlation_k` between model and simulator; `action_ceiling_k` between two estimates
      of the simulator, the highest that a model can have, and `action_repeat_k` between two of the
      model, which is low where imagination is noisy;
    - `policy_action_correlation_k`, `_ceiling_k` and `_repeat_k`, the same of the policy's own
      actions alone, between which it has yet to choose; they fall with its entropy, as actions
      drawn twice differ by noise alone;
    - `action_reward_correlation_k` of the rewards alone, `action_value_correlation_k` of gamma^k V;
    - `action_std_k` and `action_std_model_k`, standard deviations over the actions of a state;
    - `action_value_bias_k`, the mean by which gamma^k V is higher in the model, in scaled rewards.
    """
    learner = state.learner
    key_sample, key_observe, key_choose, key_act = jax.random.split(key, 4)
    recorded = replays.sample_sequences(state.replay, key_sample, SEQUENCES, DIAGNOSED_ROWS)
    latents = still(
        jax.vmap(lambda *at: observe_sequence(learner.model, *at)[0])(
            recorded.row, jax.random.split(key_observe, SEQUENCES)
        )
    )
    states = jax.tree.map(
        lambda x: rearrange(x[:, WARM_UP:], "b t ... -> (b t) ..."),
        (recorded.env_state, recorded.row, latents),
    )
    last = is_last(states[1])
    order = jnp.argsort(jax.random.uniform(key_choose, last.shape) + 2 * last)[:STATES]
    chosen = jax.tree.map(lambda x: x[order], states)
    keys = jax.random.split(key_act, order.shape[0])
    values = jax.lax.map(lambda at: action_values(oracle, learner, *at), (*chosen, keys))
    metrics = {}
    for i, k in enumerate(STEPS):
        true, again, said, repeated = (values[:, :, world, :, i] for world in range(4))
        for prefix, those in (("action", slice(None)), ("policy_action", slice(BY_POLICY))):
            one, other, model, same = (x[:, those].sum(-1) for x in (true, again, said, repeated))
            metrics[f"{prefix}_correlation_{k}"] = within_states(one, model)
            metrics[f"{prefix}_ceiling_{k}"] = within_states(one, other)
            metrics[f"{prefix}_repeat_{k}"] = within_states(model, same)
        metrics |= {
            f"action_reward_correlation_{k}": within_states(true[..., 0], said[..., 0]),
            f"action_value_correlation_{k}": within_states(true[..., 1], said[..., 1]),
            f"action_std_{k}": true.sum(-1).std(1).mean(),
            f"action_std_model_{k}": said.sum(-1).std(1).mean(),
            f"action_value_bias_{k}": (said[..., 1] - true[..., 1]).mean(),
        }
    return metrics


def action_values(
    oracle: Any, learner: Any, env_state: Any, row: Any, latent: Any, key: PRNGKey
) -> Float[Array, "A 4 2 K"]:
    """Mean rewards and discounted values after some joint actions and `STEPS` steps.

    Axis 1 holds two independent estimates of the simulator, then two of the model. The first
    `BY_POLICY` actions are the policy's.
    """
    algorithm = oracle.algorithm
    dream, space = algorithm.dream(learner), algorithm.spec.action_space
    scale = algorithm.config.training.reward_scale
    now = Imagined(latent, row.available, row.alive)

    def value(state: Imagined) -> Array:
        return algorithm.behaviour.value(learner.behaviour, dream.view(state)).mean()

    def simulate(state: State, action: Array, key: PRNGKey) -> Outcome:
        env_state, at = state
        key_env, key_observe = jax.random.split(key)
        env_state, after = oracle.env.step(key_env, env_state, action.astype(space.dtype))
        seen = learner.model.observe(at.latent, learner.model.encode(after), key_observe)[0]
        at = Imagined(still(seen), after.available, after.alive)
        reward, goes_on = after.reward.mean() * scale, 1 - after.terminated.mean()
        return (env_state, at), reward, goes_on, value(at)

    def imagine(state: State, action: Array, key: PRNGKey) -> Outcome:
        _, at = state
        at, said = dream.step(at, action, key)
        return (None, at), said.reward.mean(), dream.continues(said).mean(), value(at)

    def act(state: State, key: PRNGKey) -> Array:
        return dream.act(state[1], key)[0]

    def mean_of_draws(step: Callable, start: State, action: Array, key: PRNGKey) -> Array:
        keys = jax.random.split(key, DRAWS)
        gamma = algorithm.config.mappo.gamma
        return jax.vmap(lambda key: returns(step, act, start, action, gamma, key))(keys).mean(0)

    def one(key: PRNGKey, by_policy: Array) -> Float[Array, "4 2 K"]:
        key_policy, key_uniform, *keys = jax.random.split(key, 6)
        uniform = uniform_action(space, row.available, key_uniform)
        action = jnp.where(by_policy, act((None, now), key_policy), uniform)
        worlds = [(simulate, env_state)] * 2 + [(imagine, None)] * 2
        return jnp.stack(
            [
                mean_of_draws(step, (start, now), action, key)
                for (step, start), key in zip(worlds, keys, strict=True)
            ]
        )

    n_actions = BY_POLICY + UNIFORM
    return jax.vmap(one)(jax.random.split(key, n_actions), jnp.arange(n_actions) < BY_POLICY)


def returns(
    step: Callable[[State, Array, PRNGKey], Outcome],
    act: Callable[[State, PRNGKey], Array],
    start: State,
    action: Array,
    gamma: float,
    key: PRNGKey,
) -> Float[Array, "2 K"]:
    """Discounted rewards of one trajectory, and discounted values of its states, at `STEPS`."""

    def advance(carry: tuple, key: PRNGKey) -> tuple[tuple, tuple[Array, Array]]:
        state, action, weight = carry
        key_step, key_act = jax.random.split(key)
        state, reward, goes_on, value = step(state, action, key_step)
        after = gamma * goes_on * weight
        return (state, act(state, key_act), after), (weight * reward, after * value)

    keys = jax.random.split(key, max(STEPS))
    _, (rewards, values) = jax.lax.scan(advance, (start, action, jnp.float32(1)), keys)
    at = jnp.array(STEPS) - 1
    return jnp.stack([jnp.cumsum(rewards)[at], values[at]])


def uniform_action(space: Any, available: Array, key: PRNGKey) -> Array:
    """A joint action, every available one with the same probability."""
    if isinstance(space, Discrete):
        return jax.random.categorical(key, jnp.where(available, 0.0, -jnp.inf))
    return jax.random.uniform(key, available.shape, minval=-1.0, maxval=1.0)


def within_states(a: Float[Array, "S A"], b: Float[Array, "S A"]) -> Float[Array, ""]:
    """Correlation over all actions after each state's mean is taken away."""
    a, b = a - a.mean(1, keepdims=True), b - b.mean(1, keepdims=True)
    return (a * b).sum() / jnp.sqrt((a**2).sum() * (b**2).sum() + 1e-12)
