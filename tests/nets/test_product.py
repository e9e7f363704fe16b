"""Products equal plain ones, values and gradients, however models nest `vmap` and `scan`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mabl.nets.product import in_precision, product, transposed

X = jax.random.normal(jax.random.key(0), (5, 4, 3, 6))  # [T, B, N, I]
W = jax.random.normal(jax.random.key(1), (6, 6))
TOLERANCE = {"float32": 1e-6, "bfloat16": 8e-2}  # operands keep 8 bits


def rows(function, weight_axis=None):
    """Over time, batch and agents, who have weights each or share them."""
    agents = jax.vmap(function, (0, weight_axis))
    return jax.vmap(jax.vmap(agents, (0, None)), (0, None))


def shared(f, x, w):
    return jnp.sin(rows(f)(x, w))


def alone(f, x, w):
    return jnp.sin(f(x[0, 0, 0], w))


def whole(f, x, w):
    return jnp.sin(f(x, w))


def own_weights(f, x, w):
    return jnp.sin(rows(f, 0)(x, jnp.stack([w, 2 * w, w - 1])))


def recurrent(f, x, w):
    def step(h, x):
        h = jnp.tanh(jax.vmap(jax.vmap(lambda h, x: f(h, w) + x))(h, x))
        return h, h

    return jax.lax.scan(step, jnp.zeros_like(x[0]), x)[1]


def one_input_for_all(f, x, w):
    return jax.vmap(lambda scale: rows(f)(x, w) * scale)(jnp.arange(3.0))


def one_factor_for_all(f, x, w):
    return jax.vmap(lambda x: f(x, w) + jax.vmap(lambda y: f(y, w))(x))(x[0])


def seeds(f, x, w):
    weights = jnp.stack([w, w + 1])
    return jax.vmap(lambda w: jnp.sin(rows(f)(x, w)))(weights)


NESTINGS = (
    shared,
    alone,
    whole,
    own_weights,
    recurrent,
    one_input_for_all,
    one_factor_for_all,
    seeds,
)


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("nesting", NESTINGS, ids=lambda f: f.__name__)
def test_products_and_gradients_are_those_of_plain_ones(nesting, precision):
    def all_of(f):
        def loss(x, w):
            y = nesting(f, x, w)
            return (y**2).sum(), y

        (_, y), gradients = jax.value_and_grad(loss, (0, 1), has_aux=True)(X, W)
        return (y, *gradients)

    expected = jax.jit(lambda: all_of(jnp.matmul))()
    found = jax.jit(in_precision(precision, lambda: all_of(product)))()
    for e, f in zip(expected, found, strict=True):
        assert f.dtype == jnp.float32 and f.shape == e.shape
        # Of the largest: sums cancel, and errors of a recurrence add up.
        assert_allclose(f, e, rtol=0, atol=TOLERANCE[precision] * np.abs(e).max())


def test_gradients_of_several_seeds_are_each_their_own():
    def gradient(f):
        return jax.grad(lambda x, w: jnp.sin(rows(f)(x, w)).sum(), (0, 1))

    xs, ws = jnp.stack([X, X + 1]), jnp.stack([W, 2 * W])
    together = jax.vmap(gradient(product))(xs, ws)
    apart = [gradient(jnp.matmul)(x, w) for x, w in zip(xs, ws, strict=True)]
    for found, *expected in zip(together, *apart, strict=True):
        assert_allclose(found, jnp.stack(expected), rtol=1e-5, atol=1e-5)


def test_weights_gradient_is_one_product_and_not_a_sum_of_many():
    def loss(w):
        return rows(product)(X, w).sum()

    for function in (loss, lambda w: recurrent(product, X, w).sum()):
        text = str(jax.make_jaxpr(jax.grad(function))(W))
        assert "f32[6,6] = product" in text
        assert "3,6,6]" not in text and "4,6,6]" not in text  # not one for each example


def test_bfloat16_rounds_operands_alone_and_adds_up_in_float32():
    big = jnp.float32(256.0)  # beside which bfloat16 loses ones
    x, w = jnp.array([[256.0, 1.0, 1.0]]), jnp.array([[1.0], [1.0], [1.0]])
    rounded = in_precision("bfloat16", product)
    assert rounded(x, w) == big + 2
    assert rounded(jnp.array([[1.001953125]]), jnp.ones((1, 1))) == 1.0  # 1 + 2^-9
    assert product(jnp.array([[1.001953125]]), jnp.ones((1, 1))) == 1.001953125


def test_what_was_traced_in_one_precision_is_not_taken_for_the_other():
    x, w = jnp.array([[1.001953125]]), jnp.ones((1, 1))
    compiled = jax.jit(product)
    assert in_precision("bfloat16", compiled)(x, w) == 1.0
    assert compiled(x, w) == 1.001953125
    assert in_precision("bfloat16", compiled)(x, w) == 1.0


@pytest.mark.parametrize("columns", [1, 2, 6, 7, 16, 34, 121])
def test_copies_are_transposed(columns):
    x = jax.random.normal(jax.random.key(2), (3, 5, columns)).astype(jnp.bfloat16)
    assert (transposed(x, True) == jnp.swapaxes(x, 1, 2)).all()


def test_each_example_has_a_gradient_of_its_own():
    """Outside of `grad`, `vmap` adds nothing up."""

    def gradient(f):
        return jax.vmap(jax.grad(lambda w, x: jnp.sin(rows(f)(x, w)).sum()), (None, 0))

    xs = jnp.stack([X, X + 1])
    for ours, plain in zip(gradient(product)(W, xs), gradient(jnp.matmul)(W, xs), strict=True):
        assert_allclose(ours, plain, rtol=1e-5, atol=1e-5)


def test_second_derivatives():
    def hessian(f):
        return jax.hessian(lambda w: jnp.sin(rows(f)(X, w)).sum())(W)

    assert_allclose(hessian(product), hessian(jnp.matmul), rtol=1e-5, atol=1e-4)


def test_on_a_cpu_no_product_in_bfloat16_has_a_transposed_operand():
    """Which would take XLA's slow kernel."""
    x, w = jnp.ones((64, 32)), jnp.ones((32, 48))

    def products(precision):
        def loss(x, w):
            return jnp.sin(jax.vmap(product, (0, None))(x, w)).sum()

        gradients = jax.jit(in_precision(precision, jax.grad(loss, (0, 1))))
        text = gradients.lower(x, w).compile().as_text()
        plain = "lhs_contracting_dims={1}, rhs_contracting_dims={0}"
        return [plain in line for line in text.splitlines() if " dot(" in line]

    assert products("bfloat16") == [True] * 3
    assert not all(products("float32"))


def test_gradients_have_the_type_of_what_they_are_of():
    x, w = jnp.ones((4, 3), jnp.bfloat16), jnp.ones((3, 2))
    to_x, to_w = jax.grad(lambda x, w: product(x, w).sum(), (0, 1))(x, w)
    assert to_x.dtype == jnp.bfloat16 and to_w.dtype == jnp.float32


def test_of_matrices_times_nothing():
    assert product(jnp.ones((0, 3)), jnp.ones((3, 2))).shape == (0, 2)
    assert (product(jnp.ones((3, 0)), jnp.ones((0, 2))) == jnp.zeros((3, 2))).all()
    assert (product(jnp.ones(3), jnp.ones((3, 2))) == 3).all()
