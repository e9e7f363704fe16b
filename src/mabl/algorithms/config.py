"""The configuration of a run, composed of what each package owns. Units: joint environment steps."""

from dataclasses import dataclass, field

from mabl.behaviour.mappo import MAPPOConfig
from mabl.world_models.base import WorldModelConfig


@dataclass(frozen=True)
class TrainingConfig:
    """How Algorithm 1 alternates. Defaults are the paper's for SMAC (Tables 2 and 3)."""

    num_envs: int = 1
    """Environments that collect side by side."""
    collect_steps: int | None = None
    """Rows that each environment adds in a cycle; None: one whole episode, as in the paper."""
    model_updates: int = 60
    """World-model updates in a cycle (M)."""
    policy_updates: int = 4
    """Policy updates in a cycle (R)."""
    prefill_steps: int = 500
    """Environment steps collected before learning starts."""
    pretrain_updates: int = 0
    """World-model updates between prefill and the first cycle."""
    replay_capacity: int = 250_000
    """Environment steps that the replay holds."""
    reward_scale: float = 1.0
    """Factor on the environment's rewards for learning; logged returns are unscaled."""


@dataclass(frozen=True)
class Config:
    """One training run."""

    env: str = "smax/3m"
    """Environment: `mabl envs` lists them."""
    algo: str = "mabl"
    """Algorithm: `mabl algos` lists them."""
    preset: str = "quick"
    """Hyperparameters to start from: `quick` (a 2-core CPU) or `paper` (Tables 2 to 4)."""
    total_steps: int = 100_000
    """Environment steps of the run; one step is one joint step of the team."""
    seed: int = 0
    """Decides everything random."""
    num_seeds: int = 1
    """Train seeds `seed .. seed + K - 1` in one program, each in its own run folder."""
    logdir: str = "runs"
    """Where run folders go: LOGDIR/ENV/ALGO/seed_N/TIMESTAMP."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    world_model: WorldModelConfig = field(default_factory=WorldModelConfig)
    mappo: MAPPOConfig = field(default_factory=MAPPOConfig)
