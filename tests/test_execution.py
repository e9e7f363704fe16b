"""What an agent's actions depend on in execution: its own past, and nothing else."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mabl.behaviour.actor import Actor
from mabl.envs.base import Continuous, Discrete
from mabl.execution import LocalExecutor, LocalPolicy, RandomExecutor, act_alone
from mabl.types import TimeStep
from mabl.world_models.levels import AgentFilter, Level

SPACE = Discrete(4)
N_AGENTS, OBS, STEPS = 3, 5, 4


def build(greedy: bool = False, out_scale: float = 3.0) -> LocalExecutor:
    """Three categoricals of four classes, h of 16."""
    key_filter, key_actor = jax.random.split(jax.random.key(0))
    agent = AgentFilter(OBS, 4, 16, 3, 4, key_filter)
    return LocalExecutor(
        LocalPolicy(agent, Actor(12 + 16, 4, 16, 1, out_scale, key_actor)), SPACE, greedy
    )


def some_rows(seed: int = 0) -> TimeStep:
    """Random rows `[STEPS, ...]` of one episode; the actions are still to come."""
    rng = np.random.default_rng(seed)
    return TimeStep(
        prev_action=jnp.zeros((STEPS, N_AGENTS), jnp.int32),
        reward=jnp.asarray(rng.normal(size=(STEPS, N_AGENTS)), jnp.float32),
        terminated=jnp.zeros((STEPS, N_AGENTS), bool),
        truncated=jnp.zeros(STEPS, bool),
        obs=jnp.asarray(rng.normal(size=(STEPS, N_AGENTS, OBS)), jnp.float32),
        state=jnp.asarray(rng.normal(size=(STEPS, 6)), jnp.float32),
        available=jnp.ones((STEPS, N_AGENTS, 4), bool),
        alive=jnp.ones((STEPS, N_AGENTS), bool),
        is_first=jnp.arange(STEPS) == 0,
        score=jnp.full(STEPS, jnp.nan),
    )


@eqx.filter_jit
def play(executor: LocalExecutor, rows: TimeStep) -> tuple[Level, jax.Array]:
    """Latents and actions `[STEPS, N, ...]`; each action is the next row's `prev_action`."""
    first = jax.tree.map(lambda x: x[0], rows)

    def step(carry, at):
        memory, action = carry
        row, key = at
        memory, action = executor.act(memory, row._replace(prev_action=action), key)
        return (memory, action), (memory, action)

    carry = (executor.initial(first), first.prev_action)
    return jax.lax.scan(step, carry, (rows, jax.random.split(jax.random.key(1), STEPS)))[1]


def change_teammates(rows: TimeStep, agent: int) -> TimeStep:
    """Everything that is not `agent`'s own, at every step."""
    others = jnp.arange(N_AGENTS) != agent
    return rows._replace(
        obs=rows.obs + 9.0 * others[None, :, None],
        available=rows.available.at[:, :, 0].set(~others[None]),
        alive=rows.alive & ~others[None],
        reward=rows.reward + 1,
        state=rows.state + 9.0,
    )


@pytest.mark.parametrize("greedy", [False, True])
@pytest.mark.parametrize("agent", range(N_AGENTS))
def test_an_agent_depends_on_nothing_but_its_own_observations_and_actions(agent, greedy):
    executor, rows = build(greedy), some_rows()
    latents, actions = play(executor, rows)
    changed_latents, changed_actions = play(executor, change_teammates(rows, agent))
    assert_array_equal(actions[:, agent], changed_actions[:, agent])
    assert_array_equal(latents.h[:, agent], changed_latents.h[:, agent])
    assert_array_equal(latents.z[:, agent], changed_latents.z[:, agent])
    # The teammates, meanwhile, live in another world: the change did arrive.
    for other in set(range(N_AGENTS)) - {agent}:
        assert (latents.h[:, other] != changed_latents.h[:, other]).any()
    assert (actions != changed_actions).any()


def test_an_agent_does_depend_on_its_own_observation():
    executor, rows = build(), some_rows()
    latents, _ = play(executor, rows)
    changed, _ = play(executor, rows._replace(obs=rows.obs.at[0, 0].add(9.0)))
    assert (latents.z[0, 0] != changed.z[0, 0]).any()
    assert (latents.h[1, 0] != changed.h[1, 0]).any()  # remembered one step later
    assert_array_equal(latents.z[:, 1:], changed.z[:, 1:])


def test_an_agent_remembers_its_own_previous_action():
    executor = build()
    row = jax.tree.map(lambda x: x[1], some_rows())
    memory = executor.initial(row)
    levels = [
        executor.act(memory, row._replace(prev_action=jnp.full(3, a)), jax.random.key(0))[0]
        for a in (0, 1)
    ]
    assert (levels[0].h != levels[1].h).any()


def test_an_agent_alone_acts_as_it_does_in_the_team():
    executor, rows = build(), some_rows()
    row = jax.tree.map(lambda x: x[1], rows)._replace(prev_action=jnp.array([3, 0, 2]))
    memory = jax.tree.map(lambda x: x[0], play(executor, rows)[0])
    key = jax.random.key(7)
    team, actions = executor.act(memory, row, key)
    for i, own_key in enumerate(jax.random.split(key, N_AGENTS)):
        level, action = act_alone(
            executor.policy,
            SPACE,
            Level(memory.h[i], memory.z[i]),
            row.prev_action[i],
            row.obs[i],
            row.available[i],
            row.is_first,
            own_key,
            False,
        )
        assert action == actions[i]
        assert_array_equal(level.z, team.z[i])
        assert_allclose(level.h, team.h[i], rtol=1e-5, atol=1e-6)


def test_agents_in_equal_positions_draw_their_own_samples():
    executor = build()
    row = jax.tree.map(lambda x: x[0], some_rows())
    row = row._replace(obs=jnp.broadcast_to(row.obs[:1], row.obs.shape))
    keys = jax.random.split(jax.random.key(0), 50)
    memory, _ = jax.vmap(lambda key: executor.act(executor.initial(row), row, key))(keys)
    assert (memory.z[:, 0] != memory.z[:, 1]).any()


@eqx.filter_jit
def decide(executor, row, keys):
    """Joint actions `[K, N]` at one row, and the probabilities that the actor gave them."""

    def one(key):
        level, action = executor.act(executor.initial(row), row, key)
        features = jnp.concatenate([level.z, level.h], axis=-1)
        policy = jax.vmap(executor.policy.actor)(features, row.available)
        return action, jnp.exp(policy.log_probs)

    return jax.vmap(one)(keys)


def test_greedy_takes_the_likeliest_action_and_sampling_follows_the_probabilities():
    row = jax.tree.map(lambda x: x[0], some_rows())
    keys = jax.random.split(jax.random.key(2), 2000)
    actions, probs = decide(build(greedy=True), row, keys)
    assert actions.dtype == jnp.int32
    assert_array_equal(actions, probs.argmax(-1))
    actions, probs = decide(build(greedy=False), row, keys)
    assert actions.dtype == jnp.int32
    frequency = jax.nn.one_hot(actions, 4).mean(0)
    assert_allclose(frequency, probs.mean(0), atol=0.06)  # five standard errors of a fair coin
    assert (actions != probs.argmax(-1)).any()


@pytest.mark.parametrize("kind", ["sampled", "greedy", "random"])
def test_unavailable_actions_are_never_taken(kind):
    rng = np.random.default_rng(0)
    masks = rng.random((1000, N_AGENTS, 4)) < 0.4
    masks[np.arange(1000)[:, None], np.arange(3), rng.integers(0, 4, (1000, 3))] = True
    executor = RandomExecutor(SPACE) if kind == "random" else build(kind == "greedy", 30.0)
    row = jax.tree.map(lambda x: x[0], some_rows())

    def act(mask, key):
        return executor.act(executor.initial(row), row._replace(available=mask), key)[1]

    keys = jax.random.split(jax.random.key(0), 1000)
    actions = np.asarray(jax.jit(jax.vmap(act))(jnp.asarray(masks), keys))
    assert np.take_along_axis(masks, actions[..., None], -1).all()


def test_random_is_uniform_over_available_actions():
    row = jax.tree.map(lambda x: x[0], some_rows())
    available = [[True] * 4, [False, True, True, False], [False] * 3 + [True]]
    row = row._replace(available=jnp.array(available))
    executor = RandomExecutor(SPACE)
    actions = jax.vmap(lambda key: executor.act(None, row, key)[1])(
        jax.random.split(jax.random.key(0), 4000)
    )
    expected = [[0.25] * 4, [0, 0.5, 0.5, 0], [0, 0, 0, 1]]
    assert_allclose(jax.nn.one_hot(actions, 4).mean(0), expected, atol=0.04)


def test_random_continuous_actions_fill_the_box():
    row = jax.tree.map(lambda x: x[0], some_rows())
    _, actions = jax.vmap(lambda key: RandomExecutor(Continuous(2)).act(None, row, key))(
        jax.random.split(jax.random.key(0), 500)
    )
    assert actions.shape == (500, N_AGENTS, 2)
    assert -1 <= actions.min() < -0.99 and 0.99 < actions.max() <= 1


def test_a_first_row_forgets_the_past_and_ignores_the_action_before():
    executor, rows = build(), some_rows()
    first = jax.tree.map(lambda x: x[0], rows)
    memory = jax.tree.map(lambda x: x[-1], play(executor, rows)[0])
    assert np.asarray(memory.h).any()
    key = jax.random.key(5)
    fresh = executor.act(executor.initial(first), first, key)
    later = executor.act(memory, first._replace(prev_action=jnp.array([1, 2, 3])), key)
    jax.tree.map(assert_array_equal, fresh, later)
    # On any other row both matter.
    going_on, _ = executor.act(memory, first._replace(is_first=jnp.bool_(False)), key)
    assert (going_on.h != fresh[0].h).any()


def test_execution_starts_from_zeros_for_every_agent():
    level = build().initial(jax.tree.map(lambda x: x[0], some_rows()))
    assert_array_equal(level.h, np.zeros((N_AGENTS, 16)))
    assert_array_equal(level.z, np.zeros((N_AGENTS, 12)))
