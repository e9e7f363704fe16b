"""Algorithm 1 where environments run in Python: workers collect, one compiled program learns."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from mabl.algorithms.config import Config
from mabl.envs.host import Hosted
from mabl.envs.workers import open_pool
from mabl.execution import Memory, executor_of
from mabl.host_rollout import HostRollouts, act_where
from mabl.training.loop import Training, TrainState, cycle_keys
from mabl.types import Metrics

Cycle = Callable[..., tuple[TrainState, Metrics]]
"""`Training.cycle` for every seed; it consumes the states that it is given."""


def hosted_cycle(
    training: Training, learn: Any, n_seeds: int
) -> Callable[[Config], AbstractContextManager[Cycle]]:
    """`Training.cycle` with environments of a pool, which is opened as the run's config says.

    `learn` is `Training.learn` for all seeds at once; they share the pool.
    """
    env, plan = training.env, training.algorithm.config.training
    assert isinstance(env, Hosted)
    n_envs = n_seeds * plan.num_envs
    policies = jax.jit(jax.vmap(training.algorithm.policy))

    @jax.jit
    @jax.vmap
    def keys_of(key: Any) -> Any:
        return jax.random.split(cycle_keys(key).collect, plan.num_envs)

    @jax.jit
    @jax.vmap
    def act(policy: Any, *of_envs: Any) -> tuple[Memory, Array]:
        return jax.vmap(partial(act_where, executor_of(policy, env.spec.action_space)))(*of_envs)

    def flat(tree: Any) -> Any:
        return jax.tree.map(lambda x: np.asarray(x).reshape(n_envs, *x.shape[2:]), tree)

    def by_seed(tree: Any) -> Any:
        shape = n_seeds, plan.num_envs
        return jax.tree.map(lambda x: np.reshape(x, (*shape, *x.shape[1:])), tree)

    def cycle(
        rollouts: HostRollouts,
        states: TrainState,
        n_model: int,
        n_policy: int,
        total_steps: int = 0,
    ) -> tuple[TrainState, Metrics]:
        policy, keys = policies(states.learner), keys_of(states.key)

        def act_flat(memory: Memory, *of_envs: Any) -> tuple[Memory, Any]:
            row, count, go = by_seed(of_envs)
            memory, action = act(policy, memory, row, keys, count, go)
            return memory, flat(action)

        collectors, memory = states.collectors, states.collectors.memory
        landed = rollouts.collect(
            act_flat, flat(collectors._replace(memory=None))._replace(memory=memory)
        )
        rows = landed.rollout.rows
        rows = rows._replace(reward=rows.reward * np.float32(plan.reward_scale))
        before, after, rollout = by_seed(
            (
                landed.before._replace(memory=None),
                landed.after._replace(memory=None),
                landed.rollout._replace(rows=rows),
            )
        )
        return learn(
            states._replace(collectors=before._replace(memory=memory)),
            after._replace(memory=landed.after.memory),
            rollout,
            n_model,
            n_policy,
            total_steps,
        )

    @contextmanager
    def open_cycle(config: Config) -> Iterator[Cycle]:
        pool = open_pool(env, n_envs, config.num_workers, config.worker_timeout, config.workers)
        try:
            rollouts = HostRollouts(pool, env.spec, *training.rows_wanted)
            yield partial(cycle, rollouts)
        finally:
            pool.close()

    return open_cycle
