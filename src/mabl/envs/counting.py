"""A test environment whose every field says which step of which episode it belongs to."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from mabl.envs.counting_host import HostCountingEnv
from mabl.rows import TimeStep
from mabl.types import PRNGKey


class CountingState(NamedTuple):
    """Where the environment is."""

    episode: Int[Array, ""]
    """A number drawn at reset, in all rows of the episode."""
    t: Int[Array, ""]


class CountingEnv:
    """Row t of an episode shows t everywhere, so that any misalignment shows too.

    obs[i] = (t, i, last action of i, episode), state = (t, episode), reward[i] = 100 t + action i;
    action (t mod n) is unavailable at row t. Episodes with an even number terminate at row 5, odd
    ones are truncated at row 7. Agent 1 is dead from row 4 on.
    """

    spec = replace(HostCountingEnv.spec, name="test/counting")

    def reset(self, key: PRNGKey) -> tuple[CountingState, TimeStep]:
        """Start an episode with a random number below 1000."""
        state = CountingState(jax.random.randint(key, (), 0, 1000), jnp.int32(0))
        return state, self._row(state, jnp.zeros(2, jnp.int32))

    def step(
        self, key: PRNGKey, env_state: CountingState, action: Int[Array, "N"]
    ) -> tuple[CountingState, TimeStep]:
        """Count on."""
        del key
        state = env_state._replace(t=env_state.t + 1)
        return state, self._row(state, action.astype(jnp.int32))

    def _row(self, state: CountingState, action: Int[Array, "N"]) -> TimeStep:
        t, episode = state.t, state.episode
        agents = jnp.arange(2)
        first = t == 0
        terminated = (t == 5) & (episode % 2 == 0)
        truncated = t == 7
        columns = jnp.broadcast_arrays(t, agents, action, episode)
        return TimeStep(
            prev_action=action,
            reward=jnp.where(first, 0.0, 100.0 * t + action),
            terminated=jnp.broadcast_to(terminated, 2),
            truncated=truncated,
            obs=jnp.stack(columns, axis=-1).astype(jnp.float32),
            state=jnp.stack([t, episode]).astype(jnp.float32),
            available=jnp.broadcast_to(jnp.arange(3) != t % 3, (2, 3)),
            alive=(agents == 0) | (t < 4),
            is_first=first,
            score=jnp.where(terminated | truncated, episode.astype(jnp.float32), jnp.nan),
        )
