"""What a way to learn behaviour in imagination is to the algorithms that contain one."""

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from jaxtyping import Array, Bool, Float

from mabl.behaviour.actor import MaskedCategorical
from mabl.types import Metrics, PRNGKey, Replayed, TeamView, Trajectory

S = TypeVar("S")

ActorFunction = Callable[[Float[Array, " F"], Bool[Array, " A"]], MaskedCategorical]
"""A policy: one agent's features and available actions to a choice; a pytree of its parameters."""


class Behaviour(Protocol[S]):
    """A way to learn to act from latent trajectories; `S` is all that learning changes.

    It holds its configuration and the sizes of what it sees, nothing that changes.
    """

    def init(self, view: TeamView, n_actions: int, key: PRNGKey) -> S:
        """Fresh networks and optimisers for views shaped like `view` `[N, ...]`."""
        ...

    def actor(self, state: S) -> ActorFunction:
        """The policy that acts, in the environment as in imagination."""
        ...

    def critic_features(self, model: Any, latent: Any) -> Float[Array, "N G"]:
        """What of a world model's latent only training sees."""
        ...

    def value(self, state: S, view: TeamView) -> Float[Array, " N"]:
        """What each agent is expected to earn from here, in the replay's units."""
        ...

    def update(
        self, state: S, trajectory: Trajectory, replayed: Replayed, key: PRNGKey
    ) -> tuple[S, Metrics]:
        """Learn from trajectories of the present policy, and from the sequences they began in."""
        ...
