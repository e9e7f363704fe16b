"""What flows through the house beside rows: what was imagined, and what learning to act sees.

Axes: T time, B batch, N agents, H horizon, O observation, S state, A action, D deterministic,
K categoricals, C classes.
"""

from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float, Key, Shaped

from mabl.rows import TimeStep

PRNGKey = Key[Array, ""]
Progress = Float[Array, ""] | float
"""Share of a run's environment steps that are done, in [0, 1]."""


class TeamView(NamedTuple):
    """What learning to act sees of a latent."""

    actor_features: Any
    """`[*b, N, ...]`, in parts (`nets.mlp.Features`): what each agent's policy sees, in execution,
    too."""
    critic_features: Any
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
