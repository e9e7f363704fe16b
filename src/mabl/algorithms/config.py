"""The configuration of a run, composed of what each package owns. Steps are joint steps."""

import re
import reprlib
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from math import inf
from typing import Any, ClassVar, Literal, TypeVar

from mabl.behaviour.mappo import MAPPOConfig
from mabl.behaviour.qmix import QMIXConfig
from mabl.behaviour.recurrent import RecurrentMAPPOConfig
from mabl.behaviour.recurrent_qmix import RecurrentQMIXConfig
from mabl.errors import UserError, require_between, require_positive, unknown_name
from mabl.imagination import ImaginationConfig
from mabl.nets.product import Precision
from mabl.world_models.base import WorldModelConfig
from mabl.world_models.mamba import CommunicationConfig

T = TypeVar("T")


@dataclass(frozen=True)
class TrainingConfig:
    """How Algorithm 1 alternates. Defaults are the paper's for SMAC (Tables 2 and 3)."""

    FLAG_PREFIX: ClassVar[str] = "training."

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
    diagnose_every: int = 10_000
    """Environment steps between diagnostics of the world model."""
    checkpoint_every: int = 20_000
    """Environment steps between checkpoints."""
    keep_checkpoints: int = 2
    """Checkpoints kept, newest first."""
    max_skipped_updates: int = 20
    """Gradients in a row that may be left out as they are not finite, before the run stops."""

    def __post_init__(self) -> None:
        require_positive(self, "num_envs", "collect_steps", "replay_capacity", "reward_scale")
        require_positive(self, "diagnose_every", "checkpoint_every", "keep_checkpoints")
        require_positive(self, "max_skipped_updates")
        require_between(self, 0, inf, "model_updates", "policy_updates", "prefill_steps")
        require_between(self, 0, inf, "pretrain_updates")


@dataclass(frozen=True)
class LookaheadConfig:
    """How MAG chooses among imagined latents. Defaults are MAG's."""

    FLAG_PREFIX: ClassVar[str] = "lookahead."

    candidates: int = 4
    """Next latents drawn at every imagined step, of which one is kept."""
    steps: int = 6
    """Imagined steps after a candidate over which predicted model errors are summed."""
    hidden: int = 256
    """Width of the error predictor."""
    n_hidden: int = 4
    """Hidden layers of the error predictor."""
    learning_rate: float = 5e-4
    """Adam's learning rate for the error predictor."""

    def __post_init__(self) -> None:
        require_positive(self, "candidates", "steps", "hidden", "n_hidden", "learning_rate")


@dataclass(frozen=True)
class Config:
    """One training run; an algorithm reads the sections that the registry names for it."""

    env: str = "smax/3m"
    """Environment: `mabl envs` lists them."""
    env_kwargs: tuple[str, ...] = ()
    """Arguments that it is made with: KEY=VALUE, values in YAML."""
    algo: str = "mabl"
    """Algorithm: `mabl algos` lists them."""
    label: str = ""
    """What run folders and reports call it; default: the algorithm's name."""
    preset: Literal["quick", "efficient", "paper"] = "quick"
    """Hyperparameters to start from: `quick` (a 2-core CPU), `efficient` (SMAX and SMAC, where
    environment steps are dear: more learning for each) or `paper` (Tables 2 to 4)."""
    total_steps: int = 100_000
    """Environment steps of the run; one step is one joint step of the team."""
    seed: int = 0
    """Decides everything random."""
    num_seeds: int = 1
    """Train seeds `seed .. seed + K - 1` in one program, each in its own run folder."""
    num_devices: int = 1
    """Accelerators to use: seeds are spread over them, and batches where there are fewer seeds."""
    logdir: str = "runs"
    """Where run folders go: LOGDIR/ENV/ALGO/seed_N/TIMESTAMP, or with its label for ALGO."""
    workers: Literal["processes", "ray"] = "processes"
    """Where environments that run in Python do so: on this machine, or in a Ray cluster."""
    num_workers: int | None = None
    """How many workers; 0: the learner's own process; None: one for each core."""
    worker_timeout: float = 60.0
    """Seconds that they may take for a step or a reset before they are replaced."""
    precision: Precision = "float32"
    """Of the operands of layers' matrix products; sums, losses and parameters are float32."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    world_model: WorldModelConfig = field(default_factory=WorldModelConfig)
    communication: CommunicationConfig = field(default_factory=CommunicationConfig)
    imagination: ImaginationConfig = field(default_factory=ImaginationConfig)
    lookahead: LookaheadConfig = field(default_factory=LookaheadConfig)
    mappo: MAPPOConfig = field(default_factory=MAPPOConfig)
    qmix: QMIXConfig = field(default_factory=QMIXConfig)
    recurrent_mappo: RecurrentMAPPOConfig = field(default_factory=RecurrentMAPPOConfig)
    recurrent_qmix: RecurrentQMIXConfig = field(default_factory=RecurrentQMIXConfig)

    @property
    def name(self) -> str:
        """What run folders and reports call the algorithm with these settings."""
        return self.label or self.algo

    @classmethod
    def sections(cls) -> list[str]:
        """Names of the fields that are configurations themselves."""
        return [f.name for f in fields(cls) if is_dataclass(f.type)]

    def __post_init__(self) -> None:
        require_positive(self, "total_steps", "num_seeds", "num_devices", "worker_timeout")
        require_between(self, 0, inf, "num_workers")
        require_between(self, 0, 2**32 - self.num_seeds, "seed")
        if not re.fullmatch(r"[\w.+-]{0,60}", self.label) or self.label.startswith("."):
            raise UserError(
                f"--label is {brief(self.label)}: give at most 60 letters, digits, and - _ + ."
            )


def from_dict(cls: type[T], data: Mapping[str, Any], path: str = "") -> T:
    """A frozen config dataclass from nested plain data, as `dataclasses.asdict` makes it.

    Raises UserError for unknown fields and for values of another type than the field's.
    """
    if not isinstance(data, Mapping):
        raise UserError(f"config {path or 'file'} is {brief(data)}: give a mapping of fields")
    hints = typing.get_type_hints(cls)
    names = [f.name for f in fields(cls)]  # pyright: ignore[reportArgumentType]
    for name in data:
        if name not in names:
            raise unknown_name("config field", f"{path}{name}", (f"{path}{n}" for n in names))
    return cls(
        **{name: _value(hints[name], value, f"{path}{name}") for name, value in data.items()}
    )


def brief(value: Any) -> str:
    """What came, in a few words."""
    try:
        return reprlib.repr(value)
    except ValueError:  # a number of thousands of digits
        return "too large a number"


def is_exponent(value: Any) -> bool:
    """Whether it is a number such as 1e-3, in which YAML wants a point."""
    return isinstance(value, str) and re.fullmatch(r"[+-]?\d+[eE][+-]?\d+", value) is not None


def _value(hint: Any, value: Any, path: str) -> Any:
    if is_dataclass(hint):
        return from_dict(typing.cast(type, hint), value, f"{path}.")
    options = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    if typing.get_origin(hint) is Literal:
        if value in typing.get_args(hint):
            return value
        raise unknown_name(path, brief(value), typing.get_args(hint))
    if float in options and (type(value) is int or is_exponent(value)):
        return float(value)
    if type(value) in options:
        return value
    if typing.get_origin(hint) is tuple and isinstance(value, list | tuple):
        item = typing.get_args(hint)[0]
        return tuple(_value(item, part, f"{path}[{i}]") for i, part in enumerate(value))
    expected = " or ".join(getattr(option, "__name__", str(option)) for option in options)
    raise UserError(f"config field {path} is {brief(value)}: give {expected}")
