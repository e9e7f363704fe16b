"""A run's compiled programs, traced once for all runs of a process that compute the same."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import jax

from mabl.algorithms import registry as algorithms
from mabl.algorithms.config import Config
from mabl.envs import registry as envs
from mabl.training.loop import Training, TrainState
from mabl.types import Metrics

DIAGNOSE = 2**31 - 1
"""Sets the diagnostics' random key apart from those that training splits off."""


class Programs(NamedTuple):
    """What is computed for all seeds of a run at once; states have a leading axis of seeds."""

    training: Training
    init: Any
    """First states from keys `[S]`."""
    cycle: Callable[[TrainState, int, int], tuple[TrainState, Metrics]]
    """`Training.cycle`; it consumes the states that it is given."""
    diagnose: Callable[[TrainState], Metrics]


def build(config: Config) -> Training:
    """The algorithm of a config in its environment."""
    env = envs.make(config.env)
    return Training(env, algorithms.make(config, env.spec))


def programs(config: Config) -> Programs:
    """The programs of a run. Runs that differ in seed, length or folder alone share them.

    No program may depend on these: in `training.algorithm.config` they are not the run's.
    """
    plain = Config()
    unread = {name: getattr(plain, name) for name in algorithms.unread(config.algo)}
    same = replace(config, preset="quick", seed=0, total_steps=1, logdir="", **unread)
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
        cycle=_over_seeds(training.cycle, config.num_seeds, donate=True),
        diagnose=_over_seeds(diagnose, config.num_seeds),
    )


forget_programs = _programs.cache_clear
"""Lets go of them."""


def _over_seeds(function: Any, n_seeds: int, donate: bool = False) -> Any:
    """Compile a function of one seed's state for all seeds; a single seed is spared the vmap.

    The batched trip counts stay scalars, so that loops are not masked.
    """

    def mapped(states: TrainState, *counts: Any) -> Any:
        if n_seeds > 1:
            axes = (0, *[None] * len(counts))
            return jax.vmap(function, in_axes=axes)(states, *counts)
        one = jax.tree.map(lambda x: x[0], states)
        return jax.tree.map(lambda x: x[None], function(one, *counts))

    return jax.jit(mapped, donate_argnums=0 if donate else ())
