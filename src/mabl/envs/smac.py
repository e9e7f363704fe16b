"""SMAC, SMACv2 and whatever has their interface: `get_obs`, `get_state`, `get_avail_actions`."""

import inspect
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mabl.envs.base import Discrete, EnvSpec
from mabl.envs.host import Hosted, hosted_of, load_factory, made
from mabl.errors import UserError
from mabl.rows import TimeStep

MAPS = {
    "2s_vs_1sc": "2 stalkers against a spine crawler; easy",
    "3s_vs_4z": "3 stalkers against 4 zealots; easy",
    "3s_vs_5z": "3 stalkers against 5 zealots; hard",
    "corridor": "6 zealots against 24 zerglings; super hard",
    "3s5z_vs_3s6z": "3 stalkers and 5 zealots against one zealot more; super hard",
    **dict.fromkeys(
        ("3m", "8m", "25m", "5m_vs_6m", "8m_vs_9m", "10m_vs_11m", "27m_vs_30m"), "marines"
    ),
    **dict.fromkeys(("2s3z", "3s5z", "3s_vs_3z"), "stalkers and zealots"),
    **dict.fromkeys(("MMM", "MMM2"), "marines, marauders and a medivac"),
    **dict.fromkeys(("1c3s5z", "2c_vs_64zg"), "with colossi"),
    **dict.fromkeys(("6h_vs_8z", "bane_vs_bane", "so_many_baneling"), "with zerg"),
}
"""SMAC's maps; the first five are the paper's."""

RACES = {
    "terran": (["marine", "marauder", "medivac"], ["medivac"]),
    "protoss": (["stalker", "zealot", "colossus"], []),
    "zerg": (["zergling", "hydralisk", "baneling"], ["baneling"]),
}
"""SMACv2's units, drawn in shares of .45, .45 and .1, and which do not make a team alone."""

SIZES = ((5, 5), (10, 10), (10, 11), (20, 20), (20, 23))
"""SMACv2's numbers of allies and enemies."""

INSTALL = {
    "smac": "pip install git+https://github.com/oxwhirl/smac.git",
    "smacv2": "pip install git+https://github.com/oxwhirl/smacv2.git",
}

_PLAY = {"difficulty": "7", "continuing_episode": True}
"""As the paper's code family plays; `continuing_episode` tells time limits from defeats."""


def make_map(name: str, **kwargs: Any) -> Hosted:
    """`smac/MAP`: official SMAC. Raises UserError where it or the game is missing."""
    options = {"map_name": name.partition("/")[2], **_PLAY, **kwargs}
    return _official(name, "smac.env:StarCraft2Env", options)


def make_generated(name: str, race: str, n_units: int, n_enemies: int, **kwargs: Any) -> Hosted:
    """`smacv2/RACE_N_vs_M`. Raises UserError where SMACv2 or the game is missing."""
    units, exceptions = RACES[race]
    options = {
        "map_name": f"10gen_{race}",
        "capability_config": {
            "n_units": n_units,
            "n_enemies": n_enemies,
            "team_gen": {
                "dist_type": "weighted_teams",
                "unit_types": units,
                "weights": [0.45, 0.45, 0.1],
                "exception_unit_types": exceptions,
                "observe": True,
            },
            "start_positions": {
                "dist_type": "surrounded_and_reflect",
                "p": 0.5,
                "map_x": 32,
                "map_y": 32,
            },
        },
        "conic_fov": False,
        "obs_own_pos": True,
        "use_unit_ranges": True,
        "min_attack_range": 2,
        "num_fov_actions": 12,
        **_PLAY,
        **kwargs,
    }
    target = "smacv2.env.starcraft2.wrapper:StarCraftCapabilityEnvWrapper"
    return _official(name, target, options)


def _official(name: str, target: str, options: dict[str, Any]) -> Hosted:
    package = target.partition(".")[0]
    missing = UserError(
        f"{name} needs {package}: {INSTALL[package]}\n"
        "and StarCraft II for Linux (4.10) with its maps; SC2PATH names their folder"
    )
    try:
        hosted = make(name, target, options)
    except UserError as error:
        if not isinstance(error.__cause__, ModuleNotFoundError):
            raise
        raise missing from error
    except KeyError as error:
        raise UserError(f"{name}: {package} has no map {error}") from error
    if not Path(os.environ.get("SC2PATH", "~/StarCraftII")).expanduser().is_dir():
        raise missing
    return hosted


def make(
    name: str, target: str, kwargs: Mapping[str, Any], episode_limit: int | None = None
) -> Hosted:
    """Anything with SMAC's interface, from `module:factory` called with `kwargs`.

    Episodes are truncated after `episode_limit` joint steps, if not before. Raises UserError for
    what cannot be imported.
    """
    return hosted_of(partial(SmacEnv, name, target, dict(kwargs), episode_limit))


class SmacEnv:
    """Rows of an environment with SMAC's interface; action 0 is for the dead alone."""

    def __init__(
        self, name: str, target: str, kwargs: dict[str, Any], episode_limit: int | None = None
    ):
        self._factory, self._kwargs = load_factory(name, target, "StarCraft2Env"), kwargs
        self._env = made(name, self._factory, kwargs)
        self._seeded = False
        info = self._env.get_env_info()
        limit = episode_limit or info.get("episode_limit")
        if not limit:
            raise UserError(f"{name} has no episode limit: give --env-kwargs episode_limit=200")
        self.spec = EnvSpec(
            name=name,
            n_agents=int(info["n_agents"]),
            obs_dim=int(np.prod(info["obs_shape"])),
            state_dim=int(np.prod(info["state_shape"])),
            action_space=Discrete(int(info["n_actions"])),
            episode_limit=int(limit),
            score_name="win_rate",
        )

    def reset(self, seed: int) -> TimeStep:
        """Start an episode. The first one's seed is the game's, which draws the others itself."""
        if not self._seeded:
            self._seed(seed)
        self._env.reset()
        self._t = 0
        return self._row(np.zeros(self.spec.n_agents, np.int32), 0.0, False, False, 0.0)

    def _seed(self, seed: int) -> None:
        """Made with a seed, where the factory takes one and none was given."""
        self._seeded = True
        takes = inspect.signature(self._factory).parameters
        generous = any(p.kind is p.VAR_KEYWORD for p in takes.values())
        if ("seed" in takes or generous) and "seed" not in self._kwargs:
            self._env.close()
            self._env = self._factory(**self._kwargs, seed=seed % 2**31)

    def step(self, action: np.ndarray) -> TimeStep:
        """Take one joint step. Raises RuntimeError when the game has crashed."""
        answer = self._env.step([int(a) for a in action])
        self._t += 1
        if len(answer) == 5:  # as gymnasium does it
            _, reward, terminated, truncated, info = answer
        else:
            reward, terminated, info = answer
            truncated = bool(info.get("episode_limit", False))
            if terminated and not info:
                raise RuntimeError("the game crashed")
        won = bool(info.get("battle_won", False))
        terminated = bool(terminated) and not truncated
        row = self._row(action, float(np.mean(reward)), terminated, bool(truncated), float(won))
        if self._t < self.spec.episode_limit or truncated:
            return row
        # Nobody told the end of a battle from that of its time: a win or a defeat is the former.
        decided = terminated and (won or not row.alive.any())
        return self._ended(row, bool(decided), not decided, float(won))

    def render(self) -> np.ndarray:
        """What the environment draws."""
        return np.asarray(self._env.render(mode="rgb_array"))

    def close(self) -> None:
        """Let go of the game."""
        self._env.close()

    def _row(
        self, action: np.ndarray, reward: float, terminated: bool, truncated: bool, won: float
    ) -> TimeStep:
        n = self.spec.n_agents
        available = np.array(self._env.get_avail_actions(), bool)
        alive: Any = available[:, 1:].any(-1)
        available[~alive, 0] = True
        row = TimeStep(
            prev_action=action,
            reward=np.full(n, reward, np.float32),
            terminated=np.zeros(n, bool),
            truncated=np.bool_(False),
            obs=np.array(self._env.get_obs(), np.float32) * alive[:, None],
            state=np.asarray(self._env.get_state(), np.float32).ravel(),
            available=available,
            alive=alive,
            is_first=np.bool_(self._t == 0),
            score=np.float32(np.nan),
        )
        return self._ended(row, terminated, truncated, won)

    def _ended(self, row: TimeStep, terminated: bool, truncated: bool, won: float) -> TimeStep:
        return row._replace(
            terminated=np.full(self.spec.n_agents, terminated),
            truncated=np.bool_(truncated),
            score=np.float32(won if terminated or truncated else np.nan),
        )
