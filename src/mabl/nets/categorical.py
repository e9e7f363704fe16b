"""Latent states as vectors of K categorical variables with C classes each (section 3.1, [13]).

A state is a `Code`: the index of each variable's class, in place of K C zeros and ones. What a
network's first layer makes of it is then a sum of K rows of its weights, not a product with a
matrix, and a trajectory of states takes little memory (docs/results/performance.md).
"""

from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from einops import rearrange
from jaxtyping import Array, Float, Int

from mabl.nets.product import product, product_with_transposed
from mabl.types import PRNGKey

Tree = TypeVar("Tree")


class CodeShape(NamedTuple):
    """How many variables, and classes of each."""

    n_categoricals: int
    n_classes: int


class Code(eqx.Module):
    """The classes of K categorical variables; as a vector, one-hot rows of C, one after another."""

    index: Int[Array, "*b K"]
    """The class of each; C where there is none, before an episode's first row."""
    tilt: Float[Array, "*b K C"] | None
    """Zeros, through which a loss moves the probabilities that `index` was drawn from as if the
    one-hot rows were these (straight-through); None where no gradient is wanted."""
    n_classes: int = eqx.field(static=True)

    @classmethod
    def none(cls, shape: CodeShape) -> "Code":
        """No class of any variable: a vector of zeros."""
        index = jnp.full(shape.n_categoricals, shape.n_classes, jnp.int32)
        return cls(index, jnp.zeros(shape), shape.n_classes)

    @property
    def shape(self) -> CodeShape:
        """K and C."""
        return CodeShape(self.index.shape[-1], self.n_classes)

    def onehot(self) -> Float[Array, "*b KC"]:
        """As a vector."""
        rows = jax.nn.one_hot(self.index, self.n_classes)
        return flatten(rows if self.tilt is None else rows + self.tilt)

    def times(self, weight: Float[Array, "K C O"]) -> Float[Array, "*b O"]:
        """The vector times a matrix whose rows `weight` holds by variable and class."""
        if jax.default_backend() != "cpu":
            return product(self.onehot(), weight.reshape(-1, weight.shape[-1]))
        total = _sum_of_rows(self.index, weight)
        if self.tilt is None:
            return total
        return total + _gradient_alone(self.tilt, jax.lax.stop_gradient(weight))

    def ravel(self) -> "Code":
        """Codes of several agents as one."""
        tilt = None if self.tilt is None else self.tilt.reshape(-1, self.n_classes)
        return Code(self.index.ravel(), tilt, self.n_classes)


def still(tree: Tree) -> Tree:
    """The same without a way for gradients through codes."""

    def stop(x: Any) -> Any:
        return Code(x.index, None, x.n_classes) if isinstance(x, Code) else x

    return jax.tree.map(stop, tree, is_leaf=lambda x: isinstance(x, Code))


def _sum_of_rows(index: Int[Array, "*b K"], weight: Float[Array, "K C O"]) -> Float[Array, "*b O"]:
    """`weight[k, index[k]]` summed over k; nothing where the index is C.

    Variable by variable: one gather of all rows is slower than the dense product on a CPU, and so
    is its gradient's scatter.
    """

    def add(total: Array, of: tuple[Array, Array]) -> tuple[Array, None]:
        rows, which = of
        return total + rows.at[which].get(mode="fill", fill_value=0), None

    start = jnp.zeros((*index.shape[:-1], weight.shape[-1]), weight.dtype)
    return jax.lax.scan(add, start, (weight, jnp.moveaxis(index, -1, 0)))[0]


@jax.custom_vjp
def _gradient_alone(
    tilt: Float[Array, "*b K C"], weight: Float[Array, "K C O"]
) -> Float[Array, "*b O"]:
    """Zeros: `tilt` times `weight`, of which only the gradient towards `tilt` is computed."""
    shape = (*tilt.shape[:-2], weight.shape[-1])
    either = jnp.broadcast_to(tilt[..., 0, :1], shape) + jnp.broadcast_to(weight[0, 0], shape)
    return _zeros(either)


def _gradient_alone_fwd(tilt: Array, weight: Array) -> tuple[Array, Array]:
    return _gradient_alone(tilt, weight), weight


def _gradient_alone_bwd(weight: Array, gradient: Array) -> tuple[Array, None]:
    flat = product_with_transposed(gradient, weight.reshape(-1, weight.shape[-1]))
    return rearrange(flat, "... (k c) -> ... k c", c=weight.shape[1]), None


_gradient_alone.defvjp(_gradient_alone_fwd, _gradient_alone_bwd)


def sample_index(probs: Float[Array, "*b C"], key: PRNGKey) -> Int[Array, "*b"]:
    """One class for each leading index, by inverting the distribution function.

    Needs one uniform number a draw, where the Gumbel trick needs C. `probs` need not sum to one.
    """
    # A product with a triangle of ones is six times faster than a cumulative sum on a CPU, unless
    # it is fused with what makes the probabilities.
    triangle = jnp.triu(jnp.ones((probs.shape[-1],) * 2, probs.dtype))
    probs = jax.lax.optimization_barrier(probs)
    cdf = jnp.matmul(probs, triangle, precision=jax.lax.Precision.HIGHEST)
    # Scaling by the last entry keeps rounding from ever pointing past the last class.
    uniform = jax.random.uniform(key, (*probs.shape[:-1], 1)) * cdf[..., -1:]
    return (uniform >= cdf).sum(-1)


def draw(logits: Float[Array, "*b K C"], key: PRNGKey) -> Code:
    """A sample whose gradient is that of the probabilities (straight-through)."""
    probs = _probabilities(jax.lax.stop_gradient(logits))
    return Code(sample_index(probs, key), _tilt(logits), logits.shape[-1])


def _probabilities(logits: Float[Array, "*b K C"]) -> Float[Array, "*b K C"]:
    """Written like this, XLA computes them once for samples, their gradients and the KL."""
    return jnp.exp(jax.nn.log_softmax(logits))


@jax.custom_vjp
def _tilt(logits: Float[Array, "*b K C"]) -> Float[Array, "*b K C"]:
    """p - stop(p): zeros whose gradient is that of the probabilities."""
    return _zeros(logits)


def _tilt_fwd(logits: Array) -> tuple[Array, Array]:
    return _zeros(logits), _probabilities(logits)


def _tilt_bwd(probs: Array, gradient: Array) -> tuple[Array]:
    weighted = probs * gradient
    return (weighted - probs * weighted.sum(-1, keepdims=True),)


_tilt.defvjp(_tilt_fwd, _tilt_bwd)


def _zeros(like: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Zeros that have a batch axis where `like` has one: `vmap` would not see it in a constant, and
    gradients, which take the shape of what they are of, would be summed over it."""
    return jnp.where(False, like, 0.0)


def flatten(z: Float[Array, "*b K C"]) -> Float[Array, "*b KC"]:
    """Rows of C, one after another."""
    return rearrange(z, "... k c -> ... (k c)")


def unflatten(logits: Float[Array, "*b KC"], n_classes: int) -> Float[Array, "*b K C"]:
    """A network's output as K rows of C logits."""
    return rearrange(logits, "... (k c) -> ... k c", c=n_classes)
