"""Lambda-returns along imagined or real trajectories (section 3.3)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def lambda_returns(
    reward: Float[Array, "T *b"],
    discount: Float[Array, "T *b"],
    next_value: Float[Array, "T *b"],
    gae_lambda: float,
) -> Float[Array, "T *b"]:
    """G_t = r_{t+1} + d_{t+1} ((1 - lambda) V_{t+1} + lambda G_{t+1}), with G = V past the end.

    Row t of every argument belongs to the transition from t to t + 1: the reward received on
    arriving, the discount gamma * (1 - terminated) of going on, the value of where it arrived.
    """

    def backward(later: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        reward, discount, value = row
        now = reward + discount * ((1 - gae_lambda) * value + gae_lambda * later)
        return now, now

    _, returns = jax.lax.scan(
        backward, next_value[-1], (reward, discount, next_value), reverse=True
    )
    return returns


def returns_across_resets(
    value: Float[Array, "T *b"],
    reward: Float[Array, "T-1 *b"],
    terminated: Bool[Array, "T-1 *b"],
    is_first: Bool[Array, "T-1 *b"],
    gamma: float,
    gae_lambda: float,
) -> Float[Array, "T-1 *b"]:
    """`lambda_returns` of a sequence of real rows, which may hold several episodes.

    `value` belongs to all rows, the other arguments to the rows that transitions lead to. The
    transition from an episode's last row to a reset hands back the last row's value: truncated
    episodes bootstrap from it, terminated ones have a discount of 0 before it.
    """
    return lambda_returns(
        jnp.where(is_first, value[:-1], reward),
        gamma * (1.0 - (terminated | is_first)),
        value[1:],
        gae_lambda,
    )
