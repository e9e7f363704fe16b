"""Where presets differ by map and by algorithm."""

import pytest

from mabl.algorithms.presets import BY_ALGORITHM, BY_ENV, preset
from mabl.envs import registry as envs


@pytest.mark.parametrize(
    ("name", "env", "algo", "learning_rate", "reward_weight"),
    [
        ("paper", "smax/3m", "mabl", 3e-4, 1.0),
        ("paper", "smax/3s_vs_5z", "mabl", 5e-4, 1.0),  # table 4
        ("paper", "smax/3s_vs_5z", "mamba", 2e-4, 1.0),  # its own on every map
        ("quick", "smax/3m", "mabl", 1.3e-3, 1.0),
        ("quick", "smax/3m", "mamba", 1e-3, 1.0),
        ("quick", "smax/2s3z", "mabl", 1e-3, 20.0),
        ("quick", "smax/2s3z", "mamba", 1e-3, 20.0),
    ],
)
def test_maps_and_algorithms_have_their_own(name, env, algo, learning_rate, reward_weight):
    model = preset(name, env, algo).world_model
    assert (model.learning_rate, model.reward_weight) == (learning_rate, reward_weight)


def test_maps_with_settings_of_their_own_exist():
    known = {row.name for row in envs.names()}
    assert {env for _, env in BY_ENV} <= known
    assert {where for _, where, _ in BY_ALGORITHM if "/" in where} <= known
