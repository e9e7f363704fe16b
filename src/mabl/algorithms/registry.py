"""Which algorithms there are: compositions of a world model and a way to learn behaviour."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from mabl.algorithms.base import Algorithm
from mabl.algorithms.config import Config
from mabl.algorithms.mag import MAG
from mabl.algorithms.model_based import ModelBased
from mabl.algorithms.model_free import ModelFree
from mabl.algorithms.recurrent_qmix import RecurrentQMIX
from mabl.behaviour.mappo import MAPPO
from mabl.behaviour.qmix import QMIX
from mabl.envs.base import Discrete, EnvSpec
from mabl.errors import UserError, unknown_name
from mabl.world_models.dreamer_v2 import DreamerV2
from mabl.world_models.mabl import MABL
from mabl.world_models.mabl_sg import MABLSG
from mabl.world_models.mamba import MAMBA

IN_IMAGINATION = ("training", "world_model", "imagination", "mappo")
"""Sections of the configuration that MAPPO in a world model's imagination reads."""


@dataclass(frozen=True)
class Entry:
    """An algorithm by name, and where it stands in the paper's comparison (appendix B.5)."""

    build: Callable[[EnvSpec, Config], Algorithm]
    description: str
    sections: tuple[str, ...] = IN_IMAGINATION
    """Sections of `Config` that it reads."""
    sees_team: bool = True
    """Each agent's model, or without one its critic's input, knows all observations in training."""
    sees_state: bool = True
    """It knows other global information: the state."""
    decentralised: bool = True
    """An agent acts on its own observations alone."""
    shared: bool = True
    """Agents share the parameters of the model, or without one of the policy."""
    discrete: bool = False
    """It is for discrete actions alone."""


class Column(NamedTuple):
    """A column of the paper's conceptual comparison (table 6)."""

    field: str
    heading: str


COLUMNS = (
    Column("sees_team", "knows all observations"),
    Column("sees_state", "knows the state"),
    Column("decentralised", "acts decentralised"),
    Column("shared", "shares parameters"),
)

ALGORITHMS = {
    "mabl": Entry(
        lambda spec, config: ModelBased(MABL, MAPPO(config.mappo), spec, config),
        "bi-level world model, MAPPO in imagination",
    ),
    "mabl-sg": Entry(
        lambda spec, config: ModelBased(MABLSG, MAPPO(config.mappo), spec, config),
        "ablation of MABL: one global latent, shared by the team",
    ),
    "mabl-qmix": Entry(
        lambda spec, config: ModelBased(MABL, QMIX(config.qmix), spec, config),
        "MABL's world model, QMIX in imagination",
        sections=("training", "world_model", "imagination", "qmix"),
        discrete=True,
    ),
    "dreamer-v2": Entry(
        lambda spec, config: ModelBased(DreamerV2, MAPPO(config.mappo), spec, config),
        "world model of each agent's own observations, MAPPO in imagination",
        sees_team=False,
        sees_state=False,
    ),
    "mamba": Entry(
        lambda spec, config: ModelBased(
            partial(MAMBA, communication=config.communication), MAPPO(config.mappo), spec, config
        ),
        "world model whose agents talk through a transformer, MAPPO in imagination",
        sections=(*IN_IMAGINATION, "communication"),
        sees_state=False,
        decentralised=False,
    ),
    "mag": Entry(
        lambda spec, config: MAG(
            ModelBased(
                partial(MAMBA, communication=config.communication, shared=False),
                MAPPO(config.mappo),
                spec,
                config,
            )
        ),
        "MAMBA with a model for each agent, and imagination that looks ahead",
        sections=(*IN_IMAGINATION, "communication", "lookahead"),
        sees_state=False,
        decentralised=False,
        shared=False,
    ),
    "mappo": Entry(
        ModelFree,
        "no world model: recurrent MAPPO on real episodes",
        sections=("training", "recurrent_mappo"),
    ),
    "qmix": Entry(
        RecurrentQMIX,
        "no world model: recurrent QMIX on replayed real episodes",
        sections=("training", "recurrent_qmix"),
        discrete=True,
    ),
}


def entry(name: str) -> Entry:
    """The algorithm of that name. Raises UserError for an unknown one."""
    if name not in ALGORITHMS:
        raise unknown_name("algorithm", name, ALGORITHMS)
    return ALGORITHMS[name]


def unread(algo: str) -> list[str]:
    """Sections of the configuration that an algorithm does not read."""
    return [name for name in Config.sections() if name not in entry(algo).sections]


def make(config: Config, spec: EnvSpec) -> Algorithm:
    """The algorithm of `config` for an environment.

    Raises UserError for an unknown name, for actions that it cannot take, and for a replay
    too small for a sequence or for what a cycle collects.
    """
    chosen = entry(config.algo)
    if chosen.discrete and not isinstance(spec.action_space, Discrete):
        raise UserError(f"{spec.name} has continuous actions, {config.algo} needs discrete ones")
    algorithm = chosen.build(spec, config)
    plan = config.training
    needed = plan.num_envs * max(
        algorithm.rows_needed, plan.collect_steps or spec.episode_limit + 1
    )
    if plan.replay_capacity < needed:
        environments = "environment" if plan.num_envs == 1 else "environments"
        raise UserError(
            f"--training.replay-capacity {plan.replay_capacity} is too small for "
            f"{plan.num_envs} {environments} of {spec.name}: give at least {needed}"
        )
    return algorithm
