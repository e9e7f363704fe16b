import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from mabl.world_models.levels import (
    AgentFilter,
    Categoricals,
    Level,
    Recurrent,
    draw,
    forget,
    team_of,
)


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def test_recurrent_is_a_textbook_gru_behind_a_relu_layer():
    recurrent = Recurrent(latent_dim=3, action_dim=2, hidden=4, key=jax.random.key(0))
    rng = np.random.default_rng(0)
    h, z, action = (rng.normal(size=n).astype(np.float32) for n in (4, 3, 2))

    inputs, cell = jax.tree.map(np.asarray, (recurrent.inputs, recurrent.cell))
    x = np.maximum(np.concatenate([z, action]) @ inputs.weight + inputs.bias, 0)
    w_reset, w_keep, w_new = np.split(cell.weight_ih, 3)
    u_reset, u_keep, u_new = np.split(cell.weight_hh, 3)
    b_reset, b_keep, b_new = np.split(cell.bias, 3)
    reset = sigmoid(w_reset @ x + u_reset @ h + b_reset)
    keep = sigmoid(w_keep @ x + u_keep @ h + b_keep)
    new = np.tanh(w_new @ x + b_new + reset * (u_new @ h + cell.bias_n))
    expected = (1 - keep) * new + keep * h

    level = Level(h=jnp.asarray(h), z=jnp.asarray(z))
    assert_allclose(recurrent(level, jnp.asarray(action)), expected, rtol=1e-5, atol=1e-6)


def test_recurrent_depends_on_each_of_its_inputs():
    recurrent = Recurrent(3, 2, 16, jax.random.key(0))
    zeros = Level(h=jnp.zeros(16), z=jnp.zeros(3))
    base = recurrent(zeros, jnp.zeros(2))
    for level, action in (
        (zeros._replace(h=jnp.ones(16)), jnp.zeros(2)),
        (zeros._replace(z=jnp.ones(3)), jnp.zeros(2)),
        (zeros, jnp.ones(2)),
    ):
        assert not np.allclose(recurrent(level, action), base)


def test_categoricals_give_one_row_of_logits_for_each_categorical():
    net = Categoricals(n_in=5, hidden=8, n_categoricals=3, n_classes=4, key=jax.random.key(0))
    a, b = jnp.arange(2.0), jnp.arange(3.0)
    logits = net(a, b)
    assert logits.shape == (3, 4)
    assert_array_equal(logits.ravel(), net.mlp(jnp.concatenate([a, b])))


def test_a_drawn_state_has_one_class_of_each_categorical():
    logits = jax.random.normal(jax.random.key(0), (7, 3, 4))
    z = np.asarray(draw(logits, jax.random.key(1)))
    assert z.shape == (7, 12)
    assert_array_equal(z.reshape(7, 3, 4).sum(-1), 1.0)


def test_one_step_of_the_filter_is_h_then_z_given_h():
    agent = AgentFilter(5, 2, 8, 3, 4, jax.random.key(0))
    level = Level(h=jnp.linspace(-1, 1, 8), z=jnp.eye(12)[2])
    action, obs, key = jnp.array([0.0, 1.0]), jnp.linspace(0, 1, 5), jax.random.key(1)
    after = agent(level, action, obs, key)
    h = agent.recurrent(level, action)
    logits = agent.posterior(h, jax.nn.relu(agent.encoder(obs)))
    assert_allclose(after.h, h, rtol=1e-6)
    assert_array_equal(after.z, draw(logits, key))


def test_the_filter_starts_from_zeros():
    start = AgentFilter(5, 2, 8, 3, 4, jax.random.key(0)).initial()
    assert_array_equal(start.h, np.zeros(8))
    assert_array_equal(start.z, np.zeros(12))


def test_features_are_z_then_h():
    level = Level(h=jnp.array([[1.0, 2.0]]), z=jnp.array([[0.0, 1.0, 0.0]]))
    assert_array_equal(level.features(), [[0, 1, 0, 1, 2]])
    agent = AgentFilter(5, 2, 8, 3, 4, jax.random.key(0))
    own = Level(h=jnp.arange(8.0), z=jnp.eye(12)[2])
    assert_array_equal(agent.features(own), np.concatenate([own.z, own.h]))
    assert agent.obs_dim == 5


def test_a_team_starts_with_what_one_agent_starts_with():
    team = team_of(3, Level(h=jnp.arange(2.0), z=jnp.ones(1)))
    assert_array_equal(team.h, [[0, 1]] * 3)
    assert_array_equal(team.z, [[1]] * 3)


def test_the_past_is_zeros_at_a_first_row_and_as_it_is_at_any_other():
    past = (jnp.array([[1.0, 2.0]]), jnp.array([True]), jnp.array(3))
    kept, gone = forget(past, jnp.bool_(False)), forget(past, jnp.bool_(True))
    for x, y, z in zip(past, kept, gone, strict=True):
        assert_array_equal(x, y)
        assert_array_equal(z, np.zeros_like(x))
        assert x.dtype == y.dtype == z.dtype
