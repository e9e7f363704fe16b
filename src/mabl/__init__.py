"""MABL: sample-efficient multi-agent reinforcement learning with bi-level world models.

import mabl
outcome = mabl.train(mabl.preset("quick", "smax/3m", "mabl"))
policy = mabl.Policy.load(outcome.folders[0])
"""

from mabl.algorithms.config import Config
from mabl.algorithms.presets import preset
from mabl.errors import UserError
from mabl.policy import Policy, TeamPolicy
from mabl.training.run import resume, train

__all__ = ["Config", "Policy", "TeamPolicy", "UserError", "preset", "resume", "train"]
