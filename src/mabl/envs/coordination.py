"""A tiny coordination task that a learner solves within a minute and a random policy cannot."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mabl.envs.base import Discrete, EnvSpec
from mabl.rows import TimeStep
from mabl.types import PRNGKey

N_CUES = 3
STEPS = 4


class CoordinationState(NamedTuple):
    """Where the game is."""

    cue: Int[Array, ""]
    t: Int[Array, ""]
    earned: Float[Array, ""]
    """Sum of rewards so far."""


class CoordinationEnv:
    """Remember a cue seen once, and answer it together for four steps.

    Both agents see one of three cues at the first row only. At each step the team earns 1 if agent
    0 plays the cue and agent 1 the cue's successor; alone, nobody earns anything. The fourth action
    is never available. A random policy scores 1/9 of the steps; remembering is worth 1.
    """

    spec = EnvSpec(
        name="test/coordination",
        n_agents=2,
        obs_dim=N_CUES + 3,
        state_dim=N_CUES + 1,
        action_space=Discrete(N_CUES + 1),
        episode_limit=STEPS,
        score_name="score",
    )

    def reset(self, key: PRNGKey) -> tuple[CoordinationState, TimeStep]:
        """Draw a cue."""
        state = CoordinationState(
            jax.random.randint(key, (), 0, N_CUES), jnp.int32(0), jnp.float32(0)
        )
        return state, self._row(state, jnp.zeros(2, jnp.int32), jnp.float32(0))

    def step(
        self, key: PRNGKey, env_state: CoordinationState, action: Int[Array, "N"]
    ) -> tuple[CoordinationState, TimeStep]:
        """Answer the cue."""
        del key
        wanted = (env_state.cue + jnp.arange(2)) % N_CUES
        reward = (action == wanted).all().astype(jnp.float32)
        state = env_state._replace(t=env_state.t + 1, earned=env_state.earned + reward)
        return state, self._row(state, action.astype(jnp.int32), reward)

    def _row(self, state: CoordinationState, action: Int[Array, "N"], reward: Array) -> TimeStep:
        cue = jax.nn.one_hot(state.cue, N_CUES)
        time = jnp.float32(state.t / STEPS)[None]
        seen = jnp.concatenate([jnp.where(state.t == 0, cue, 0.0), time])
        obs = jnp.concatenate([jnp.broadcast_to(seen, (2, N_CUES + 1)), jnp.eye(2)], axis=-1)
        terminated = state.t == STEPS
        return TimeStep(
            prev_action=action,
            reward=jnp.broadcast_to(reward, 2),
            terminated=jnp.broadcast_to(terminated, 2),
            truncated=jnp.bool_(False),
            obs=obs,
            state=jnp.concatenate([cue, time]),
            available=jnp.broadcast_to(jnp.arange(N_CUES + 1) < N_CUES, (2, N_CUES + 1)),
            alive=jnp.ones(2, bool),
            is_first=state.t == 0,
            score=jnp.where(terminated, state.earned / STEPS, jnp.nan),
        )
