"""Return regression: MABL solves a task that needs memory and coordination."""

import equinox as eqx
import jax
import numpy as np

from mabl.algorithms.presets import preset
from mabl.envs.coordination import CoordinationEnv
from mabl.evaluation import evaluate
from mabl.execution import RandomExecutor
from mabl.training.run import build, updates_due

LAST_CYCLES = 10


def test_mabl_learns_to_remember_and_to_coordinate():
    config = preset("quick", "test/coordination", "mabl")
    training = build(config)
    state = eqx.filter_jit(training.init)(jax.random.key(0))
    cycle = jax.jit(training.cycle, donate_argnums=0)
    scores = []
    while int(state.env_steps) < config.total_steps:
        due = updates_due(jax.tree.map(lambda x: x[None], state), config)
        state, metrics = cycle(state, *due)
        scores.append(float(metrics["episodes/score"] / metrics["episodes/count"]))
    assert np.mean(scores[-LAST_CYCLES:]) >= 0.8
    assert np.mean(scores[:4]) < 0.3  # it was learned, not given


def test_a_random_policy_does_not_solve_it():
    env = CoordinationEnv()
    results = evaluate(env, RandomExecutor(env.spec.action_space), jax.random.key(0), 256)
    assert np.mean(results.score) < 0.25  # 1/9 on average
