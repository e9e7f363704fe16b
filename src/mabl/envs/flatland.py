"""Flatland 2.2.2, the version that the paper's results rest on: trains on a new map every episode.

Three actions: 0 takes the leftmost way on, 1 the second one, 2 stops (or does not depart). Where
there is nothing to decide, away from switches and while broken, 0 is the only one available.
"""

from functools import partial
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from mabl.envs import rails
from mabl.envs.base import Discrete, EnvSpec
from mabl.envs.host import Hosted
from mabl.envs.rails import FORWARD, Rails, Train
from mabl.errors import UserError
from mabl.rows import TimeStep

VERSION = "2.2.2"
STOP = 4
"""The simulator's action."""
ARRIVAL, PROGRESS, DEADLOCK = 10.0, 0.01, -5.0
"""Rewards: once for arriving, for each cell nearer to the target, once for being stuck for ever."""


class Task(NamedTuple):
    """A line of table 5."""

    n_agents: int
    n_cities: int
    malfunction_rate: float
    size: int = 35

    @property
    def episode_limit(self) -> int:
        """Joint steps that the simulator gives: 573 and 580."""
        return int(8 * (2 * self.size + self.n_agents / self.n_cities))


TASKS = {"5_agents": Task(5, 3, 1 / 100), "10_agents": Task(10, 4, 1 / 150)}
"""Table 5: at most two rails between cities and four within, cities not on a grid."""


def make(name: str) -> Hosted:
    """`flatland/5_agents` or `flatland/10_agents`. Raises UserError without the extra."""
    check_installed()
    return Hosted(spec_of(name), partial(Flatland, name), heuristic=_shortest_path)


def _shortest_path() -> Any:
    from mabl.envs.shortest_path import ShortestPath  # workers do without jax

    return ShortestPath()


def check_installed() -> None:
    """Raises UserError where Flatland is missing, or is another version."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        found = version("flatland-rl")
    except PackageNotFoundError as error:
        raise UserError("Flatland needs an extra: pip install 'mabl[flatland]'") from error
    if found != VERSION:
        raise UserError(
            f"flatland-rl {found} is installed, and the paper's results rest on {VERSION}, whose "
            f"maps and rules differ: pip install flatland-rl=={VERSION}"
        )


def spec_of(name: str) -> EnvSpec:
    """Sizes and names of a task."""
    task = TASKS[name.partition("/")[2]]
    return EnvSpec(
        name=name,
        n_agents=task.n_agents,
        obs_dim=rails.FEATURES,
        state_dim=task.n_agents * rails.FEATURES,
        action_space=Discrete(3),
        episode_limit=task.episode_limit,
        score_name="arrived",
    )


class Flatland:
    """One railway. A train's episode is over when it has arrived, or can never move again.

    `score` is the share of trains that arrived.
    """

    def __init__(self, name: str):
        from flatland.core.env_observation_builder import DummyObservationBuilder
        from flatland.envs.malfunction_generators import MalfunctionParameters, ParamMalfunctionGen
        from flatland.envs.rail_env import RailEnv
        from flatland.envs.rail_generators import sparse_rail_generator
        from flatland.envs.schedule_generators import sparse_schedule_generator

        self.spec, task = spec_of(name), TASKS[name.partition("/")[2]]
        self._env: Any = RailEnv(
            width=task.size,
            height=task.size,
            rail_generator=sparse_rail_generator(
                max_num_cities=task.n_cities,
                grid_mode=False,
                max_rails_between_cities=2,
                max_rails_in_city=4,
            ),
            schedule_generator=sparse_schedule_generator({1.0: 1.0}),
            number_of_agents=task.n_agents,
            obs_builder_object=DummyObservationBuilder(),
            malfunction_generator=ParamMalfunctionGen(
                MalfunctionParameters(task.malfunction_rate, min_duration=20, max_duration=50)
            ),
            remove_agents_at_target=True,
        )
        self._renderer: Any = None

    def reset(self, seed: int) -> TimeStep:
        """A new map, new trains."""
        self._env.reset(random_seed=seed % (2**31 - 2) + 1)  # 0 is no seed to it
        n = self.spec.n_agents
        self._rails = Rails(np.asarray(self._env.rail.grid))
        distance = np.asarray(self._env.distance_map.get())
        self._distance = [each.ravel().tolist() for each in distance]
        self._luck = np.random.default_rng(seed).random(n).tolist()
        self._stuck, self._arrived = np.zeros(n, bool), np.zeros(n, bool)
        self._t, self._renderer = 0, None
        self._trains = self._look()
        return self._row(np.zeros(n, np.int32), np.zeros(n, np.float32), np.ones(n, bool))

    def step(self, action: np.ndarray) -> TimeStep:
        """Move all trains."""
        before, alive = self._trains, ~(self._arrived | self._stuck)
        orders = {
            i: order
            for i, train in enumerate(before)
            if alive[i] and (order := self._order(train, int(action[i]))) is not None
        }
        self._env.step(orders)
        self._t += 1
        self._arrived |= [agent.status.value >= 2 for agent in self._env.agents]  # done, or removed
        self._trains = self._look()
        gained = [_gained(*pair) for pair in zip(before, self._trains, strict=True)]
        reward = PROGRESS * np.array(gained, np.float32) * alive
        reward += ARRIVAL * (alive & self._arrived)
        for i in rails.deadlocked(self._rails, self._trains):
            if not self._stuck[i]:
                self._stuck[i] = True
                reward[i] += DEADLOCK
                self._trains[i] = self._trains[i]._replace(deadlocked=True)
        return self._row(action, reward, alive)

    def render(self) -> np.ndarray:
        """The map and its trains."""
        if self._renderer is None:
            from flatland.utils.rendertools import AgentRenderVariant, RenderTool

            self._renderer = RenderTool(
                self._env,
                gl="PILSVG",
                agent_render_variant=AgentRenderVariant.ONE_STEP_BEHIND,
                screen_height=800,
                screen_width=800,
            )
        self._renderer.render_env(show=False, show_observations=False, show_predictions=False)
        return np.asarray(self._renderer.get_image())[..., :3].astype(np.uint8)

    def close(self) -> None:
        """Nothing to let go of."""

    def _order(self, train: Train, action: int) -> int | None:
        if action == 2:
            return None if train.ready else STOP
        ways = self._rails.exits[train.node]
        return ways[min(action, len(ways) - 1)].action if ways else FORWARD

    def _look(self) -> list[Train]:
        """Where trains are; those that have arrived count as being at their target."""
        trains = []
        for i, agent in enumerate(self._env.agents):
            position = agent.position
            if position is None:
                position = agent.target if self._arrived[i] else agent.initial_position
            trains.append(
                Train(
                    node=4 * (position[0] * self._rails.columns + position[1])
                    + int(agent.direction),
                    on_rails=agent.position is not None,
                    deadlocked=bool(self._stuck[i]),
                    broken=agent.malfunction_data["malfunction"] > 0,
                    ready=agent.status.value == 0,
                    distance=self._distance[i],
                    luck=self._luck[i],
                )
            )
        return trains

    def _row(self, action: np.ndarray, reward: np.ndarray, alive: np.ndarray) -> TimeStep:
        terminated = self._arrived | self._stuck
        ended = bool(terminated.all())
        truncated = not ended and self._t >= self.spec.episode_limit
        obs = rails.observe(self._rails, self._trains) * alive[:, None]
        return TimeStep(
            prev_action=action,
            reward=reward.astype(np.float32),
            terminated=terminated,
            truncated=np.bool_(truncated),
            obs=obs,
            state=obs.ravel(),
            available=np.array([self._available(i) for i in range(len(alive))]),
            alive=alive,
            is_first=np.bool_(self._t == 0),
            score=np.float32(self._arrived.mean() if ended or truncated else np.nan),
        )

    def _available(self, i: int) -> list[bool]:
        train = self._trains[i]
        over = bool(self._arrived[i] or self._stuck[i])
        fork = self._rails.is_switch(train.node)
        decides = fork or train.ready or self._rails.is_near_decision(train.node)
        if over or train.broken or not decides:
            return [True, False, False]
        return [True, fork, True]


def _gained(before: Train, after: Train) -> float:
    """Cells by which a train came nearer to its target; 0 where that cannot be reached."""
    gained = before.distance[before.node] - after.distance[after.node]
    return gained if isfinite(gained) else 0.0
