"""The row: what happened to a team at one step, in any environment.

Time convention (one for the whole project): row t holds the action that led to it, the reward
received on arriving, and everything observed there. A reset is a row of its own; the terminal
observation of an episode is a row of its own and is never overwritten by the next reset.

Rows hold jax arrays, or numpy arrays on their way from an environment that runs in Python: this
module does not import jax, which its worker processes do without.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Shaped

Array = Any  # jax's or numpy's


class TimeStep(NamedTuple):
    """Row t of an episode, for the whole team. Leading axes (time, batch) may precede each field.

    Rewards are in the environment's own units unless a caller says that it scaled them.
    """

    prev_action: Shaped[Array, ...]
    """a_{t-1}: int32 `[N]` for discrete actions, float32 `[N, A]` in [-1, 1] for continuous ones;
    zeros on reset rows."""
    reward: Float[Array, "*b N"]
    """r_t, received on arriving at t; zeros on reset rows."""
    terminated: Bool[Array, "*b N"]
    """True where the agent's episode really ended at t; never set by a time limit."""
    truncated: Bool[Array, "*b"]
    """True where a limit cut the episode at t."""
    obs: Float[Array, "*b N O"]
    """o_t of each agent; zeros for the dead."""
    state: Float[Array, "*b S"]
    """s_t, the global state of section 3.1: known in training, never in execution."""
    available: Bool[Array, "*b N A"]
    """Discrete actions that may be taken at t; at least one is true for every agent, dead ones
    included. Of continuous actions, the dimensions that an agent has; none once it is out."""
    alive: Bool[Array, "*b N"]
    """False for agents that are out of the episode; a loss mask."""
    is_first: Bool[Array, "*b"]
    """True on the row of a reset."""
    score: Float[Array, "*b"]
    """Score of a finished episode (win, share arrived, return) on its last row; NaN before."""


def is_last(row: TimeStep) -> Bool[Array, "*b"]:
    """True where the row ends its episode: every agent terminated, or the episode was truncated."""
    return row.truncated | row.terminated.all(-1)
