"""Return regression: every algorithm solves a task that needs memory and coordination."""

import jax
import numpy as np
import pytest

from mabl.algorithms.presets import preset
from mabl.algorithms.registry import ALGORITHMS
from mabl.envs.coordination import CoordinationEnv
from mabl.evaluation import evaluate
from mabl.execution import RandomExecutor, executor_of
from mabl.training.programs import build
from mabl.training.run import updates_due

LAST_EPISODES, FIRST_EPISODES = 300, 200


@pytest.fixture
def compile_well():
    """From its call to the end of a test: here is something to compute."""
    yield lambda: jax.config.update("jax_disable_most_optimizations", False)
    jax.config.update("jax_disable_most_optimizations", True)


def learned(config, compile_well):
    """After a run: training, learner, and by cycle sums of scores and numbers of episodes."""
    training = build(config)
    cycle = jax.jit(training.cycle, donate_argnums=0)
    state = jax.jit(training.init)(jax.random.key(0))
    compile_well()
    scores, counts = [], []
    while int(state.env_steps) < config.total_steps:
        due = updates_due(jax.tree.map(lambda x: x[None], state), training)
        state, metrics = cycle(state, *due, config.total_steps)
        scores.append(float(metrics["episodes/score"]))
        counts.append(int(metrics["episodes/count"]))
    return training, state.learner, scores, counts


def alone(algo: str):
    """A test of an algorithm on a worker of its own."""
    return pytest.param(algo, marks=pytest.mark.xdist_group(f"learns-{algo}"))


@pytest.mark.parametrize("algo", [alone(algo) for algo in ALGORITHMS])
def test_it_learns_to_remember_and_to_coordinate(algo, compile_well):
    config = preset("quick", "test/coordination", algo)
    _, _, scores, counts = learned(config, compile_well)
    first, last = first_and_last(scores, counts)
    assert first < 0.3  # it is learned, not given
    assert last >= 0.8


def first_and_last(scores, counts):
    """Mean scores of a run's first and last episodes."""
    seen = np.cumsum(counts)
    chosen = seen <= FIRST_EPISODES, seen > seen[-1] - LAST_EPISODES
    return [np.sum(scores, where=these) / np.sum(counts, where=these) for these in chosen]


@pytest.mark.parametrize("algo", [alone("mabl"), alone("mappo")])
def test_it_learns_with_continuous_actions(algo, compile_well):
    training, learner, *_ = learned(preset("quick", "test/aiming", algo), compile_well)
    space = training.env.spec.action_space
    trained = executor_of(training.algorithm.policy(learner), space, greedy=True)
    played = [
        np.mean(evaluate(training.env, executor, jax.random.key(0), 128).score)
        for executor in (trained, RandomExecutor(space))
    ]
    assert played[0] >= 0.7 and played[1] < 0.4  # doing nothing: .4


def test_a_random_policy_does_not_solve_it():
    env = CoordinationEnv()
    results = evaluate(env, RandomExecutor(env.spec.action_space), jax.random.key(0), 256)
    assert np.mean(results.score) < 0.25  # 1/9 on average
