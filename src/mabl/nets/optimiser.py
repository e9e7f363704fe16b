"""Optimisers to which a gradient that is not finite does nothing, but is counted."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int


class Guarded(NamedTuple):
    """State of an optimiser that leaves out what is not finite."""

    inner: optax.OptState
    skipped: Int[Array, ""]
    """Gradients left out so far."""
    in_a_row: Int[Array, ""]
    """Those up to the newest, without a finite one between."""


def guarded(inner: optax.GradientTransformation) -> optax.GradientTransformation:
    """`inner`, which never sees a gradient whose norm is not finite."""

    def init(params: Any) -> Guarded:
        return Guarded(inner.init(params), jnp.int32(0), jnp.int32(0))

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Guarded]:
        good = jnp.isfinite(optax.tree.norm(updates))

        def where(new: Any, old: Any) -> Any:
            return jax.tree.map(lambda new, old: jnp.where(good, new, old), new, old)

        step, after = inner.update(updates, state.inner, params)
        return where(step, optax.tree.zeros_like(step)), Guarded(
            where(after, state.inner),
            state.skipped + ~good,
            jnp.where(good, 0, state.in_a_row + 1),
        )

    return optax.GradientTransformation(init, update)


def guards(tree: Any) -> dict[str, Guarded]:
    """States of such optimisers in a pytree, by path."""

    def is_guard(node: Any) -> bool:
        return isinstance(node, Guarded)

    paths = jax.tree_util.tree_flatten_with_path(tree, is_leaf=is_guard)[0]
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): node
        for path, node in paths
        if is_guard(node)
    }
