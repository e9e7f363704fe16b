"""Small environments with PettingZoo's Parallel interface, each with something unusual."""

import numpy as np
from gymnasium import spaces


class Leaving:
    """Agent i terminates at step i + 1, and is gone; `stay` of them are there until a limit of 5.

    Agents see (i, t) and a mask in which action number t mod 3 is illegal; actions begin at 1.
    Whoever is there earns 10 t + its action.
    """

    def __init__(self, n=3, stay=0, masked="obs", score=None):
        self.possible_agents = [f"walker_{i}" for i in range(n)]
        self.agents = []
        self._stay, self._masked, self._score = stay, masked, score

    def observation_space(self, agent):
        observation = spaces.Box(-100, 100, (2,), np.float64)
        if self._masked != "obs":
            return observation
        mask = spaces.Box(0, 1, (3,), np.int8)
        return spaces.Dict({"observation": observation, "action_mask": mask})

    def action_space(self, agent):
        return spaces.Discrete(3, start=1)

    def reset(self, seed=None, options=None):
        self.seed, self.t = seed, 0
        self.agents = list(self.possible_agents)
        return self._told()

    def step(self, actions):
        assert set(actions) == set(self.agents), (actions, self.agents)
        assert all(type(a) is int and 1 <= a <= 3 for a in actions.values())
        self.t += 1
        rewards = {agent: 10.0 * self.t + actions[agent] for agent in self.agents}
        n_leaving = len(self.possible_agents) - self._stay
        leaves = {a: i < n_leaving and self.t == i + 1 for i, a in enumerate(self.possible_agents)}
        terminations = {agent: leaves[agent] for agent in self.agents}
        truncations = {agent: self.t == 5 and not leaves[agent] for agent in self.agents}
        obs, infos = self._told()
        over = {agent for agent in self.agents if terminations[agent] or truncations[agent]}
        if self._score is not None:
            infos = {agent: info | {"score": self._score} for agent, info in infos.items()}
        self.agents = [agent for agent in self.agents if agent not in over]
        return obs, rewards, terminations, truncations, infos

    def _told(self):
        mask = (np.arange(3) != self.t % 3).astype(np.int8)
        obs = {a: np.array([self.possible_agents.index(a), self.t], float) for a in self.agents}
        infos = {agent: {} for agent in self.agents}
        if self._masked == "obs":
            obs = {a: {"observation": o, "action_mask": mask} for a, o in obs.items()}
        if self._masked == "info":
            infos = {agent: {"action_mask": mask} for agent in self.agents}
        return obs, infos

    def close(self):
        pass


class Arms(Leaving):
    """Two arms of different length, with actions from 0 to 10."""

    def __init__(self, stay=2):
        super().__init__(n=2, stay=stay, masked=None)

    def action_space(self, agent):
        return spaces.Box(np.array([0.0] * self._size(agent)), 10.0, dtype=np.float64)

    def _size(self, agent):
        return 1 + self.possible_agents.index(agent)

    def step(self, actions):
        for agent, action in actions.items():
            assert action.shape == (self._size(agent),) and action.dtype == np.float64
        self.taken = actions
        return super().step(dict.fromkeys(actions, 1))

    def state(self):
        return np.array([[self.t], [7]])


class Odd(Leaving):
    """Spaces that nobody can learn with."""

    def __init__(self, which):
        super().__init__(masked=None)
        self._which = which

    def observation_space(self, agent):
        if self._which == "sequence":
            return spaces.Sequence(spaces.Discrete(2))
        return super().observation_space(agent)

    def action_space(self, agent):
        if self._which == "several":
            return spaces.MultiDiscrete([2, 2])
        if self._which == "mixed" and agent == "walker_0":
            return spaces.Box(-1, 1, (2,))
        return super().action_space(agent)


def nothing():
    return object()


class Lingering(Leaving):
    """Its agents are truncated at step 5, and stay listed."""

    def __init__(self):
        super().__init__(stay=3)

    def step(self, actions):
        there = list(self.agents)
        told = super().step(actions)
        self.agents = there
        return told
