"""What a way to learn behaviour in imagination is to the algorithms that contain one."""

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
from einops import rearrange
from jaxtyping import Array, Bool, Float, Int

from mabl.behaviour.actor import Choice
from mabl.devices import spread
from mabl.envs.base import ActionSpace
from mabl.nets.mlp import Features
from mabl.types import Metrics, PRNGKey, Progress, Replayed, TeamView, Trajectory

S = TypeVar("S")
Rows = TypeVar("Rows")


def annealed(start: float, end: float, progress: Progress) -> Float[Array, ""]:
    """A coefficient that falls geometrically from `start` to `end` over the run.

    Where one of them is 0 it falls linearly.
    """
    progress = jnp.clip(jnp.float32(progress), 0, 1)
    if start > 0 and end > 0:
        return start * (end / start) ** progress
    return start + (end - start) * progress


ActorFunction = Callable[[Features, Bool[Array, " A"]], Choice]
"""A policy: one agent's features and available actions to a choice; a pytree of its parameters."""


class Behaviour(Protocol[S]):
    """A way to learn to act from latent trajectories; `S` is all that learning changes.

    It holds its configuration and the sizes of what it sees, nothing that changes.
    """

    def init(self, view: TeamView, space: ActionSpace, key: PRNGKey) -> S:
        """Fresh networks and optimisers for views shaped like `view` `[N, ...]`."""
        ...

    def actor(self, state: S) -> ActorFunction:
        """The policy that acts, in the environment as in imagination."""
        ...

    def critic_features(self, model: Any, latent: Any) -> Features:
        """What of a world model's latent only training sees."""
        ...

    def value(self, state: S, view: TeamView) -> Float[Array, " N"]:
        """What each agent is expected to earn from here, in the replay's units."""
        ...

    def gradient_steps(self, n_rows: int) -> int:
        """Gradient steps of an update from trajectories of `n_rows` joint rows."""
        ...

    def update(
        self,
        state: S,
        trajectory: Trajectory,
        replayed: Replayed,
        key: PRNGKey,
        progress: Progress = 0.0,
    ) -> tuple[S, Metrics]:
        """Learn from trajectories of the present policy, and from the sequences they began in.

        `progress` is the share of the run that is done: schedules depend on it alone.
        """
        ...


def minibatches(key: PRNGKey, n_rows: int, batch_size: int, n_epochs: int) -> Int[Array, "M B"]:
    """Indices of the minibatches of `n_epochs` shuffles of `n_rows`, one after the other.

    A minibatch has all rows if there are fewer than `batch_size`; what is left over of a shuffle
    after full minibatches is left out of that epoch.
    """
    size = min(batch_size, n_rows)

    def shuffled(key: PRNGKey) -> Int[Array, "m B"]:
        order = jax.random.permutation(key, n_rows)[: n_rows // size * size]
        return rearrange(order, "(m b) -> m b", b=size)

    return rearrange(jax.vmap(shuffled)(jax.random.split(key, n_epochs)), "e m b -> (e m) b")


def minibatch_steps(n_rows: int, batch_size: int, n_epochs: int) -> int:
    """Number of the minibatches that `minibatches` makes."""
    return n_epochs * (n_rows // min(batch_size, n_rows))


def divided(key: PRNGKey, n_rows: int, n_parts: int, n_epochs: int) -> Int[Array, "M B"]:
    """Indices of `n_epochs` shuffles of `n_rows`, each divided into `n_parts` of one size.

    The remainder is left out of that epoch; a part has one row at least.
    """
    size = max(n_rows // n_parts, 1)

    def shuffled(key: PRNGKey) -> Int[Array, "m B"]:
        order = jax.random.permutation(key, n_rows)
        return order[jnp.arange(n_parts * size) % n_rows].reshape(n_parts, size)

    return rearrange(jax.vmap(shuffled)(jax.random.split(key, n_epochs)), "e m b -> (e m) b")


def minibatch_of(rows: Rows, index: Int[Array, " B"]) -> Rows:
    """The rows that one of `minibatches` names."""
    return spread(jax.tree.map(lambda x: x[index], rows))
