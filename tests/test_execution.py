"""What an agent's actions depend on in execution: its own past, and nothing else."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mabl.behaviour.actor import Actor, MaskedCategorical
from mabl.envs.base import Continuous, Discrete, EnvSpec
from mabl.execution import (
    JointExecutor,
    LocalExecutor,
    Policy,
    RandomExecutor,
    act_alone,
    executor_of,
)
from mabl.nets.categorical import CodeShape
from mabl.rows import TimeStep
from mabl.world_models.base import WorldModelConfig
from mabl.world_models.levels import AgentFilter, Level

SPACE = Discrete(4)
LATENT = CodeShape(3, 4)
N_AGENTS, OBS, STEPS = 3, 5, 4


def build(greedy: bool = False, out_scale: float = 3.0) -> LocalExecutor:
    """Three categoricals of four classes, h of 16."""
    key_filter, key_actor = jax.random.split(jax.random.key(0))
    spec = EnvSpec("stub", N_AGENTS, OBS, 6, SPACE, STEPS, "score")
    config = WorldModelConfig(hidden=16, n_categoricals=3, n_classes=4)
    agent = AgentFilter(spec, config, key_filter)
    actor = Actor((LATENT, 16), 4, 16, 1, out_scale, key_actor)
    return executor_of(Policy(agent, actor), SPACE, greedy)


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
def play(executor: LocalExecutor | JointExecutor, rows: TimeStep) -> tuple[Level, jax.Array]:
    """Memories and actions `[STEPS, N, ...]`; each action is the next row's `prev_action`."""
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
    assert_array_equal(latents.z.index[:, agent], changed_latents.z.index[:, agent])
    # The teammates, meanwhile, live in another world: the change did arrive.
    for other in set(range(N_AGENTS)) - {agent}:
        assert (latents.h[:, other] != changed_latents.h[:, other]).any()
    assert (actions != changed_actions).any()


def test_an_agent_does_depend_on_its_own_observation():
    executor, rows = build(), some_rows()
    latents, _ = play(executor, rows)
    changed, _ = play(executor, rows._replace(obs=rows.obs.at[0, 0].add(9.0)))
    assert (latents.z.index[0, 0] != changed.z.index[0, 0]).any()
    assert (latents.h[1, 0] != changed.h[1, 0]).any()  # remembered one step later
    assert_array_equal(latents.z.index[:, 1:], changed.z.index[:, 1:])


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
            jax.tree.map(lambda x, i=i: x[i], memory),
            row.prev_action[i],
            row.obs[i],
            row.available[i],
            row.is_first,
            own_key,
            False,
        )
        assert action == actions[i]
        assert_array_equal(level.z.index, team.z.index[i])
        assert_allclose(level.h, team.h[i], rtol=1e-5, atol=1e-6)


def test_agents_in_equal_positions_draw_their_own_samples():
    executor = build()
    row = jax.tree.map(lambda x: x[0], some_rows())
    row = row._replace(obs=jnp.broadcast_to(row.obs[:1], row.obs.shape))
    keys = jax.random.split(jax.random.key(0), 50)
    memory, _ = jax.vmap(lambda key: executor.act(executor.initial(row), row, key))(keys)
    assert (memory.z.index[:, 0] != memory.z.index[:, 1]).any()


@eqx.filter_jit
def decide(executor, row, keys):
    """Joint actions `[K, N]` at one row, and the probabilities that the actor gave them."""

    def one(key):
        level, action = executor.act(executor.initial(row), row, key)
        features = jax.vmap(executor.policy.filter.features)(level)
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
    assert_array_equal(level.z.onehot(), np.zeros((N_AGENTS, 12)))


# --- centralised execution --------------------------------------------------------------------


class Gossip(eqx.Module):
    """A joint filter that remembers one number of each agent.

    It is half of what it was, plus the sum of the first features of all the living, plus the index
    of the agent's own last action, plus noise of the given size.
    """

    noise: float = 0.0
    n_agents: int = eqx.field(static=True, default=N_AGENTS)
    obs_dim: int = eqx.field(static=True, default=OBS)

    def initial(self):
        return jnp.zeros(self.n_agents)

    def joint(self, memory, prev_action, obs, alive, key):
        heard = (obs[:, 0] * alive).sum()
        played = (prev_action * jnp.arange(4.0)[None]).sum(-1)
        noise = jax.random.normal(key, memory.shape)
        return 0.5 * memory + heard + played + self.noise * noise

    def features(self, memory):
        return memory[:, None]


def tell(features, available):
    """An actor that prefers action 1 to 0 by as much as its feature says, and no other to these."""
    return MaskedCategorical.of(jnp.array([0.0, features[0], -99.0, -99.0]), available)


def together(greedy: bool = True, noise: float = 0.0) -> JointExecutor:
    return executor_of(Policy(Gossip(noise), tell), SPACE, greedy)


def test_the_filter_decides_whether_agents_can_act_alone():
    assert isinstance(build(), LocalExecutor)
    assert isinstance(together(), JointExecutor)
    assert build(greedy=True).greedy and together(greedy=True).greedy
    assert not executor_of(Policy(Gossip(), tell), SPACE).greedy


def test_a_team_remembers_together_by_hand():
    rows = some_rows()
    said = jnp.array([[1.0, 2.0, 4.0], [-8.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    obs = jnp.zeros((STEPS, N_AGENTS, OBS)).at[:, :, 0].set(said)
    alive = jnp.array([[True] * 3, [True, True, False], [False, True, True], [True] * 3])
    # Agent 2 may not play 1, nor anybody anything but 0 in the last row.
    available = rows.available.at[:, 2, 1].set(False).at[3, :, 1].set(False)
    is_first = jnp.arange(STEPS) % 3 == 0  # row 3 is a reset
    rows = rows._replace(obs=obs, alive=alive, available=available, is_first=is_first)
    memory, actions = play(together(), rows)
    # Row 0: 1 + 2 + 4 = 7 for all, so that action 1 is likeliest, where available.
    # Row 1: 7 / 2 - 8 = -4.5 (agent 2 is dead), and 1 more for those that played 1: action 0.
    # Row 2: -3.5 / 2 + 2 = 0.25 (agent 0 is dead), -4.5 / 2 + 2 = -0.25 for agent 2, all having
    # played 0: action 1 for agents 0 and 1, 0 for agent 2.
    # Row 3: a reset, nothing to hear: zeros, although agents 0 and 1 had played 1.
    assert_allclose(memory, [[7] * 3, [-3.5, -3.5, -4.5], [0.25, 0.25, -0.25], [0] * 3])
    assert_array_equal(actions, [[1, 1, 0], [0, 0, 0], [1, 1, 0], [0, 0, 0]])
    assert actions.dtype == jnp.int32


def test_a_team_starts_from_its_filters_memory():
    row = jax.tree.map(lambda x: x[0], some_rows())
    assert_array_equal(together().initial(row), np.zeros(N_AGENTS))


def test_a_team_draws_its_latents_and_each_agent_its_own_action():
    row = jax.tree.map(lambda x: x[1], some_rows())._replace(obs=jnp.zeros((N_AGENTS, OBS)))
    keys = jax.random.split(jax.random.key(0), 4000)

    def act(executor):
        return jax.jit(jax.vmap(lambda key: executor.act(executor.initial(row), row, key)))(keys)

    # Every feature is 0: a fair coin between 0 and 1, tossed by each agent for itself.
    row = row._replace(available=row.available.at[:, 2:].set(False))
    memory, actions = act(together(greedy=False))
    assert not memory.any()
    assert_allclose(actions.mean(0), [0.5] * 3, atol=0.04)  # five standard errors
    assert_allclose((actions[:, 0] == actions[:, 1]).mean(), 0.5, atol=0.04)
    # With noise the key draws a latent, too: greedily, action 1 where it is positive.
    memory, actions = act(together(noise=1.0))
    assert_array_equal(actions, memory > 0)
    assert_allclose(memory.std(), 1.0, atol=0.04)
