"""Running mean and variance, to learn inputs and targets of any size [46]."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Normaliser(NamedTuple):
    """Exponentially weighted mean and variance of all values so far: of a number, or by feature.

    The variance is kept itself: from a mean of squares nothing is left of it in float32 where the
    mean is a few thousand times larger than the deviation.
    """

    mean: Float[Array, "*f"]
    variance: Float[Array, "*f"]
    weight: Float[Array, ""]
    """How much has been seen; 1 in the long run."""

    @classmethod
    def fresh(cls, *shape: int) -> "Normaliser":
        """Before any value: it changes nothing."""
        return cls(jnp.zeros(shape), jnp.zeros(shape), jnp.float32(0))

    def update(
        self, values: Float[Array, "*bf"], weights: Float[Array, "*b"], decay: float
    ) -> "Normaliser":
        """After a batch of values that count as their weights say; `decay` of what was remains.

        A batch in which nothing counts changes nothing.
        """
        batch = tuple(range(weights.ndim))
        seen = weights.sum() > 0
        total = weights.sum() + 1e-8
        weights = weights.reshape(*weights.shape, *[1] * self.mean.ndim)
        mean = (weights * values).sum(batch) / total
        variance = (weights * (values - jnp.broadcast_to(mean, values.shape)) ** 2).sum(
            batch
        ) / total
        weight = decay * self.weight + (1 - decay)
        share = (1 - decay) / jnp.maximum(weight, 1e-8)  # of the batch in all that counts
        shift = mean - self.mean
        after = Normaliser(
            self.mean + share * shift,
            (1 - share) * (self.variance + share * shift**2) + share * variance,
            weight,
        )
        return Normaliser(*(jnp.where(seen, a, b) for a, b in zip(after, self, strict=True)))

    def moments(self) -> tuple[Float[Array, "*f"], Float[Array, "*f"]]:
        """Mean and standard deviation (0.1 at least; 0 and 1 before any value)."""
        std = jnp.sqrt(jnp.maximum(self.variance, 1e-2))
        return self.mean, jnp.where(self.weight > 0, std, 1.0)

    def normalise(self, values: Float[Array, "*bf"]) -> Float[Array, "*bf"]:
        """Zero mean and unit variance, as far as is known."""
        mean, std = (jnp.broadcast_to(x, values.shape) for x in self.moments())
        return (values - mean) / std

    def restore(self, values: Float[Array, "*bf"]) -> Float[Array, "*bf"]:
        """The inverse of `normalise`."""
        mean, std = (jnp.broadcast_to(x, values.shape) for x in self.moments())
        return values * std + mean
