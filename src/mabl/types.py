"""The rows of data that flow through the house: what happened, and what was imagined.

Time convention (one for the whole project): row t holds the action that led to it, the reward
received on arriving, and everything observed there. A reset is a row of its own; the terminal
observation of an episode is a row of its own and is never overwritten by the next reset.

Axes: T time, B batch, N agents, H horizon, O observation, S state, A action, D deterministic,
K categoricals, C classes.
"""

from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float, Key, Shaped

PRNGKey = Key[Array, ""]


class TimeStep(NamedTuple):
    """Row t of an episode, for the whole team. Leading axes (time, batch) may precede each field.

    Rewards are in the environment's own units unless a caller says that it scaled them.
    """

    prev_action: Shaped[Array, "..."]
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
    """Actions that may be taken at t; at least one is true for every agent, dead ones included."""
    alive: Bool[Array, "*b N"]
    """False for agents that are out of the episode; a loss mask."""
    is_first: Bool[Array, "*b"]
    """True on the row of a reset."""
    score: Float[Array, "*b"]
    """Score of a finished episode (win, share arrived, return) on its last row; NaN before."""


def is_last(row: TimeStep) -> Bool[Array, "*b"]:
    """True where the row ends its episode: every agent terminated, or the episode was truncated."""
    return row.truncated | row.terminated.all(-1)


class TeamView(NamedTuple):
    """What learning to act sees of a latent."""

    actor_features: Float[Array, "*b N F"]
    """What each agent's policy sees: in execution, too."""
    critic_features: Float[Array, "*b N G"]
    """What only training sees: the input of the centralised critic, or of QMIX's mixer."""
    available: Bool[Array, "*b N A"]
    """Actions that may be taken."""
    alive: Bool[Array, "*b N"]
    """Policy losses leave out those that are not (ADR 9)."""


class Trajectory(NamedTuple):
    """Imagined latent trajectories D_L of section 3.3; H rows, H - 1 transitions, a batch axis B.

    Row h of `action` is taken at row h and leads to row h + 1, so that these fields are one row
    shorter than the view.
    """

    view: TeamView
    """`[H, B, N, ...]`; availability and life are real at the start row, then the model's."""
    action: Shaped[Array, "H-1 B N ..."]
    log_prob: Float[Array, "H-1 B N"]
    """log pi(action) at the time of imagination."""
    reward: Float[Array, "H-1 B N"]
    """Predicted reward on arriving at row h + 1, in the replay's units."""
    continues: Float[Array, "H-1 B N"]
    """1 - p(terminated) at row h + 1."""
    weight: Float[Array, "H-1 B N"]
    """How much a row counts: the model's probability that the episode gets there; 0 where the start
    ends an episode."""


class Replayed(NamedTuple):
    """Real sequences `[B, T, ...]` and what learning to act sees of their posterior latents."""

    view: TeamView
    rows: TimeStep


Metrics = dict[str, Any]
"""Flat names such as `world_model/kl_agent` to scalar arrays."""
