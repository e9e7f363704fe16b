"""A run's compiled programs, traced once for all runs of a process that compute the same."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import jax

from mabl.algorithms import registry as algorithms
from mabl.algorithms.config import Config
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
    open_cycle: Callable[[Config], AbstractContextManager[Cycle]]
    """Goes on from states, with the workers of the run's own config if there are any."""
    diagnose: Callable[[TrainState], Metrics]


_UNCOMPILED = (
    *("preset", "seed", "total_steps", "logdir"),
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
        init=jax.jit(jax.vmap(training.init)),
        open_cycle=_open_cycle(training, config.num_seeds),
        diagnose=_over_seeds(in_precision(config.precision, diagnose), config.num_seeds),
    )


def _open_cycle(training: Training, n_seeds: int) -> Callable[[Config], Any]:
    precision = training.algorithm.config.precision
    if isinstance(training.env, Hosted):
        learn = in_precision(precision, training.learn)
        learn = _over_seeds(learn, n_seeds, n_states=3, donate=True)
        return hosted_cycle(training, learn, n_seeds)
    cycle = _over_seeds(in_precision(precision, training.cycle), n_seeds, donate=True)
    return lambda config: nullcontext(cycle)


forget_programs = _programs.cache_clear
"""Lets go of them."""


def _over_seeds(function: Any, n_seeds: int, n_states: int = 1, donate: bool = False) -> Any:
    """Compile a function of one seed's state for all seeds; a single seed is spared the vmap.

    All but the first `n_states` arguments are trip counts. They stay scalars, so that loops are not
    masked. The first argument may be donated.
    """

    def mapped(*arguments: Any) -> Any:
        states, counts = arguments[:n_states], arguments[n_states:]
        if n_seeds > 1:
            axes = (*[0] * n_states, *[None] * len(counts))
            return jax.vmap(function, in_axes=axes)(*arguments)
        one = jax.tree.map(lambda x: x[0], states)
        return jax.tree.map(lambda x: x[None], function(*one, *counts))

    return jax.jit(mapped, donate_argnums=0 if donate else ())
