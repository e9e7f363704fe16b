"""A tiny continuous task, whose agents have actions of different sizes."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mabl.envs.base import Continuous, EnvSpec
from mabl.rows import TimeStep
from mabl.types import PRNGKey

STEPS = 4
EXISTS = jnp.array([[True, False], [True, True]])
"""Agent 0 has one arm, agent 1 has two."""


class AimingState(NamedTuple):
    """Where the game is."""

    target: Float[Array, ""]
    t: Int[Array, ""]
    earned: Float[Array, ""]
    """Sum of rewards so far."""


class AimingEnv:
    """Remember a target seen once, and aim at it for four steps.

    Both agents see a number from [-1, 1] at the first row only. At each step the team earns
    1 - 1.5 times the mean distance of its three arms from where they should be, or nothing below
    that: agent 0's at the target, agent 1's at its negative and at half of it. Doing nothing scores
    about .4; remembering is worth 1.
    """

    spec = EnvSpec(
        name="test/aiming",
        n_agents=2,
        obs_dim=4,
        state_dim=2,
        action_space=Continuous(2),
        episode_limit=STEPS,
        score_name="score",
        obs_dims=(4, 4),
        action_dims=(1, 2),
    )

    def reset(self, key: PRNGKey) -> tuple[AimingState, TimeStep]:
        """Draw a target."""
        target = jax.random.uniform(key, minval=-1.0)
        state = AimingState(target, jnp.int32(0), jnp.float32(0))
        return state, self._row(state, jnp.zeros((2, 2)), jnp.float32(0))

    def step(
        self, key: PRNGKey, env_state: AimingState, action: Float[Array, "N A"]
    ) -> tuple[AimingState, TimeStep]:
        """Aim."""
        del key
        wanted = env_state.target * jnp.array([[1.0, 0.0], [-1.0, 0.5]])
        distance = (jnp.abs(action - wanted) * EXISTS).sum() / EXISTS.sum()
        reward = jnp.maximum(1 - 1.5 * distance, 0.0)
        state = env_state._replace(t=env_state.t + 1, earned=env_state.earned + reward)
        return state, self._row(state, action, reward)

    def _row(self, state: AimingState, action: Float[Array, "N A"], reward: Array) -> TimeStep:
        first, over = state.t == 0, state.t == STEPS
        shown = jnp.where(first, state.target, 0.0)
        clock = state.t / STEPS
        seen = jnp.stack([shown, first.astype(jnp.float32), clock])
        return TimeStep(
            prev_action=action,
            reward=jnp.broadcast_to(reward, 2),
            terminated=jnp.broadcast_to(over, 2),
            truncated=jnp.bool_(False),
            obs=jnp.concatenate([jnp.broadcast_to(seen, (2, 3)), jnp.arange(2.0)[:, None]], axis=1),
            state=jnp.stack([state.target, clock]),
            available=EXISTS,
            alive=jnp.ones(2, bool),
            is_first=first,
            score=jnp.where(over, state.earned / STEPS, jnp.nan),
        )
