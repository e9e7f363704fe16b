"""Warnings about learning that has stalled, from the rows of metrics of a run."""

import math

from mabl.losses.two_hot import MOST
from mabl.runs.metrics import Row

SETTLED_KL, SETTLED_ENTROPY = 1e-3, 0.05
"""KL of a policy update and share of the largest entropy below which a policy does not move."""
SETTLED_SHARE = 0.1
"""Share of the run for which both must hold."""
IDLE_NATS = 0.1
"""KL of the global level below which it carries no information."""
IDLE_STEPS = 10_000
"""Environment steps for which that must hold."""


class Watch:
    """Warn, once for each reason, when a policy or the global latent has stopped working, or when
    rewards are larger than the model can predict."""

    def __init__(self, total_steps: int):
        self._settled = _Since(SETTLED_SHARE * total_steps)
        self._idle = _Since(IDLE_STEPS)
        self._beyond = _Since(0)

    def warnings(self, step: int, row: Row) -> list[str]:
        """Warnings that a cycle's metrics give rise to; `step` is the run's at its end."""
        found = []
        kl = row.get("behaviour/update_kl", math.nan)
        entropy = row.get("behaviour/entropy_share", math.nan)
        if math.isfinite(kl) and math.isfinite(entropy):
            settled = kl < SETTLED_KL and entropy < SETTLED_ENTROPY
            if self._settled.long_enough(step, settled):
                found.append(
                    f"the policy has stopped changing by step {step:,}: for a tenth of the run its "
                    f"updates have had a KL below {SETTLED_KL:g} and its entropy was below "
                    f"{SETTLED_ENTROPY:.0%} of the largest; try a larger entropy bonus"
                )
        beyond = row.get("world_model/rewards_beyond_bins", 0.0) > 0
        if self._beyond.long_enough(step, beyond):
            found.append(
                f"rewards at step {step:,} are larger than the world model can predict: multiplied "
                f"by --training.reward-scale they exceed {MOST:.0f}; give a smaller scale, or "
                "--world-model.reward-loss mse"
            )
        nats = row.get("world_model/kl_global", math.nan)
        if math.isfinite(nats) and self._idle.long_enough(step, nats < IDLE_NATS):
            found.append(
                f"the model's global latent carries no information by step {step:,}: its KL has "
                f"been below {IDLE_NATS:g} nats for {IDLE_STEPS:,} steps; policies learn as with "
                "the agent level alone"
            )
        return found


class _Since:
    """Whether something has held for a number of steps without a break; true once."""

    def __init__(self, steps: float):
        self._steps, self._began, self._told = steps, math.inf, False

    def long_enough(self, step: int, holds: bool) -> bool:
        self._began = min(self._began, step) if holds else math.inf
        if self._told or step - self._began < self._steps:
            return False
        self._told = True
        return True
