"""Where presets differ by map and by algorithm."""

from dataclasses import replace

import pytest

from mabl.algorithms.presets import BY_ALGORITHM, BY_ENV, preset
from mabl.algorithms.registry import ALGORITHMS
from mabl.envs import registry as envs
from mabl.errors import UserError


@pytest.mark.parametrize(
    ("name", "env", "algo", "learning_rate", "reward_weight"),
    [
        ("paper", "smax/3m", "mabl", 3e-4, 1.0),
        ("paper", "smax/3s_vs_5z", "mabl", 5e-4, 1.0),  # table 4
        ("paper", "smax/3s_vs_5z", "mamba", 2e-4, 1.0),  # its own on every map
        ("quick", "smax/3m", "mabl", 1e-3, 20.0),
        ("quick", "smax/3m", "mamba", 1e-3, 20.0),
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


def test_one_setting_serves_all_maps_of_smax():
    maps = [row.name for row in envs.names() if row.name.startswith("smax/")]
    for algo in ALGORITHMS:
        settings = {replace(preset("quick", name, algo), env="") for name in maps}
        assert len(settings) == 1, algo


@pytest.mark.parametrize("algo", ["mabl", "mamba", "mappo", "mabl-qmix"])
def test_efficient_is_quick_with_more_learning_for_each_step(algo):
    quick, efficient = (preset(name, "smax/2s3z", algo) for name in ("quick", "efficient"))
    same = {name: getattr(quick, name) for name in ("preset", "total_steps", "training")}
    assert replace(efficient, **same) == quick
    more = {"model_updates": 80, "policy_updates": 32} if algo not in ("mappo",) else {}
    assert efficient.training == replace(quick.training, **more)


def test_a_preset_without_settings_for_a_family_says_which_has_them():
    with pytest.raises(UserError, match="no settings for flatland: give quick or paper"):
        preset("efficient", "flatland/5_agents", "mabl")
