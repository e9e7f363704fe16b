"""Which algorithms there are."""

from collections.abc import Callable
from dataclasses import dataclass

from mabl.algorithms.config import Config
from mabl.algorithms.model_based import ModelBased
from mabl.envs.base import Discrete, EnvSpec
from mabl.errors import UserError, unknown_name
from mabl.world_models.mabl import MABL


@dataclass(frozen=True)
class Entry:
    """An algorithm by name."""

    build: Callable[[EnvSpec, Config], ModelBased]
    description: str


ALGORITHMS = {
    "mabl": Entry(
        lambda spec, config: ModelBased(MABL, spec, config),
        "bi-level world model, MAPPO in imagination, decentralised execution",
    ),
}


def make(config: Config, spec: EnvSpec) -> ModelBased:
    """The algorithm of `config` for an environment.

    Raises UserError for an unknown name, for actions that it cannot take, and for a replay
    too small for one episode.
    """
    if config.algo not in ALGORITHMS:
        raise unknown_name("algorithm", config.algo, ALGORITHMS)
    if not isinstance(spec.action_space, Discrete):
        raise UserError(f"{spec.name} has continuous actions, {config.algo} needs discrete ones")
    plan = config.training
    needed = (spec.episode_limit + 1) * plan.num_envs
    if plan.collect_steps is None and plan.replay_capacity < needed:
        raise UserError(
            f"--training.replay-capacity {plan.replay_capacity} cannot hold an episode of "
            f"{spec.name} from each environment: give at least {needed}"
        )
    return ALGORITHMS[config.algo].build(spec, config)
