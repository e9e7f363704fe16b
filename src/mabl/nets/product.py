"""Vectors times weights, in the precision that a run asks for.

In bfloat16 a product rounds its operands and adds up in float32; all that is not a product stays
float32. XLA's fast bfloat16 kernel on a CPU takes no transposed operand, and both gradients of a
product have one: there they get a copy in its place (docs/results/performance.md). To say so, what
networks multiply with is a primitive of its own, which like JAX's takes all examples that `vmap`
knows of at once.
"""

from collections.abc import Callable
from functools import wraps
from math import prod
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
from einops import rearrange
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

Precision = Literal["float32", "bfloat16"]
"""Of a product's operands. GPUs take TF32 for float32 where they have it, as is JAX's default."""
F = TypeVar("F", bound=Callable[..., Any])


def in_precision(precision: Precision, function: F) -> F:
    """The function, whose products are traced in that precision; what compiles it goes around it.

    JAX keeps the setting with what it has traced, so that nothing is taken for the other.
    """

    @wraps(function)
    def traced(*arguments: Any) -> Any:
        with jax.default_matmul_precision("default" if precision == "float32" else precision):
            return function(*arguments)

    return traced  # pyright: ignore[reportReturnType]


def product(x: Float[Array, "*b I"], weight: Float[Array, "I O"]) -> Float[Array, "*b O"]:
    """x W."""
    # JAX casts gradients back to what was given.
    return _of_all(x.astype(jnp.float32), weight.astype(jnp.float32), _asked_for_bfloat16())


def product_with_transposed(
    x: Float[Array, "*b O"], weight: Float[Array, "I O"]
) -> Float[Array, "*b I"]:
    """x W^T."""
    bfloat16 = _asked_for_bfloat16()
    return _of_all(x, transposed(weight, bfloat16), bfloat16)


def _of_all(x: Array, weight: Array, bfloat16: bool) -> Array:
    rows = x.reshape(prod(x.shape[:-1]), x.shape[-1])
    return _product.bind(rows, weight, bfloat16=bfloat16).reshape(*x.shape[:-1], weight.shape[-1])


def _asked_for_bfloat16() -> bool:
    asked = jax.config.jax_default_matmul_precision  # pyright: ignore[reportAttributeAccessIssue]
    return asked == "bfloat16"


def transposed(x: Float[Array, "*w R D"], bfloat16: bool) -> Float[Array, "*w D R"]:
    """x^T as an operand of a product."""
    if not bfloat16 or jax.default_backend() != "cpu":
        return jnp.swapaxes(x, -1, -2)
    # XLA makes a plain transposition part of the product, and takes the slow kernel for it. One of
    # three axes it leaves alone.
    size = x.shape[-1]
    parts = next((n for n in (16, 8, 4, 2, 3, 5, 7) if size > n and size % n == 0), 1)
    return rearrange(x.astype(jnp.bfloat16), "... r (n d) -> ... (n d) r", n=parts)


_product = Primitive("product")
"""`[*w, R, I]` times `[*w, I, O]`: rows times each of several weights."""


@_product.def_impl
def _multiply(x: Array, weight: Array, *, bfloat16: bool) -> Array:
    kind = jnp.bfloat16 if bfloat16 else jnp.float32
    # Lowered apart from what surrounds it: nothing may depend on JAX's setting any more.
    return jnp.matmul(
        x.astype(kind),
        weight.astype(kind),
        precision=jax.lax.Precision.DEFAULT,
        preferred_element_type=jnp.float32,
    )


def _shape(x: Any, weight: Any, *, bfloat16: bool) -> Any:
    del bfloat16
    assert x.shape[:-2] == weight.shape[:-2] and x.shape[-1] == weight.shape[-2]
    return ShapedArray((*x.shape[:-1], weight.shape[-1]), jnp.float32)


def _towards_x(gradient: Array, x: Any, weight: Array, *, bfloat16: bool) -> Array:
    del x
    return _product.bind(gradient, transposed(weight, bfloat16), bfloat16=bfloat16)


def _towards_weight(gradient: Array, x: Array, weight: Any, *, bfloat16: bool) -> Array:
    del weight
    return _product.bind(transposed(x, bfloat16), gradient, bfloat16=bfloat16)


def _over_examples(
    operands: tuple[Array, Array], axes: tuple[Any, Any], *, bfloat16: bool
) -> tuple[Array, int]:
    """More rows where weights are shared, else more weights."""
    (x, weight), (of_x, of_weight) = operands, axes
    if of_weight is None:
        x = jnp.moveaxis(x, of_x, -3)
        rows = rearrange(x, "... b r i -> ... (b r) i")
        made = _product.bind(rows, weight, bfloat16=bfloat16)
        return rearrange(made, "... (b r) o -> ... b r o", b=x.shape[-3]), made.ndim - 2
    weight = jnp.moveaxis(weight, of_weight, 0)
    if of_x is None:
        x = jnp.broadcast_to(x, (weight.shape[0], *x.shape))
    else:
        x = jnp.moveaxis(x, of_x, 0)
    return _product.bind(x, weight, bfloat16=bfloat16), 0


_product.def_abstract_eval(_shape)
mlir.register_lowering(_product, mlir.lower_fun(_multiply, multiple_results=False))
ad.defbilinear(_product, _towards_x, _towards_weight)
batching.primitive_batchers[_product] = _over_examples
