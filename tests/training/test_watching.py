"""Warnings about stalled learning: once each, and only when something has held long enough."""

import math

import pytest

from mabl.training.watching import Watch

SETTLED = {"behaviour/update_kl": 5e-4, "behaviour/entropy_share": 0.03}
IDLE = {"world_model/kl_global": 0.05}


def told(rows, total_steps=20_000, every=500):
    """Steps at which there was a warning, and the warnings."""
    watch = Watch(total_steps)
    said = [(step * every, watch.warnings(step * every, row)) for step, row in enumerate(rows)]
    return [(step, warning) for step, warnings in said for warning in warnings]


def test_a_policy_that_does_not_move_for_a_tenth_of_the_run_is_told_once():
    ((step, warning),) = told([{}] * 3 + [SETTLED] * 10)
    # It begins at 1,500, and a tenth of 20,000 steps later it is 3,500.
    assert step == 3_500
    assert "the policy has stopped changing by step 3,500" in warning


@pytest.mark.parametrize(
    "moving",
    [
        SETTLED | {"behaviour/update_kl": 2e-3},
        SETTLED | {"behaviour/entropy_share": 0.06},
    ],
)
def test_a_policy_that_moves_or_is_open_now_and_then_is_not(moving):
    assert told([SETTLED, SETTLED, SETTLED, moving] * 5) == []


def test_cycles_without_a_policy_update_neither_count_nor_break():
    nothing = {"behaviour/update_kl": math.nan, "behaviour/entropy_share": math.nan}
    ((step, _),) = told([SETTLED, nothing, {}, SETTLED, SETTLED, SETTLED])
    assert step == 2_000


def test_a_global_latent_without_information_is_told_once():
    ((step, warning),) = told([IDLE] * 40)
    assert step == 10_000 and "global latent carries no information" in warning
    assert told([IDLE] * 15 + [{"world_model/kl_global": 0.2}] + [IDLE] * 15) == []
    assert told([{"world_model/kl_agent": 0.0}] * 40) == []


def test_rewards_larger_than_the_model_can_predict_are_told_once():
    clipped = {"world_model/rewards_beyond_bins": 0.01}
    ((step, warning),) = told([{}, {"world_model/rewards_beyond_bins": 0.0}, clipped, clipped])
    assert step == 1_000
    assert "exceed 147" in warning and "--training.reward-scale" in warning
