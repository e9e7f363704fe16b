"""A running mean and variance, to learn targets of whatever size [46]."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Normaliser(NamedTuple):
    """Exponential averages of values and of their squares, corrected for starting at nothing."""

    mean: Float[Array, ""]
    mean_square: Float[Array, ""]
    weight: Float[Array, ""]
    """How much has been seen; 1 in the long run."""

    @classmethod
    def fresh(cls) -> "Normaliser":
        """Before any value: it changes nothing."""
        return cls(jnp.float32(0), jnp.float32(0), jnp.float32(0))

    def update(
        self, values: Float[Array, "*b"], weights: Float[Array, "*b"], decay: float
    ) -> "Normaliser":
        """After a batch of values that count as their weights say; `decay` of what was remains.

        A batch in which nothing counts changes nothing.
        """
        decayed = jnp.where(weights.sum() > 0, decay, 1.0)
        total = weights.sum() + 1e-8
        mean = (weights * values).sum() / total
        mean_square = (weights * values**2).sum() / total
        old = (self.mean, self.mean_square, self.weight)
        new = (mean, mean_square, jnp.float32(1))
        return Normaliser(*(decayed * a + (1 - decayed) * b for a, b in zip(old, new, strict=True)))

    def moments(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Mean and standard deviation (0.1 at least; 0 and 1 before any value)."""
        weight = jnp.maximum(self.weight, 1e-8)
        mean = self.mean / weight
        variance = jnp.maximum(self.mean_square / weight - mean**2, 1e-2)
        return mean, jnp.where(self.weight > 0, jnp.sqrt(variance), 1.0)

    def normalise(self, values: Float[Array, "*b"]) -> Float[Array, "*b"]:
        """Zero mean and unit variance, as far as is known."""
        mean, std = self.moments()
        return (values - mean) / std

    def restore(self, values: Float[Array, "*b"]) -> Float[Array, "*b"]:
        """The inverse of `normalise`."""
        mean, std = self.moments()
        return values * std + mean
