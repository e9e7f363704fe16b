"""The columns of `mabl algos` (the paper's table 6), derived from what algorithms do."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from tests.tiny import tiny

from mabl.algorithms import model_free
from mabl.algorithms.base import Algorithm
from mabl.algorithms.recurrent_qmix import RecurrentQMIX
from mabl.algorithms.registry import ALGORITHMS, COLUMNS
from mabl.envs.base import Discrete, EnvSpec
from mabl.execution import executor_of
from mabl.nets.mlp import dense
from mabl.rows import TimeStep
from mabl.world_models.sequences import observe_sequence

AGENTS, OBS, STEPS = 3, 5, 4
SPEC = EnvSpec("stub", AGENTS, OBS, AGENTS * OBS, Discrete(4), 10, "score")

EVERY = pytest.mark.parametrize("algo", ALGORITHMS)


def build(algo: str) -> tuple[Algorithm, Any]:
    """An algorithm and a fresh learner."""
    algorithm = ALGORITHMS[algo].build(SPEC, tiny(algo))
    return algorithm, algorithm.init(jax.random.key(0))


def some_rows(seed: int = 0) -> TimeStep:
    """Random rows `[STEPS, ...]` of one episode; the state is all observations."""
    rng = np.random.default_rng(seed)
    return with_obs(
        TimeStep(
            prev_action=jnp.asarray(rng.integers(0, 4, (STEPS, AGENTS)), jnp.int32).at[0].set(0),
            reward=jnp.asarray(rng.normal(size=(STEPS, AGENTS)), jnp.float32),
            terminated=jnp.zeros((STEPS, AGENTS), bool),
            truncated=jnp.zeros(STEPS, bool),
            obs=jnp.zeros((STEPS, AGENTS, OBS)),
            state=jnp.zeros((STEPS, AGENTS * OBS)),
            available=jnp.ones((STEPS, AGENTS, 4), bool),
            alive=jnp.ones((STEPS, AGENTS), bool),
            is_first=jnp.arange(STEPS) == 0,
            score=jnp.full(STEPS, jnp.nan),
        ),
        jnp.asarray(rng.normal(size=(STEPS, AGENTS, OBS)), jnp.float32),
    )


def with_obs(rows: TimeStep, obs: jax.Array) -> TimeStep:
    return rows._replace(obs=obs, state=obs.reshape(STEPS, AGENTS * OBS))


def other_teammates(rows: TimeStep) -> TimeStep:
    """The same to agent 0, another world to its teammates, at every row."""
    return with_obs(rows, rows.obs.at[:, 1:].add(9.0))._replace(
        available=rows.available.at[:, 1:, 0].set(False),
        alive=rows.alive.at[2:, 1].set(False),
        reward=rows.reward.at[:, 1:].add(1.0),
    )


def play(algo: str, rows: TimeStep) -> tuple[jax.Array, jax.Array]:
    """What each agent's policy saw `[STEPS, N, F]`, and the actions it took."""
    algorithm, learner = build(algo)
    policy = algorithm.policy(learner)
    # Opinionated: fresh actors and latents hardly depend on what they see.
    policy = jax.tree.map(lambda x: 5 * x if x.ndim else jnp.zeros(()), policy)
    executor = executor_of(policy, SPEC.action_space)

    def step(carry, at):
        memory, action = carry
        row, key = at
        memory, action = executor.act(memory, row._replace(prev_action=action), key)
        features = policy.filter.features
        if ALGORITHMS[algo].decentralised:
            features = jax.vmap(features)
        return (memory, action), (dense(features(memory)), action)

    first = jax.tree.map(lambda x: x[0], rows)
    carry = (executor.initial(first), first.prev_action)
    keys = jax.random.split(jax.random.key(1), STEPS)
    return jax.lax.scan(step, carry, (rows, keys))[1]


def learned_from(algo: str, rows: TimeStep) -> jax.Array:
    """Input of training for each agent's rows `[STEPS, N, G]`: its critic's input, or Q_tot."""
    algorithm, learner = build(algo)
    if isinstance(algorithm, model_free.ModelFree):
        return model_free.critic_features(rows)
    if isinstance(algorithm, RecurrentQMIX):  # what all its agents' losses share
        total = learner.online.greedy(rows)
        return jnp.broadcast_to(total[:, None, None], (STEPS, AGENTS, 1))
    model = getattr(learner, "base", learner).model
    latents, _ = observe_sequence(model, rows, jax.random.key(2))
    return dense(jax.vmap(model.critic_features)(latents))


def acts_decentralised(algo: str) -> bool:
    seen, actions = eqx.filter_jit(play)(algo, some_rows())
    others_seen, others_actions = eqx.filter_jit(play)(algo, other_teammates(some_rows()))
    assert (seen[:, 1:] != others_seen[:, 1:]).any((1, 2)).all()  # the change did arrive
    assert (actions[:, 1:] != others_actions[:, 1:]).any()
    alone = np.array_equal(seen[:, 0], others_seen[:, 0])
    assert np.array_equal(actions[:, 0], others_actions[:, 0]) or not alone
    return alone


def learns_from_team(algo: str) -> bool:
    before, after = (learned_from(algo, x) for x in (some_rows(), other_teammates(some_rows())))
    return bool((before[:, 0] != after[:, 0]).any())


def learns_from_state(algo: str) -> bool:
    rows = some_rows()
    gradient = jax.grad(lambda state: (learned_from(algo, rows._replace(state=state)) ** 2).sum())
    return bool((gradient(rows.state) != 0).any())


def shares_parameters(algo: str) -> bool:
    algorithm, learner = build(algo)
    model = getattr(getattr(learner, "base", learner), "model", algorithm.policy(learner))
    own = {leaf.shape[0] == AGENTS for leaf in jax.tree.leaves(model) if leaf.ndim}
    assert len(own) == 1, "some parameters are shared, some are not"
    return not own.pop()


DERIVED = {
    "sees_team": learns_from_team,
    "sees_state": learns_from_state,
    "decentralised": acts_decentralised,
    "shared": shares_parameters,
}


@EVERY
@pytest.mark.parametrize("column", [column.field for column in COLUMNS])
def test_what_the_table_says_is_what_the_algorithm_does(algo, column):
    assert DERIVED[column](algo) == getattr(ALGORITHMS[algo], column)


@EVERY
def test_agents_that_act_alone_first_differ_from_the_team_when_teammates_can_be_heard(algo):
    """The positive control: centralised ones hear of a teammate one step later, and not before."""
    rows = some_rows()
    later = with_obs(rows, rows.obs.at[1, 1:].multiply(-3.0))
    seen, heard = play(algo, rows)[0], play(algo, later)[0]
    assert_array_equal(seen[:2, 0], heard[:2, 0])
    assert (seen[2:, 0] != heard[2:, 0]).any() != ALGORITHMS[algo].decentralised


def test_the_papers_own_rows_are_as_it_prints_them():
    table = {
        "mabl": (True, True, True, True),
        "dreamer-v2": (False, False, True, True),
        "mamba": (True, False, False, True),
        "mag": (True, False, False, False),
    }
    for algo, row in table.items():
        assert tuple(getattr(ALGORITHMS[algo], column.field) for column in COLUMNS) == row
