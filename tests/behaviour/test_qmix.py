"""QMIX by hand: the mixer, epsilon-greedy choice, double-Q targets, and what an update moves."""

from dataclasses import replace
from functools import partial
from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from numpy.testing import assert_allclose, assert_array_equal
from tests.tiny import tiny

from mabl.algorithms.base import Experience
from mabl.algorithms.model_based import ModelBased
from mabl.behaviour.actor import MaskedCategorical
from mabl.behaviour.qmix import (
    QMIX,
    EpsilonGreedy,
    Mixer,
    QMIXConfig,
    QRows,
    QState,
    Values,
    experience,
    td_loss,
)
from mabl.envs.base import Discrete
from mabl.envs.coordination import CoordinationEnv
from mabl.nets.mlp import MLP
from mabl.training.loop import Training
from mabl.training.programs import build
from mabl.types import Replayed, TeamView, Trajectory
from mabl.world_models.dreamer_v2 import DreamerV2

# Few different configurations: each one's update is compiled anew.
TINY = QMIXConfig(
    hidden=8,
    n_hidden=1,
    mixer_hidden=4,
    hypernet_hidden=8,
    learning_rate=1e-2,
    target_rate=1.0,
    n_epochs=2,
    batch_size=9,
    epsilon_start=0.9,
    epsilon_end=0.3,
    epsilon_share=0.8,
)


KEY = jax.random.key(0)


def leaves(tree) -> list[np.ndarray]:
    return [np.asarray(x) for x in jax.tree.leaves(tree)]


# --- the mixer --------------------------------------------------------------------------------


def test_the_mixer_by_hand():
    mixer = Mixer(n_agents=2, seen=2, hidden=2, hypernet=2, key=jax.random.key(0))
    mixer = eqx.tree_at(
        lambda m: [
            m.weight_in.layers[0].weight,
            m.weight_in.layers[1].weight,
            m.bias_in.layers[0].weight,
            m.weight_out.layers[0].weight,
            m.weight_out.layers[1].weight,
            m.bias_out.layers[0].weight,
            m.bias_out.layers[1].weight,
            m.bias_out.layers[1].bias,
        ],
        mixer,
        [
            jnp.eye(2),
            jnp.array([[-1.0, 0.0, 0.0, 0.5], [0.0, 2.0, 0.0, -1.0]]),
            jnp.array([[1.0, 0.0], [0.0, -2.0]]),
            jnp.eye(2),
            jnp.array([[-2.0, 0.0], [0.0, 0.5]]),
            jnp.eye(2),
            jnp.array([[3.0], [-1.0]]),
            jnp.array([0.5]),
        ],
    )
    # Features (1, 2). First weights |(-1, 4, 0, 0.5 - 2)|: agent 0 has (1, 4), agent 1 (0, 1.5).
    # (2, -4) becomes (2, 8 - 6) and, with biases (1, -4), (3, -2); ELU: (3, e^-2 - 1 = -0.864665).
    # Last weights |(-2, 1)|, bias 3 - 2 + 0.5: 2 * 3 - 0.864665 + 1.5 = 6.635335
    assert_allclose(mixer(jnp.array([2.0, -4.0]), jnp.array([[1.0], [2.0]])), 6.635335, rtol=1e-5)


@pytest.fixture(scope="module")
def points():
    """A mixer, and many random values of three agents with features of a team."""
    mixer = eqx.filter_jit(lambda key: Mixer(3, 6, 4, 8, key))(jax.random.key(0))
    rng = np.random.default_rng(0)
    q, features = rng.normal(size=(500, 3)), 2 * rng.normal(size=(500, 3, 2))
    return mixer, np.float32(q), np.float32(features)


def test_the_mixer_never_falls_when_any_agents_value_rises(points):
    mixer, q, features = points
    slope_of = jax.jit(lambda mixer: jax.vmap(jax.grad(mixer))(q, features))
    rng = np.random.default_rng(1)
    # Weights that no initialisation gives count as well.
    wild = jax.tree.map(lambda x: np.float32(3 * rng.normal(size=x.shape)), mixer)
    for chosen, listens in ((mixer, 0.99), (wild, 0.5)):  # ELU dies out far below zero
        slope = np.asarray(slope_of(chosen))
        assert (slope >= 0).all()
        assert (slope > 0).mean() > listens


def test_the_global_features_weigh_agents_against_each_other_but_never_an_agents_own_actions(
    points,
):
    mixer, q, features = points
    every = jax.jit(jax.vmap(mixer))

    def team(*values: float) -> np.ndarray:
        """What these values are worth in every state."""
        return np.asarray(every(np.float32([values] * 500), features))

    # With the same values, states are worth more or less ...
    assert np.ptp(team(0, 0, 0)) > 0.1
    # ... and whether it is better that agent 0 or that agent 1 has its way depends on the state.
    assert 0.02 < (team(1, 0, 0) > team(0, 1, 0)).mean() < 0.98
    # But agent 0's values 0, 0.5, 1, 1.5 are in this order everywhere, whatever the others' are.
    own = [np.concatenate([np.full((500, 1), v, "f"), q[:, 1:]], 1) for v in (0, 0.5, 1, 1.5)]
    steps = np.diff([np.asarray(every(values, features)) for values in own], axis=0)
    assert (steps >= 0).all() and (steps > 0).mean() > 0.99


# --- the policy -------------------------------------------------------------------------------


def constant(*q: float) -> MLP:
    """A network that gives these values whatever it sees."""
    net = MLP(2, len(q), 4, 1, jax.random.key(0))
    return eqx.tree_at(
        lambda n: [n.layers[-1].weight, n.layers[-1].bias],
        net,
        [jnp.zeros((4, len(q))), jnp.array(q)],
    )


@partial(jax.jit, static_argnums=0)
def policy_of(q: tuple[float, ...], epsilon: float, available: Array) -> MaskedCategorical:
    """Epsilon-greedy with these values."""
    return EpsilonGreedy(constant(*q), jnp.float32(epsilon))(jnp.zeros(2), available)


@pytest.mark.parametrize(
    ("available", "epsilon", "probabilities"),
    [
        # Value 3 is the best: 1 - 0.3, and everybody's third of 0.3
        ([True, True, True], 0.3, [0.1, 0.8, 0.1]),
        # Without it 2 is: 0.7 and half of 0.3
        ([True, False, True], 0.3, [0.15, 0, 0.85]),
        ([True, False, False], 0.3, [1, 0, 0]),
        # Where nothing is available, everything is.
        ([False, False, False], 0.3, [0.1, 0.8, 0.1]),
        ([True, False, True], 0.0, [0, 0, 1]),
        # Never quite 1, so that the best stays the likeliest: 0.001 and half of 0.999
        ([True, False, True], 1.0, [0.4995, 0, 0.5005]),
    ],
)
def test_epsilon_greedy_by_hand(available, epsilon, probabilities):
    policy = jax.device_get(policy_of((1.0, 3.0, 2.0), epsilon, np.array(available)))
    assert_allclose(np.exp(policy.log_probs), probabilities, rtol=1e-5, atol=1e-7)
    assert np.isfinite(policy.log_probs).all()
    if any(available):  # what is not available is impossible, not just unlikely
        assert (np.exp(policy.log_probs)[~np.array(available)] == 0).all()


@pytest.mark.parametrize("epsilon", [0.0, 0.05, 0.9, 1.0])
def test_the_mode_of_the_policy_is_greedy(epsilon):
    for available, best in (("1111", 2), ("1101", 3), ("1100", 0), ("0100", 1), ("0000", 2)):
        may = np.array([x == "1" for x in available])
        assert policy_of((-5.0, -9.0, -1.0, -2.0), epsilon, may).mode() == best


# --- experience -------------------------------------------------------------------------------


class Table(NamedTuple):
    """Values looked up by the first feature."""

    rows: Array

    def __call__(self, features: Array) -> Array:
        return self.rows[features[0].astype(int)]


def one_and_two(q: Array, features: Array) -> Array:
    """A mixer: agent 1 counts twice, and the features are added."""
    return q[0] + 2 * q[1] + features.sum()


NOTHING = [0.0, 0.0, 0.0]
ONLINE = Values(
    # Rows 0, 1 and 2 of agents 0 and 1
    Table(
        jnp.array(
            [NOTHING, NOTHING, [1.0, 5.0, 9.0], [4.0, 2.0, 3.0], [1.0, 7.0, 2.0], [0.0, 0.0, 6.0]]
        )
    ),
    one_and_two,
)
TARGET = Values(
    Table(
        jnp.array(
            [NOTHING, NOTHING, [10.0, 20, 30], [1.0, 2.0, 3.0], [8.0, 4.0, 16.0], [5.0, 6.0, 7.0]]
        )
    ),
    one_and_two,
)
STATE = QState(ONLINE, TARGET, (), jnp.float32(0.5))


def by_hand(trajectory: Trajectory, td_lambda: float) -> tuple[QRows, dict[str, Array]]:
    """Rows and metrics of these networks with a discount of 0.8."""
    config = replace(TINY, gamma=0.8, td_lambda=td_lambda)
    return jax.device_get(jax.jit(lambda x: experience(STATE, x, config))(trajectory))


def two_steps() -> Trajectory:
    """Three rows, two transitions, one start, two agents; actor features tell row and agent."""
    number = np.arange(6, dtype=np.float32).reshape(3, 1, 2, 1)
    available = np.ones((3, 1, 2, 3), bool)
    available[1, 0, 0, 2] = available[2, 0, 0] = False
    return Trajectory(
        TeamView(
            number,
            number // 2 / 2,  # summed over the team: the row
            available,
            np.ones((3, 1, 2), bool),
        ),
        action=np.array([[[0, 1]], [[2, 1]]]),
        log_prob=np.zeros((2, 1, 2), np.float32),
        reward=np.array([[[1, 3]], [[0, 4]]], np.float32),
        continues=np.array([[[0.5, 1]], [[0.5, 0.5]]], np.float32),
        weight=np.array([[[1, 1]], [[0.5, 1]]], np.float32),
    )


@pytest.mark.parametrize(
    ("td_lambda", "targets"),
    # Row 1: agent 0 would pick 2, which is not available, so 1 (value 5); agent 1 picks 0 (4). The
    # target networks value this 20 + 2 * 1 and 1 for the row: 23. (They themselves would pick
    # actions worth 20 + 2 * 3.)
    # Row 2: nothing is available to agent 0, so everything is: 1 (7); agent 1 picks 2. Valued
    # 4 + 2 * 7 + 2 = 20.
    # Team rewards (1 + 3) / 2 = 2 and (0 + 4) / 2 = 2, discounts 0.8 * 0.75 = 0.6 and 0.8 * 0.5.
    # The last target is 2 + 0.4 * 20 = 10 whatever lambda is; the first is
    # 0: 2 + 0.6 * 23 = 15.8, 1: 2 + 0.6 * 10 = 8, 1/2: 2 + 0.6 (0.5 * 23 + 0.5 * 10) = 11.9.
    [(0.0, [15.8, 10]), (1.0, [8, 10]), (0.5, [11.9, 10])],
)
def test_double_q_targets_by_hand(td_lambda, targets):
    rows, metrics = by_hand(two_steps(), td_lambda)
    assert_allclose(rows.target, targets, rtol=1e-6)
    assert_allclose(rows.weight, [1, 0.75])
    assert_array_equal(rows.action, [[0, 1], [2, 1]])
    assert_array_equal(rows.view.actor_features[..., 0], [[0, 1], [2, 3]])
    assert_array_equal(rows.view.available[1], [[True, True, False], [True, True, True]])
    assert_allclose(metrics["behaviour/imagined_reward"], 2.0, rtol=1e-6)
    assert_allclose(metrics["behaviour/imagined_return"], targets[0], rtol=1e-6)


@pytest.mark.parametrize("td_lambda", [0.0, 0.5, 1.0])
def test_an_episodes_end_cuts_what_comes_after(td_lambda):
    trajectory = two_steps()
    trajectory.continues[0] = 0.0
    rows, _ = by_hand(trajectory, td_lambda)
    assert_allclose(rows.target, [2, 10], rtol=1e-6)


def test_several_starts_are_flattened_row_by_row():
    trajectory = jax.tree.map(lambda x: np.concatenate([x, x], axis=1), two_steps())
    trajectory.reward[:, 1] += 100.0
    rows, _ = by_hand(trajectory, 0.0)
    # As above; the second start is paid 100 more each time
    assert_allclose(rows.target, [15.8, 115.8, 10, 110], rtol=1e-6)
    assert_array_equal(rows.action, [[0, 1], [0, 1], [2, 1], [2, 1]])


def test_targets_are_no_function_of_the_learned_networks_that_a_gradient_could_follow():
    @jax.jit
    @jax.grad
    def slope(online: Array, trajectory: Trajectory) -> Array:
        state = STATE._replace(values=ONLINE._replace(q=Table(online)))
        return experience(state, trajectory, replace(TINY, td_lambda=0.5))[0].target.sum()

    assert (slope(ONLINE.q.rows, two_steps()) == 0).all()


def test_the_loss_by_hand():
    view = jax.tree.map(lambda x: x[1:, 0], two_steps().view)
    loss_of = jax.jit(lambda rows: td_loss(ONLINE, rows))
    rows = QRows(view, np.array([[0, 2], [1, 1]]), np.array([5.0, 6.0]), np.array([1.0, 0.5]))
    # Of row 1: 1 + 2 * 3 + 1 = 8, off by 3; of row 2: 1 + 2 * 0 + 2 = 3, off by -3.
    # 0.5 (1 * 9 + 0.5 * 9) / 1.5 = 4.5
    loss, metrics = loss_of(rows)
    assert_allclose(loss, 4.5, rtol=1e-6)
    assert metrics["behaviour/critic_loss"] == loss
    # Weights of 1 and 0 leave the first, 4 off its target now: 0.5 * 16
    rows = rows._replace(target=np.array([4.0, 1e6]), weight=np.array([1.0, 0.0]))
    assert_allclose(loss_of(rows)[0], 8.0, rtol=1e-6)


# --- updates ----------------------------------------------------------------------------------


class Game(NamedTuple):
    """A bandit: action 2 pays each agent 1, episodes end at once.

    All nine joint actions of two agents are tried in each of four random states.
    """

    qmix: QMIX
    state: QState
    trajectory: Trajectory


@pytest.fixture(scope="module")
def bandit() -> Game:
    rng = np.random.default_rng(0)
    actor, critic = (np.float32(rng.normal(size=(2, 4, 2, n))).repeat(9, axis=1) for n in (4, 3))
    view = TeamView(actor, critic, np.ones((2, 36, 2, 3), bool), np.ones((2, 36, 2), bool))
    action = np.int32([list(product(range(3), repeat=2)) * 4])
    trajectory = Trajectory(
        view,
        action,
        log_prob=np.zeros((1, 36, 2), np.float32),
        reward=np.float32(action == 2),
        continues=np.zeros((1, 36, 2), np.float32),
        weight=np.ones((1, 36, 2), np.float32),
    )
    qmix = QMIX(TINY)
    first = jax.tree.map(lambda x: x[0, 0], view)
    return Game(qmix, jax.jit(qmix.init, static_argnums=1)(first, Discrete(3), KEY), trajectory)


@pytest.fixture(scope="module")
def update():
    """`QMIX.update`, compiled once for each configuration."""

    @eqx.filter_jit
    def run(
        qmix: QMIX, state: QState, trajectory: Trajectory, key: Array = KEY, progress: float = 0.0
    ):
        replayed = Replayed(trajectory.view, CoordinationEnv().reset(jax.random.key(0))[1])
        return qmix.update(state, trajectory, replayed, key, progress)

    return run


def test_it_starts_with_target_networks_that_are_copies(bandit):
    for value, target in zip(leaves(bandit.state.values), leaves(bandit.state.target), strict=True):
        assert_array_equal(value, target)
    assert_allclose(bandit.state.epsilon, 0.9)


def test_updates_prefer_the_action_that_pays(bandit, update):
    qmix, state, trajectory = bandit
    view = jax.tree.map(lambda x: x[0], trajectory.view)

    @jax.jit
    def values_of(state: QState) -> tuple[Array, Array]:
        """Of all actions `[B, N, A]`, and Q_tot of those taken `[B]`."""
        values = state.values
        return jax.vmap(values.agents)(view), jax.vmap(values.chosen)(view, trajectory.action[0])

    def lead(state: QState) -> np.ndarray:
        """By how much the paid action is above the better of the others, `[B, N]`."""
        q = np.asarray(values_of(state)[0])
        return q[..., 2] - q[..., :2].max(-1)

    before = lead(state)
    for seed in range(60):
        state, metrics = update(qmix, state, trajectory, jax.random.key(seed))
    after = lead(state)
    assert (after > 0).all() and not (before > 0).all()
    # Q_tot has come near to what the joint action earns: 0, 1/2 or 1.
    earned = trajectory.reward[0].mean(-1)
    total = np.asarray(values_of(state)[1])
    assert np.mean((total - earned) ** 2) < 0.02 < np.var(earned)
    assert_allclose(metrics["behaviour/imagined_reward"], trajectory.reward.mean(), rtol=1e-5)


def test_target_networks_move_by_their_rate(bandit, update):
    _, state, trajectory = bandit
    # One epoch of one minibatch
    qmix = QMIX(replace(TINY, n_epochs=1, batch_size=36, target_rate=0.25))
    after, _ = update(qmix, state, trajectory)
    moved = zip(leaves(state.target), leaves(after.values), leaves(after.target), strict=True)
    for old, new, target in moved:
        assert not np.array_equal(old, new)
        assert_allclose(target, 0.75 * old + 0.25 * new, rtol=1e-5, atol=1e-7)


def test_target_networks_follow_every_minibatch(bandit, update):
    # 36 rows in minibatches of 9 in each of 2 epochs: with rate 1 they are the learned networks.
    after, _ = update(bandit.qmix, bandit.state, bandit.trajectory)
    for value, target in zip(leaves(after.values), leaves(after.target), strict=True):
        assert_allclose(target, value, rtol=1e-5, atol=1e-7)


def test_epsilon_falls_linearly_over_its_share_of_the_run_and_stops_at_its_end(bandit, update):
    qmix, state, trajectory = bandit
    # From 0.9 to 0.3 over the first 0.8 of the run, however many updates that takes
    seen = []
    for progress in (0.0, 0.2, 0.4, 0.8, 1.0, 1.5):
        state, metrics = update(qmix, state, trajectory, progress=progress)
        assert metrics["behaviour/epsilon"] == state.epsilon == qmix.actor(state).epsilon
        seen.append(float(state.epsilon))
    assert_allclose(seen, [0.9, 0.75, 0.6, 0.3, 0.3, 0.3], rtol=1e-5)


def test_gradients_reach_every_parameter_of_the_agents_values_and_of_the_mixer(bandit):
    _, state, trajectory = bandit

    @jax.jit
    def slope(state: QState, trajectory: Trajectory) -> Values:
        rows, _ = experience(state, trajectory, TINY)
        return eqx.filter_grad(td_loss, has_aux=True)(state.values, rows)[0]

    gradient = slope(state, trajectory)
    for leaf in leaves(gradient):
        assert np.abs(leaf).max() > 0


def test_the_value_is_that_of_the_best_of_all_available_joint_actions(bandit):
    qmix, state, trajectory = bandit
    view = jax.tree.map(lambda x: x[0, 0], trajectory.view)
    chosen, value = jax.jit(state.values.chosen), jax.jit(lambda view: qmix.value(state, view))
    for available in ([[True] * 3] * 2, [[True, False, True], [False, True, False]]):
        view = view._replace(available=np.array(available))
        joint = [
            float(chosen(view, np.int32(action)))
            for action in product(range(3), repeat=2)
            if all(view.available[i, a] for i, a in enumerate(action))
        ]
        assert len(set(joint)) == len(joint)
        assert_allclose(value(view), [max(joint)] * 2, rtol=1e-5)


# --- with a world model -----------------------------------------------------------------------


def test_learning_in_imagination_leaves_the_world_model_alone():
    config = tiny("mabl-qmix")
    model = replace(config.world_model, policy_input="latent")
    training: Training = build(replace(config, world_model=model))
    state = jax.jit(training.init)(jax.random.key(0))

    @jax.jit
    def learn(state, key):
        collectors, collected = training.collect(state.learner, state.collectors, key)
        replay = training.store(state.replay, collected)
        return training.algorithm.update_policy(
            state.learner, Experience(replay, collectors, collected), key
        )

    learner, metrics = learn(state, jax.random.key(1))
    for field in ("model", "model_opt"):
        for before, after in zip(
            leaves(getattr(state.learner, field)), leaves(getattr(learner, field)), strict=True
        ):
            assert_array_equal(before, after)
    for before, after in zip(
        leaves(state.learner.behaviour.values), leaves(learner.behaviour.values), strict=True
    ):
        assert not np.array_equal(before, after)
    assert all(np.isfinite(value) for value in metrics.values())
    # The mixer sees the global samples of the team, the agents' values their own levels.
    values, model = learner.behaviour.values, learner.model
    latent = model.initial()
    team = training.algorithm.behaviour.critic_features(model, latent).ravel()
    assert values.mixer.weight_in.layers[0].weight.shape[:-1] == team.shape
    assert team.shape == (latent.global_.z.index.size, latent.global_.z.n_classes)
    own = tuple(block.shape[:-1] for block in values.q.layers[0].weight)
    assert own == (latent.agent.z.shape, latent.agent.h.shape[-1:])


def test_a_model_without_global_latents_is_refused():
    config = tiny("mabl-qmix")
    algorithm = ModelBased(DreamerV2, QMIX(config.qmix), CoordinationEnv().spec, config)
    with pytest.raises(TypeError, match="QMIX mixes by global latents, and DreamerV2 has none"):
        algorithm.init(KEY)
