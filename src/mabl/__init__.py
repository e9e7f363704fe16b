"""MABL: sample-efficient multi-agent reinforcement learning with bi-level world models.

import mabl
outcome = mabl.train(mabl.preset("quick", "smax/3m", "mabl"))
policy = mabl.Policy.load(outcome.folders[0])
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mabl.algorithms.config import Config
    from mabl.algorithms.presets import preset
    from mabl.errors import UserError
    from mabl.policy import Policy, TeamPolicy
    from mabl.training.run import resume, train

__all__ = ["Config", "Policy", "TeamPolicy", "UserError", "preset", "resume", "train"]

_HOMES = {
    "Config": "mabl.algorithms.config",
    "Policy": "mabl.policy",
    "TeamPolicy": "mabl.policy",
    "UserError": "mabl.errors",
    "preset": "mabl.algorithms.presets",
    "resume": "mabl.training.run",
    "train": "mabl.training.run",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: jax takes seconds, and workers do without."""
    if name not in _HOMES:
        raise AttributeError(f"module 'mabl' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
