from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mabl.nets.categorical import (
    Code,
    CodeShape,
    draw,
    flatten,
    sample_index,
    still,
    unflatten,
)

LARGEST_UNIFORM = 1 - 2**-23
"""jax.random.uniform in float32 yields multiples of 2^-23 below 1."""


def test_samples_are_exactly_one_hot():
    logits = 3 * jax.random.normal(jax.random.key(0), (50, 4, 5))
    code = draw(logits, jax.random.key(1))
    z = np.asarray(unflatten(code.onehot(), 5))
    assert z.shape == (50, 4, 5)
    assert set(np.unique(z)) == {0.0, 1.0}
    assert_array_equal(z.sum(-1), 1.0)
    assert_array_equal(z.argmax(-1), code.index)


def test_gradient_is_that_of_the_probabilities():
    # p = [1/4, 3/4]; d p_0 / d logits = p_0 [1 - p_0, -p_1] = [3/16, -3/16], whatever was drawn
    logits = jnp.log(jnp.array([[1.0, 3.0]]))
    for seed in range(5):
        gradient = jax.grad(lambda x, seed=seed: draw(x, jax.random.key(seed)).onehot()[0])
        assert_allclose(gradient(logits), [[0.1875, -0.1875]], rtol=1e-5)


def test_classes_are_drawn_as_often_as_they_are_probable():
    probs = np.array([0.5, 0.3, 0.15, 0.05])
    n = 20_000
    logits = jnp.broadcast_to(jnp.log(probs), (n, 1, 4))
    counts = np.asarray(draw(logits, jax.random.key(0)).onehot()).sum(0)
    chi_square = ((counts - n * probs) ** 2 / (n * probs)).sum()
    assert chi_square < 16.3  # 3 degrees of freedom: exceeded once in a thousand


def test_neighbouring_categoricals_are_drawn_independently():
    z = unflatten(draw(jnp.zeros((20_000, 2, 2)), jax.random.key(0)).onehot(), 2)
    both = np.asarray(z[:, 0, 0] * z[:, 1, 0]).mean()
    assert abs(both - 0.25) < 0.015  # five standard errors


@pytest.mark.parametrize("uniform", [0.0, 2**-23, 0.5, LARGEST_UNIFORM])
@pytest.mark.parametrize(
    "probs",
    [
        [0.0, 0.0, 0.4, 0.6],
        [0.4, 0.6, 0.0, 0.0],
        [0.0, 0.5, 0.0, 0.5, 0.0],
        [0.1] * 10 + [0.0],  # sums to a little more or less than 1 in float32
        [1 / 3, 1 / 3, 1 / 3, 0.0],
        [0.0, 1e-6, 0.0],
    ],
)
def test_classes_of_probability_zero_are_never_drawn(monkeypatch, probs, uniform):
    monkeypatch.setattr(jax.random, "uniform", lambda key, shape: jnp.full(shape, uniform))
    index = int(sample_index(jnp.array(probs), jax.random.key(0)))
    assert probs[index] > 0


def test_classes_of_probability_zero_are_never_drawn_at_random():
    probs = jnp.broadcast_to(jnp.array([0.0, 0.3, 0.0, 0.7, 0.0]), (20_000, 5))
    assert set(np.unique(sample_index(probs, jax.random.key(0)))) == {1, 3}


def test_flatten_and_unflatten_keep_categoricals_in_rows():
    logits = jnp.arange(6.0)
    assert_array_equal(unflatten(logits, 3), [[0, 1, 2], [3, 4, 5]])
    assert_array_equal(flatten(unflatten(logits, 3)), logits)


@pytest.mark.parametrize("shape", [(32,), (5, 32), (64, 3, 32), (1000, 7), (3, 33), (2, 2, 50)])
def test_no_class_is_drawn_where_the_distribution_function_does_not_rise(monkeypatch, shape):
    # Half of the probabilities are zero; uniform numbers fall on steps of the function.
    key_probs, key_zero, key_step = jax.random.split(jax.random.key(0), 3)
    probs = jax.random.uniform(key_probs, shape) * jax.random.bernoulli(key_zero, 0.5, shape)
    probs = probs.at[..., 0].set(0.1)
    step = jax.random.randint(key_step, (*shape[:-1], 1), 0, shape[-1])
    cdf = jnp.cumsum(probs, axis=-1) / probs.sum(-1, keepdims=True)
    uniform = jnp.minimum(jnp.take_along_axis(cdf, step, axis=-1), LARGEST_UNIFORM)
    for u in (uniform, jnp.zeros_like(uniform), jnp.full_like(uniform, LARGEST_UNIFORM)):
        monkeypatch.setattr(jax.random, "uniform", lambda key, shape, u=u: u.reshape(shape))
        index = sample_index(probs, jax.random.key(0))
        drawn = jnp.take_along_axis(probs, index[..., None], axis=-1)
        assert index.max() < shape[-1]
        assert (drawn > 0).all()


# --- Codes ------------------------------------------------------------------------------------


def some_code(tilt: bool = True) -> Code:
    """Of two agents: classes 2 and 0, and 1 and none."""
    index = jnp.array([[2, 0], [1, 3]], jnp.int32)
    return Code(index, jnp.zeros((2, 2, 3)) if tilt else None, 3)


@pytest.mark.parametrize("tilt", [False, True])
def test_a_code_as_a_vector_by_hand(tilt):
    code = some_code(tilt)
    assert code.shape == CodeShape(n_categoricals=2, n_classes=3)
    assert_array_equal(code.onehot(), [[0, 0, 1, 1, 0, 0], [0, 1, 0, 0, 0, 0]])


@pytest.mark.parametrize("tilt", [False, True])
def test_a_code_times_a_matrix_by_hand(tilt):
    weight = jnp.array([[[1.0, 2], [3, 4], [5, 6]], [[70, 80], [90, 100], [110, 120]]])
    # 5 + 70 and 6 + 80; the second agent has a class of the first variable alone
    assert_array_equal(some_code(tilt).times(weight), [[75, 86], [3, 4]])


def test_codes_of_several_agents_as_one():
    code = some_code(tilt=False).ravel()
    assert code.shape == CodeShape(4, 3)
    assert code.tilt is None
    assert_array_equal(code.index, [2, 0, 1, 3])
    assert_array_equal(code.onehot(), some_code().onehot().ravel())


def test_gradients_pass_through_codes_of_several_agents_as_one():
    logits, key = jax.random.normal(jax.random.key(0), (2, 2, 3)), jax.random.key(1)
    weights = jnp.arange(12.0) ** 2

    def one(logits: jax.Array) -> jax.Array:
        return draw(logits, key).ravel().onehot() @ weights

    def each(logits: jax.Array) -> jax.Array:
        return (draw(logits, key).onehot() * weights.reshape(2, 6)).sum()

    assert one(logits) == each(logits)
    assert_allclose(jax.grad(one)(logits), jax.grad(each)(logits), rtol=1e-6)
    assert jnp.abs(jax.grad(one)(logits)).min() > 0


def test_what_is_drawn_is_an_index_and_a_tilt_of_zeros():
    code = draw(jax.random.normal(jax.random.key(0), (5, 3, 4)), jax.random.key(1))
    assert code.shape == CodeShape(3, 4)
    assert (code.index.shape, code.index.dtype) == ((5, 3), jnp.int32)
    assert_array_equal(code.tilt, np.zeros((5, 3, 4)))
    none = Code.none(CodeShape(3, 4))
    assert (none.index.shape, none.index.dtype) == ((3,), jnp.int32)
    assert_array_equal(none.tilt, np.zeros((3, 4)))


def test_still_takes_the_tilts_of_a_tree_and_nothing_else():
    tree = {"codes": [some_code(), some_code(tilt=False)], "h": jnp.ones(2), "none": None}
    quiet = still(tree)
    for code in quiet["codes"]:
        assert code.tilt is None
        assert code.shape == (2, 3)
        assert_array_equal(code.index, some_code().index)
    assert quiet["h"] is tree["h"]
    assert quiet["none"] is None
    assert tree["codes"][0].tilt is not None


# --- Codes times matrices ----------------------------------------------------------------------


@pytest.fixture(params=["cpu", "gpu"])
def _backend(request, monkeypatch):
    """Both ways to compute a product; the one of other backends runs here just as well."""
    monkeypatch.setattr(jax, "default_backend", lambda: request.param)


def plain(logits: jax.Array, weight: jax.Array, key: jax.Array) -> jax.Array:
    """Straight-through as it is defined: onehot + p - stop(p), times a matrix."""
    probs = jax.nn.softmax(logits)
    onehot = jax.nn.one_hot(draw(logits, key).index, logits.shape[-1])
    z = flatten(onehot + probs - jax.lax.stop_gradient(probs))
    return z @ weight.reshape(-1, weight.shape[-1])


def by_code(logits: jax.Array, weight: jax.Array, key: jax.Array) -> jax.Array:
    return draw(logits, key).times(weight)


def over_time(times: Callable) -> Callable:
    """As a recurrent model does: what is drawn depends on what was drawn before."""

    def run(logits: jax.Array, weight: jax.Array, key: jax.Array) -> jax.Array:
        start = jnp.zeros((*logits.shape[1:-2], weight.shape[-1]))

        def step(state: jax.Array, at: tuple) -> tuple[jax.Array, jax.Array]:
            logits, key = at
            state = jnp.tanh(times(logits + state[..., None, :4], weight, key))
            return state, state

        return jax.lax.scan(step, start, (logits, jax.random.split(key, len(logits))))[1]

    return run


def batched(times: Callable, *in_axes: tuple) -> Callable:
    """Under one vmap for each of the axes."""
    for axes in in_axes:
        times = jax.vmap(times, axes)
    return times


LOGITS, BOTH, ALL, WEIGHT = (0, None, None), (0, 0, None), (0, 0, 0), (None, 0, None)
WAYS = {
    # What is done to a product, and the leading axes of logits, of weights and of keys.
    "one": (lambda f: f, (), (), ()),
    "leading axes": (lambda f: f, (2, 5), (), ()),
    "vmap": (lambda f: batched(f, (0, None, 0)), (5,), (), (5,)),
    "three vmaps": (lambda f: batched(f, *[(0, None, 0)] * 3), (2, 3, 4), (), (2, 3, 4)),
    "vmap over leading axes": (lambda f: batched(f, (0, None, 0)), (5, 2), (), (5,)),
    "vmap with one key": (lambda f: batched(f, LOGITS), (5,), (), ()),
    "vmap over both": (lambda f: batched(f, ALL), (5,), (5,), (5,)),
    "vmap over both with one key": (lambda f: batched(f, BOTH), (5,), (5,), ()),
    "vmap over weights alone": (lambda f: batched(f, WEIGHT), (), (5,), ()),
    "vmap over logits in one over both": (lambda f: batched(f, LOGITS, ALL), (3, 2), (3,), (3,)),
    "vmap over weights in one over logits": (
        lambda f: batched(f, WEIGHT, (0, None, 0)),
        (3,),
        (2,),
        (3,),
    ),
    "scan": (over_time, (6,), (), ()),
    "scan over leading axes": (over_time, (6, 3), (), ()),
    "vmap of scan": (lambda f: batched(over_time(f), (0, None, 0)), (3, 6), (), (3,)),
    "vmap of scan over both": (lambda f: batched(over_time(f), ALL), (3, 6), (3,), (3,)),
    "scan of vmap": (lambda f: over_time(batched(f, LOGITS)), (6, 3), (), ()),
    "vmap of scan of vmap": (
        lambda f: batched(over_time(batched(f, LOGITS)), (0, None, 0)),
        (2, 6, 3),
        (),
        (2,),
    ),
}


def operands(way: str) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Logits of three variables of four classes, weights towards five outputs, keys."""
    _, of_logits, of_weight, of_key = WAYS[way]
    key_logits, key_weight, key = jax.random.split(jax.random.key(0), 3)
    logits = 2 * jax.random.normal(key_logits, (*of_logits, 3, 4))
    weight = jax.random.normal(key_weight, (*of_weight, 3, 4, 5))
    return logits, weight, jax.random.split(key, of_key) if of_key else key


def loss_of(product: Callable) -> Callable:
    """One whose gradient differs from output to output."""
    return lambda *operands: jnp.sin(product(*operands)).sum()


@pytest.mark.usefixtures("_backend")
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("way", WAYS)
def test_a_code_times_a_matrix_is_the_product_and_has_its_gradients(way, compiled):
    transform = WAYS[way][0]
    compiler = jax.jit if compiled else lambda f: f
    product, expected = transform(by_code), transform(plain)
    values = compiler(product)(*operands(way))
    assert values.std() > 0.1
    assert_allclose(values, compiler(expected)(*operands(way)), rtol=1e-5, atol=1e-6)
    gradients, expected_gradients = (
        compiler(jax.grad(loss_of(f), argnums=(0, 1)))(*operands(way)) for f in (product, expected)
    )
    for x, y in zip(gradients, expected_gradients, strict=True):
        assert jnp.abs(y).max() > 0.01
        assert_allclose(x, y, rtol=1e-5, atol=1e-6)


@pytest.mark.usefixtures("_backend")
@pytest.mark.parametrize("way", ["vmap", "vmap over both", "vmap of scan"])
def test_gradients_of_each_example_are_those_of_the_product(way):
    axes = (0, 0 if WAYS[way][2] else None, 0)
    inner = over_time if way == "vmap of scan" else lambda f: f

    def gradients(times: Callable) -> tuple[jax.Array, jax.Array]:
        return jax.jit(jax.vmap(jax.grad(loss_of(inner(times)), (0, 1)), axes))(*operands(way))

    for x, y in zip(gradients(by_code), gradients(plain), strict=True):
        assert jnp.abs(y).max() > 0.01
        assert_allclose(x, y, rtol=1e-5, atol=1e-6)


@pytest.mark.usefixtures("_backend")
@pytest.mark.parametrize("leading", [(), (5,), (2, 5)])
def test_no_classes_times_a_matrix_are_zeros_and_give_it_no_gradient(leading):
    weight = jax.random.normal(jax.random.key(0), (3, 4, 5))
    none = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (*leading, *x.shape)), Code.none(CodeShape(3, 4))
    )
    for code in (none, still(none)):
        assert_array_equal(code.onehot(), np.zeros((*leading, 12)))
        assert_array_equal(code.times(weight), np.zeros((*leading, 5)))
        gradient = jax.grad(lambda weight, code=code: (code.times(weight) + 1.0).sum())(weight)
        assert_array_equal(gradient, np.zeros((3, 4, 5)))


@pytest.mark.usefixtures("_backend")
def test_a_variable_without_a_class_adds_nothing_to_those_with_one():
    weight = jax.random.normal(jax.random.key(0), (2, 3, 4))

    def product(code: Code, weight: jax.Array) -> jax.Array:
        return code.times(weight)

    for code in (some_code(), some_code(tilt=False)):
        product_of_each = jax.vmap(product, (0, None))
        values = [weight[0, 2] + weight[1, 0], weight[0, 1]]
        assert_allclose(product(code, weight), values, rtol=1e-6)
        assert_allclose(product_of_each(code, weight), values, rtol=1e-6)
        gradient = jax.grad(lambda w, c=code, f=product_of_each: f(c, w).sum())(weight)
        ones = np.zeros((2, 3, 4))
        ones[[0, 0, 1], [2, 1, 0]] = 1.0
        assert_array_equal(gradient, ones)


@pytest.mark.usefixtures("_backend")
@pytest.mark.parametrize("way", ["one", "three vmaps", "vmap over both", "scan of vmap"])
def test_a_still_code_gives_logits_no_gradient_and_the_matrix_the_same(way):
    def motionless(logits: jax.Array, weight: jax.Array, key: jax.Array) -> jax.Array:
        return still(draw(logits, key)).times(weight)

    def of_detached(logits: jax.Array, weight: jax.Array, key: jax.Array) -> jax.Array:
        return by_code(jax.lax.stop_gradient(logits), weight, key)

    transform = WAYS[way][0]
    to_logits, to_weight = jax.grad(loss_of(transform(motionless)), (0, 1))(*operands(way))
    assert_array_equal(to_logits, np.zeros_like(to_logits))
    same = jax.grad(loss_of(transform(of_detached)), 1)(*operands(way))
    assert_allclose(to_weight, same, rtol=1e-5, atol=1e-6)
    if "scan" not in way:  # there a gradient also comes by way of what was drawn before
        assert_allclose(
            to_weight,
            jax.grad(loss_of(transform(by_code)), 1)(*operands(way)),
            rtol=1e-5,
            atol=1e-6,
        )


@pytest.mark.parametrize(("backend", "dense"), [("cpu", False), ("gpu", True), ("tpu", True)])
def test_a_dense_product_is_computed_on_other_backends_than_the_cpu(monkeypatch, backend, dense):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    weight = jnp.ones((2, 3, 4))
    for tilt in (False, True):
        program = jax.make_jaxpr(lambda code, weight: code.times(weight))(some_code(tilt), weight)
        assert ("= product[" in str(program)) is dense
