"""What an environment is to the rest of the house. This module does not import jax: see `rows`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from mabl.rows import TimeStep

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Shaped

    from mabl.types import PRNGKey

EnvState = Any


@dataclass(frozen=True)
class Discrete:
    """Actions 0 .. n-1, one int32 per agent."""

    n: int

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one agent's action."""
        return ()

    @property
    def dtype(self) -> type[np.generic]:
        """Of an action."""
        return np.int32

    @property
    def size(self) -> int:
        """Length of an encoded action, A."""
        return self.n

    def encode(self, action: Shaped[Array, "*b"]) -> Float[Array, "*b A"]:
        """One-hot vectors: what networks see of an action."""
        import jax

        return jax.nn.one_hot(action, self.n)


@dataclass(frozen=True)
class Continuous:
    """Vectors of length `size` in [-1, 1]; the adapter rescales to the environment's own bounds."""

    size: int

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one agent's action."""
        return (self.size,)

    @property
    def dtype(self) -> type[np.generic]:
        """Of an action."""
        return np.float32

    def encode(self, action: Float[Array, "*b A"]) -> Float[Array, "*b A"]:
        """The action itself."""
        return action


ActionSpace = Discrete | Continuous


@dataclass(frozen=True)
class EnvSpec:
    """Sizes and names of an environment, known before it runs."""

    name: str
    n_agents: int
    obs_dim: int
    state_dim: int
    action_space: ActionSpace
    episode_limit: int
    """Joint steps after which an episode is truncated."""
    score_name: str
    """What `TimeStep.score` means, e.g. `win_rate`: its mean over episodes is logged so."""
    agent_ids: tuple[str, ...] = ()
    """Names of the agents, if they have any."""
    obs_dims: tuple[int, ...] = ()
    """Each agent's own number of observation features, where they differ; the rest is padding."""
    action_dims: tuple[int, ...] = ()
    """Each agent's own number of actions, where they differ; the rest is never available."""

    @property
    def scores_wins(self) -> bool:
        """Whether scores are 1 for a win and 0 otherwise, also where a limit cuts the episode."""
        return self.score_name == "win_rate"


@runtime_checkable
class Drawing(Protocol):
    """Pictures of a compiled environment, one or several for each joint step."""

    frames_per_second: float

    def frames(self, before: EnvState | None, after: EnvState) -> Iterator[np.ndarray]:
        """uint8 `[height, width, 3]`; `before` is None after a reset."""
        ...


class CompiledEnv(Protocol):
    """A pure environment that runs inside jit. It never resets itself.

    Rows that it returns have no leading axes; callers vmap over environments. It may have
    `drawing() -> Drawing`.
    """

    @property
    def spec(self) -> EnvSpec:
        """Sizes and names."""
        ...

    def reset(self, key: PRNGKey) -> tuple[EnvState, TimeStep]:
        """Start an episode; the row has `is_first` set, zero `prev_action` and zero reward."""
        ...

    def step(
        self, key: PRNGKey, env_state: EnvState, action: Shaped[Array, "N ..."]
    ) -> tuple[EnvState, TimeStep]:
        """Take one joint step. Undefined after a row for which `is_last` holds."""
        ...
