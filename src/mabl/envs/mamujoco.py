"""Multi-agent MuJoCo: robots whose joints belong to several agents (gymnasium-robotics).

Observations and states are `symlog`s, as velocities reach thousands; actions in [-1, 1] fill the
bounds of the joints. Every agent is paid the same.
"""

import ctypes
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

from mabl.envs.host import Hosted, hosted_of
from mabl.envs.pettingzoo import ParallelEnv
from mabl.errors import UserError

STEPS = 1_000
"""Joint steps after which an episode is truncated."""
TARGET = "mabl.envs.mamujoco:factory"
OPENGL = {"osmesa": ("libOSMesa.so.8", "libOSMesa.so.6"), "egl": ("libEGL.so.1",)}
"""What draws without a display: in software, or on a graphics card."""


class Robot(NamedTuple):
    """A task, and who has which joints."""

    scenario: str
    split: str
    description: str


_BODY = "upper body and legs"
_LEGS = "right and left half, a leg each"

ROBOTS = {
    "Humanoid": Robot("Humanoid", "9|8", f"walk; {_BODY}"),
    "HumanoidStandup": Robot("HumanoidStandup", "9|8", f"get up; {_BODY}"),
    "Humanoid-legs": Robot("Humanoid", "legs", f"walk; {_LEGS}"),
    "HumanoidStandup-legs": Robot("HumanoidStandup", "legs", f"get up; {_LEGS}"),
    **{
        f"{scenario}-{split}": Robot(scenario, split, "")
        for scenario, splits in {
            "Ant": ("2x4", "2x4d", "4x2"),
            "HalfCheetah": ("2x3", "6x1"),
            "Hopper": ("3x1",),
            "Walker2d": ("2x3",),
            "Swimmer": ("2x1",),
            "Reacher": ("2x1",),
            "Pusher": ("3p",),
            "CoupledHalfCheetah": ("1p1",),
            "ManySegmentSwimmer": ("2x3", "4x2", "10x2"),
            "ManySegmentAnt": ("2x3", "4x2", "10x2"),
        }.items()
        for split in splits
    },
}
"""Every task of the library with the splits that it has, and the paper's."""


def make(name: str, **kwargs: Any) -> Hosted:
    """`mamujoco/ROBOT`; `agent_obsk` (0) says how many joints away an agent sees.

    Raises UserError without the extra `mujoco`.
    """
    robot = ROBOTS[name.partition("/")[2]]
    options = {"scenario": robot.scenario, "split": robot.split, "agent_obsk": 0, **kwargs}
    make, draw = (
        partial(ParallelEnv, name, TARGET, options | mode, STEPS, symlog=True)
        for mode in ({}, {"render_mode": "rgb_array"})
    )
    return hosted_of(make, draw)


def factory(scenario: str, split: str, **kwargs: Any) -> Any:
    """The library's own environment. Raises UserError if it is to draw and cannot."""
    if "render_mode" in kwargs:
        choose_opengl()
    try:
        from gymnasium_robotics import mamujoco_v1
    except ModuleNotFoundError as error:
        raise UserError("multi-agent MuJoCo needs an extra: pip install 'mabl[mujoco]'") from error
    if split == "legs":
        kwargs["agent_factorization"] = legs(scenario)
    env = mamujoco_v1.parallel_env(scenario, "9|8" if split == "legs" else split, **kwargs)
    env.metadata = env.metadata | {"render_fps": env.single_agent_env.metadata["render_fps"]}
    return env


def choose_opengl() -> None:
    """Where there is no display, have MuJoCo draw without one, unless it was told how to.

    Raises UserError if there is no library that can.
    """
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("MUJOCO_GL"):
        return
    for name, libraries in OPENGL.items():
        for library in libraries:
            with suppress(OSError):
                ctypes.CDLL(library)
                os.environ["MUJOCO_GL"] = name
                return
    raise UserError("MuJoCo draws with OpenGL, and there is no display: apt install libosmesa6")


def legs(scenario: str) -> Mapping[str, Any]:
    """A split of the humanoid that no library has: one agent for each leg (appendix B.3).

    The right one also has the abdomen, and each the arm on its side: 10 joints and 7.
    """
    from gymnasium_robotics.envs.multiagent_mujoco.obsk import get_parts_and_edges

    parts, edges, everywhere = get_parts_and_edges(scenario, "9|8")
    joints = [joint for part in parts for joint in part]
    left = tuple(joint for joint in joints if joint.label.startswith("left"))
    right = tuple(joint for joint in joints if joint not in left)
    return {"partition": [right, left], "edges": edges, "globals": everywhere}
