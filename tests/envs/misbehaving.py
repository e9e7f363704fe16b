"""A counting environment that does, at a given moment, what environments should not do."""

import os
import sys
import time
from dataclasses import dataclass, replace

import numpy as np

from mabl.envs.counting_host import HostCountingEnv
from mabl.envs.host import Hosted


@dataclass
class Misbehaving:
    """At step `at` of an episode whose number is in `episodes` (empty: any), `how`."""

    how: str
    at: int
    episodes: tuple[int, ...] = ()

    spec = replace(HostCountingEnv.spec, name="test/misbehaving")

    def __post_init__(self):
        if self.how == "cannot be made":
            raise RuntimeError("no game here")
        self.inner = HostCountingEnv()

    def reset(self, seed):
        row = self.inner.reset(seed)
        if self.how == "tells of jax":
            return row._replace(score=np.float32("jax" in sys.modules))
        return self.misbehave(row)

    def step(self, action):
        return self.misbehave(self.inner.step(action))

    def misbehave(self, row):
        t, episode = row.state
        if t != self.at or (self.episodes and episode not in self.episodes):
            return row
        if self.how == "dies":
            os._exit(1)
        if self.how == "hangs":
            time.sleep(600)
        if self.how == "raises":
            raise ValueError("the train left the rails")
        if self.how == "gives NaN":
            obs = row.obs.copy()
            obs[1, 2] = np.nan
            return row._replace(obs=obs)
        if self.how == "gives another shape":
            return row._replace(reward=np.zeros(3))
        raise AssertionError(self.how)

    def close(self):
        self.inner.close()


@dataclass(frozen=True)
class Maker:
    """Makes them, in another process too."""

    how: str
    at: int = 2
    episodes: tuple[int, ...] = ()

    def __call__(self):
        return Misbehaving(self.how, self.at, self.episodes)


def hosted(how: str, at: int = 2, episodes: tuple[int, ...] = ()) -> Hosted:
    return Hosted(Misbehaving.spec, Maker(how, at, episodes))
