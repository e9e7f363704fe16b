"""The counting environment once more, in Python."""

import numpy as np

from mabl.envs.base import Discrete, EnvSpec
from mabl.rows import TimeStep


class HostCountingEnv:
    """See `counting.CountingEnv`, which this repeats row by row; the seed decides the episode."""

    spec = EnvSpec(
        name="test/host-counting",
        n_agents=2,
        obs_dim=4,
        state_dim=2,
        action_space=Discrete(3),
        episode_limit=7,
        score_name="score",
    )

    def reset(self, seed: int) -> TimeStep:
        """Start the episode whose number are the last three digits of the seed."""
        self._t, self._episode = 0, seed % 1000
        return self._row(np.zeros(2, np.int32))

    def step(self, action: np.ndarray) -> TimeStep:
        """Count on."""
        self._t += 1
        return self._row(action)

    def close(self) -> None:
        """Nothing to let go of."""

    def _row(self, action: np.ndarray) -> TimeStep:
        t, episode = self._t, self._episode
        terminated = t == 5 and episode % 2 == 0
        truncated = t == 7
        return TimeStep(
            prev_action=action,
            reward=100.0 * t + action if t else np.zeros(2),
            terminated=np.full(2, terminated),
            truncated=np.bool_(truncated),
            obs=np.array([(t, i, action[i], episode) for i in range(2)], np.float32),
            state=np.array([t, episode], np.float32),
            available=np.broadcast_to(np.arange(3) != t % 3, (2, 3)),
            alive=np.array([True, t < 4]),
            is_first=np.bool_(t == 0),
            score=np.float32(episode if terminated or truncated else np.nan),
        )
