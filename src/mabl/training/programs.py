"""A run's compiled programs, traced once for all runs of a process that compute the same."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import lru_cache, partial, wraps
from typing import Any, NamedTuple

import jax
from jax.sharding import Mesh

from mabl.algorithms import registry as algorithms
from mabl.algorithms.config import Config
from mabl.devices import SEEDS, by_seed, grid, traced_for
from mabl.envs import registry as envs
from mabl.envs.host import Hosted
from mabl.nets.product import in_precision
from mabl.training.hosting import Cycle, hosted_cycle
from mabl.training.loop import Training, TrainState
from mabl.types import Metrics

DIAGNOSE = 2**31 - 1
"""Sets the diagnostics' random key apart from those that training splits off."""


class Programs(NamedTuple):
    """What is computed for all seeds of a run at once; states have a leading axis of seeds."""

    training: Training
    init: Any
    """First states from keys `[S]`."""
    place: Callable[[TrainState], TrainState]
    """Puts states where they are computed."""
    open_cycle: Callable[[Config], AbstractContextManager[Cycle]]
    """Goes on from states, with the workers of the run's own config if there are any."""
    diagnose: Callable[[TrainState], Metrics]


_UNCOMPILED = (
    *("label", "preset", "seed", "total_steps", "logdir"),
    *("workers", "num_workers", "worker_timeout"),
)
"""Fields of a config that no program depends on."""


def build(config: Config) -> Training:
    """The algorithm of a config in its environment."""
    env = envs.make(config.env, config.env_kwargs)
    return Training(env, algorithms.make(config, env.spec))


def programs(config: Config) -> Programs:
    """The programs of a run. Runs that differ in seed, length or folder alone share them.

    No program may depend on these: in `training.algorithm.config` they are not the run's.
    """
    plain = Config()
    names = (*_UNCOMPILED, *algorithms.unread(config.algo))
    same = replace(config, **{name: getattr(plain, name) for name in names})
    return _programs(same, algorithms.entry(config.algo), envs.family(config.env))


@lru_cache(maxsize=2)
def _programs(config: Config, *registered: Any) -> Programs:
    """Another entry registered under a name has programs of its own; what it names is not seen."""
    del registered
    training = build(config)

    def diagnose(state: TrainState) -> Metrics:
        key = jax.random.fold_in(state.key, DIAGNOSE)
        return training.algorithm.diagnose(state.learner, state.replay, key)

    return Programs(
        training,
        init=_over_seeds(training.init, config),
        place=partial(jax.device_put, device=by_seed(grid_of(config))),
        open_cycle=_open_cycle(training, config),
        diagnose=_over_seeds(diagnose, config),
    )


def _open_cycle(training: Training, config: Config) -> Callable[[Config], Any]:
    if isinstance(training.env, Hosted):
        learn = _over_seeds(training.learn, config, n_states=3, donate=True)
        return hosted_cycle(training, learn, config.num_seeds)
    cycle = _over_seeds(training.cycle, config, donate=True)
    return lambda config: nullcontext(cycle)


forget_programs = _programs.cache_clear
"""Lets go of them."""


def grid_of(config: Config) -> Mesh:
    """The devices of a run."""
    return grid(config.num_devices, config.num_seeds)


def _over_seeds(function: Any, config: Config, n_states: int = 1, donate: bool = False) -> Any:
    """Compile a function of one seed's state for all seeds; a single seed is spared the vmap.

    All but the first `n_states` arguments are trip counts. They stay scalars, so that loops are not
    masked. The first argument may be donated.
    """

    def mapped(*arguments: Any) -> Any:
        states, counts = arguments[:n_states], arguments[n_states:]
        if config.num_seeds > 1:
            axes = (*[0] * n_states, *[None] * len(counts))
            return jax.vmap(function, in_axes=axes, spmd_axis_name=SEEDS)(*arguments)
        one = jax.tree.map(lambda x: x[0], states)
        return jax.tree.map(lambda x: x[None], function(*one, *counts))

    return jax.jit(
        as_in_a_run(mapped, config),
        donate_argnums=0 if donate else (),
        out_shardings=by_seed(grid_of(config)),
    )


def as_in_a_run(function: Callable[..., Any], config: Config) -> Callable[..., Any]:
    """The function, traced in the precision and for the devices of a run."""

    @wraps(function)
    def traced(*arguments: Any) -> Any:
        with traced_for(grid_of(config)):
            return function(*arguments)

    return in_precision(config.precision, traced)
