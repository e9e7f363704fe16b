from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from mabl.envs.base import Discrete, EnvSpec
from mabl.nets.categorical import Code, CodeShape, draw
from mabl.nets.mlp import MLP, Linear, dense
from mabl.world_models.base import WorldModelConfig
from mabl.world_models.levels import (
    AgentFilter,
    Categoricals,
    Embedded,
    Level,
    Recurrent,
    forget,
    partly_decoded,
    team_of,
)

LATENT = CodeShape(3, 4)
SPEC = EnvSpec("stub", 2, 5, 6, Discrete(2), 10, "score")


def filter_of(**options: Any) -> AgentFilter:
    """Observations of 5 numbers, 2 actions, h of 8, codes of 3 x 4."""
    config = WorldModelConfig(hidden=8, n_hidden=1, n_categoricals=3, n_classes=4)
    return AgentFilter(SPEC, replace(config, **options), jax.random.key(0))


def code(*index: int, n_classes: int) -> Code:
    """Classes given by hand, without a tilt."""
    return Code(jnp.array(index, jnp.int32), None, n_classes)


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def test_recurrent_is_a_textbook_gru_behind_a_relu_layer():
    recurrent = Recurrent(CodeShape(2, 3), action_dim=2, hidden=4, key=jax.random.key(0))
    rng = np.random.default_rng(0)
    h, action = (rng.normal(size=n).astype(np.float32) for n in (4, 2))
    z = np.array([0, 0, 1, 1, 0, 0], np.float32)  # class 2, then class 0

    inputs, cell = jax.tree.map(np.asarray, (recurrent.inputs, recurrent.cell))
    weight = np.concatenate([block.reshape(-1, 4) for block in inputs.weight])
    x = np.maximum(np.concatenate([z, action]) @ weight + inputs.bias, 0)
    w_reset, w_keep, w_new = np.split(cell.weight_in.T, 3)
    u_reset, u_keep, u_new = np.split(cell.weight_hidden.T, 3)
    b_reset, b_keep, b_new = np.split(cell.bias, 3)
    reset = sigmoid(w_reset @ x + u_reset @ h + b_reset)
    keep = sigmoid(w_keep @ x + u_keep @ h + b_keep)
    new = np.tanh(w_new @ x + b_new + reset * (u_new @ h + cell.bias_new))
    expected = (1 - keep) * new + keep * h

    level = Level(h=jnp.asarray(h), z=code(2, 0, n_classes=3))
    assert_allclose(recurrent(level, jnp.asarray(action)), expected, rtol=1e-5, atol=1e-6)


def test_recurrent_depends_on_each_of_its_inputs():
    recurrent = Recurrent(CodeShape(1, 3), 2, 16, jax.random.key(0))
    zeros = Level.none(16, CodeShape(1, 3))
    base = recurrent(zeros, jnp.zeros(2))
    for level, action in (
        (zeros._replace(h=jnp.ones(16)), jnp.zeros(2)),
        (zeros._replace(z=code(1, n_classes=3)), jnp.zeros(2)),
        (zeros, jnp.ones(2)),
    ):
        assert not np.allclose(recurrent(level, action), base)


def test_categoricals_give_one_row_of_logits_for_each_categorical():
    net = Categoricals((2, 3), 8, LATENT, jax.random.key(0))
    a, b = jnp.arange(2.0), jnp.arange(3.0)
    logits = net(a, b)
    assert logits.shape == (3, 4)
    assert_array_equal(logits.ravel(), net.mlp(a, b))
    whole = MLP(5, 12, 8, 1, jax.random.key(0))
    assert_allclose(logits.ravel(), whole(jnp.concatenate([a, b])), rtol=1e-5, atol=1e-6)


def test_a_drawn_state_has_one_class_of_each_categorical():
    logits = jax.random.normal(jax.random.key(0), (7, 3, 4))
    z = np.asarray(draw(logits, jax.random.key(1)).onehot())
    assert z.shape == (7, 12)
    assert_array_equal(z.reshape(7, 3, 4).sum(-1), 1.0)


def test_one_step_of_the_filter_is_h_then_z_given_h():
    agent = filter_of()
    level = Level(h=jnp.linspace(-1, 1, 8), z=code(2, 0, 3, n_classes=4))
    action, obs, key = jnp.array([0.0, 1.0]), jnp.linspace(0, 1, 5), jax.random.key(1)
    after = agent(level, action, obs, key)
    h = agent.recurrent(level, action)
    logits = agent.posterior(h, jax.nn.relu(agent.encoder(obs)))
    assert_allclose(after.h, h, rtol=1e-6)
    assert_array_equal(after.z.onehot(), draw(logits, key).onehot())


def test_the_filter_starts_from_zeros():
    start = filter_of().initial()
    assert_array_equal(start.h, np.zeros(8))
    assert_array_equal(start.z.onehot(), np.zeros(12))


def test_the_filters_latents_are_alike_at_the_start_and_later_and_carry_no_gradients():
    agent = filter_of()
    assert agent.latent == LATENT
    start = agent.initial()
    after = agent(start, jnp.zeros(2), jnp.zeros(5), jax.random.key(1))
    assert start.z.tilt is after.z.tilt is None
    assert jax.tree.structure(start) == jax.tree.structure(after)
    for x, y in zip(jax.tree.leaves(start), jax.tree.leaves(after), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)


def test_what_is_inferred_to_train_carries_gradients_through_its_sample():
    agent = filter_of()
    level, action = Level.none(8, LATENT), jnp.zeros(2)

    def weighted(embed: jax.Array) -> jax.Array:
        obs = Embedded(embed, None)
        return agent.infer(level, action, obs, jax.random.key(1))[0].z.onehot() @ jnp.arange(12.0)

    assert jnp.abs(jax.grad(weighted)(jnp.ones(8))).max() > 0


def test_features_are_z_then_h():
    level = Level(h=jnp.array([[1.0, 2.0]]), z=Code(jnp.array([[1]]), None, 3))
    assert_array_equal(dense(level.features()), [[0, 1, 0, 1, 2]])
    agent = filter_of()
    own = Level(h=jnp.arange(8.0), z=code(2, 0, 3, n_classes=4))
    assert_array_equal(dense(agent.features(own)), [0, 0, 1, 0, 1, 0, 0, 0, 0, 0, 0, 1, *range(8)])
    assert agent.obs_dim == 5


def test_policies_see_what_policy_input_says():
    own = Level(h=jnp.arange(8.0), z=code(2, 0, 3, n_classes=4), row=jnp.arange(5.0))
    z_h = dense(own.features())
    for policy_input in ("latent", "decoded", "observation"):
        agent = filter_of(policy_input=policy_input)
        expected = {"latent": [z_h], "decoded": [z_h, *agent.decoded(own)], "observation": own.row}
        seen = dense(agent.features(own))
        assert_array_equal(seen, np.hstack(expected[policy_input]))


def test_levels_hold_the_real_row_where_inferred_and_the_decoded_one_where_imagined():
    agent = filter_of(policy_input="observation")
    obs = jnp.linspace(0, 1, 5)
    real = agent(agent.initial(), jnp.zeros(2), obs, jax.random.key(1))
    assert_array_equal(real.row, obs)
    imagined = agent.imagined(real.h, real.z)
    assert_allclose(imagined.row, agent.decoder(real.z, real.h), rtol=1e-6)
    assert filter_of().imagined(real.h, real.z).row is None
    assert filter_of()(filter_of().initial(), jnp.zeros(2), obs, jax.random.key(1)).row is None


def test_recurrent_models_see_the_row_before_with_recurrent_sees_row():
    agent, plain = filter_of(recurrent_sees="row"), filter_of(policy_input="observation")
    own = Level(h=jnp.arange(8.0), z=code(2, 0, 3, n_classes=4), row=jnp.arange(5.0))
    other = own._replace(row=own.row + 1.0)
    action = jnp.array([0.0, 1.0])
    assert jnp.abs(agent.recurrent(own, action) - agent.recurrent(other, action)).max() > 1e-3
    assert_array_equal(plain.recurrent(own, action), plain.recurrent(other, action))
    recurrent = Recurrent(LATENT, 2, 8, jax.random.key(1), row_dim=5)
    whole = Linear(12 + 2 + 5, 8, jax.random.split(jax.random.key(1))[0])
    x = whole(jnp.concatenate([own.z.onehot(), action, own.row]))
    expected = recurrent.cell(jax.nn.relu(x), own.h)
    assert_allclose(recurrent(own, action), expected, rtol=1e-5, atol=1e-6)


def test_a_share_of_rows_is_decoded():
    agent = filter_of(policy_input="observation")
    own = Level(h=jnp.arange(8.0), z=code(2, 0, 3, n_classes=4), row=jnp.arange(5.0))
    (decoded,) = agent.decoded(own)

    def mixed(share: float) -> jax.Array:
        keys = jax.random.split(jax.random.key(0), 400)
        return jax.vmap(lambda key: partly_decoded(own, agent.decoder, share, key).row)(keys)

    assert_array_equal(mixed(0.0), jnp.tile(own.row, (400, 1)))
    assert_allclose(mixed(1.0), jnp.tile(decoded, (400, 1)), rtol=1e-6)
    half = np.isclose(mixed(0.25), decoded).all(-1)
    assert 0.15 < half.mean() < 0.35
    assert_array_equal(mixed(0.25)[~half], jnp.tile(own.row, ((~half).sum(), 1)))
    bare = own._replace(row=None)
    assert partly_decoded(bare, agent.decoder, 1.0, jax.random.key(0)) is bare


def test_a_level_of_nothing_is_zeros():
    level = Level.none(2, LATENT)
    assert level.row is None
    assert_array_equal(Level.none(2, LATENT, 3).row, np.zeros(3))
    assert_array_equal(dense(level.features()), np.zeros(14))
    assert_array_equal(level.z.index, [4, 4, 4])


def test_a_team_starts_with_what_one_agent_starts_with():
    own = Code(jnp.array([1, 0]), jnp.zeros((2, 2)), 2)
    team = team_of(3, Level(h=jnp.arange(2.0), z=own))
    assert_array_equal(team.h, [[0, 1]] * 3)
    assert_array_equal(team.z.index, [[1, 0]] * 3)
    assert_array_equal(team.z.onehot(), [[0, 1, 1, 0]] * 3)


def test_the_past_is_zeros_at_a_first_row_and_as_it_is_at_any_other():
    past = (jnp.array([[1.0, 2.0]]), jnp.array([True]), jnp.array(3))
    kept, gone = forget(past, jnp.bool_(False)), forget(past, jnp.bool_(True))
    for x, y, z in zip(past, kept, gone, strict=True):
        assert_array_equal(x, y)
        assert_array_equal(z, np.zeros_like(x))
        assert x.dtype == y.dtype == z.dtype


def test_the_past_is_a_code_of_nothing_at_a_first_row_and_as_it_was_at_any_other():
    for tilt in (None, jnp.zeros((2, 2, 3))):
        past = {"z": Code(jnp.array([[2, 0], [1, 1]], jnp.int32), tilt, 3)}
        kept, gone = forget(past, jnp.bool_(False))["z"], forget(past, jnp.bool_(True))["z"]
        assert_array_equal(kept.onehot(), past["z"].onehot())
        assert_array_equal(gone.onehot(), np.zeros((2, 6)))
        assert kept.shape == gone.shape == (2, 3)
        assert kept.index.dtype == gone.index.dtype == jnp.int32
        assert (kept.tilt is None) == (gone.tilt is None) == (tilt is None)


def test_gradients_reach_what_is_kept_of_the_past_and_not_what_is_forgotten():
    def weighted(logits: jax.Array, is_first: bool) -> jax.Array:
        past = draw(logits, jax.random.key(0))
        return forget(past, jnp.bool_(is_first)).onehot() @ jnp.arange(6.0)

    logits = jnp.log(jnp.array([[1.0, 3.0, 4.0], [2.0, 2.0, 4.0]]))
    # p (w - p w): p = [1/8, 3/8, 1/2] and [1/4, 1/4, 1/2], w = 0, 1, 2 and 3, 4, 5; means of w
    # are 11/8 and 17/4.
    expected = [[-11 / 64, -9 / 64, 5 / 16], [-5 / 16, -1 / 16, 3 / 8]]
    assert_allclose(jax.grad(weighted)(logits, False), expected, rtol=1e-5)
    assert_array_equal(jax.grad(weighted)(logits, True), np.zeros((2, 3)))
