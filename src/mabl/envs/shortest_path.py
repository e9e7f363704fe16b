"""Flatland's baseline: every train takes the way that is shorter, whoever else is on it."""

import jax.numpy as jnp
from jaxtyping import Array, Int

from mabl.envs.rails import EDGE_FEATURES, GAINED, ROOT_FEATURES
from mabl.rows import TimeStep
from mabl.types import PRNGKey


class ShortestPath:
    """Reads it from the observation: by how much the target is nearer on each of the two ways."""

    def initial(self, row: TimeStep) -> None:
        """It remembers nothing."""

    def act(self, memory: None, row: TimeStep, key: PRNGKey) -> tuple[None, Int[Array, " N"]]:
        """The joint action at a row; never a stop."""
        left, right = (
            row.obs[:, ROOT_FEATURES + edge * EDGE_FEATURES + GAINED] for edge in range(2)
        )
        return None, (row.available[:, 1] & (right > left)).astype(jnp.int32)
