"""A battle without StarCraft: what the official environment gives, asks and refuses, in its types.

Agent i dies at step 3 if it moved then (action 2) and is otherwise safe; the team wins as soon as
everybody living attacks (action 3 + i), each on their own enemy.
"""

import numpy as np


class FakeSMAC:
    def __init__(
        self,
        map_name="3s_vs_5z",
        seed=None,
        difficulty="7",
        continuing_episode=False,
        limit=6,
        crash_at=None,
    ):
        self.n_agents, self.n_actions, self.episode_limit = 3, 6, limit
        self.map_name, self.seed, self.continuing_episode = map_name, seed, continuing_episode
        self._crash_at, self._t = crash_at, None

    def get_env_info(self):
        return {
            "state_shape": 5,
            "obs_shape": 4,
            "n_actions": self.n_actions,
            "n_agents": self.n_agents,
            "episode_limit": self.episode_limit,
        }

    def reset(self):
        self._t, self._dead = 0, set()
        return self.get_obs(), self.get_state()

    def step(self, actions):
        actions = [int(a) for a in actions]
        for i, action in enumerate(actions):
            assert self.get_avail_agent_actions(i)[action] == 1, f"{i} cannot {action}"
        self._t += 1
        if self._t == self._crash_at:
            return 0, True, {}
        if self._t == 3:
            self._dead |= {i for i, action in enumerate(actions) if action == 2}
        living = [i for i in range(3) if i not in self._dead]
        info = {"battle_won": False, "dead_allies": len(self._dead), "dead_enemies": 0}
        won = bool(living) and all(actions[i] == 3 + i for i in living)
        terminated = won or not living
        if terminated:
            info["battle_won"] = won
        elif self._t >= self.episode_limit:
            terminated = True
            if self.continuing_episode:
                info["episode_limit"] = True
        return float(sum(actions)) / 7, terminated, info

    def get_obs(self):
        return [self.get_obs_agent(i) for i in range(3)]

    def get_obs_agent(self, i):
        if i in self._dead:
            return np.zeros(4, np.float32)
        return np.array([i, self._t, len(self._dead), 1], np.float32)

    def get_state(self):
        return np.array([self._t, *(i in self._dead for i in range(3)), 9], np.float32)

    def get_avail_actions(self):
        return [self.get_avail_agent_actions(i) for i in range(3)]

    def get_avail_agent_actions(self, i):
        if i in self._dead:
            return [1] + [0] * 5
        return [0, 1, 1] + [int(j == i) for j in range(3)]

    def close(self):
        self._t = None


class Cousin(FakeSMAC):
    """The same in other types: tuples, numpy's scalars and booleans, actions of Python alone."""

    def get_env_info(self):
        info = super().get_env_info()
        return info | {"obs_shape": (4,), "state_shape": (5,), "n_agents": np.int64(3)}

    def step(self, actions):
        assert type(actions) is list and all(type(a) is int for a in actions)
        reward, terminated, info = super().step(actions)
        return np.float64(reward), np.bool_(terminated), info

    def get_obs(self):
        return tuple(obs.tolist() for obs in super().get_obs())

    def get_state(self):
        return super().get_state().tolist()

    def get_avail_actions(self):
        return tuple(np.array(mask, float) for mask in super().get_avail_actions())


class Lite(FakeSMAC):
    """As gymnasium has it, without a limit of its own, as SMAClite."""

    def get_env_info(self):
        return super().get_env_info() | {"episode_limit": None}

    def reset(self, seed=None, options=None):
        return tuple(super().reset()[0]), {}

    def step(self, actions):
        reward, terminated, info = super().step(actions)
        won = info.get("battle_won", False)
        return tuple(self.get_obs()), reward, terminated, False, {"battle_won": won}
