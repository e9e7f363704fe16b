"""Where presets differ by map and by algorithm."""

from dataclasses import replace

import pytest

from mabl.algorithms.presets import BY_ALGORITHM, BY_ENV, QUICK, preset
from mabl.algorithms.registry import ALGORITHMS, make
from mabl.envs import registry as envs
from mabl.envs.base import Discrete, EnvSpec
from mabl.errors import UserError


@pytest.mark.parametrize(
    ("name", "env", "algo", "learning_rate", "reward_weight"),
    [
        ("paper", "smax/3m", "mabl", 3e-4, 1.0),
        ("paper", "smax/3s_vs_5z", "mabl", 5e-4, 1.0),  # table 4
        ("paper", "smax/3s_vs_5z", "mamba", 2e-4, 1.0),  # its own on every map
        ("quick", "smax/3m", "mabl", 2e-3, 20.0),
        ("quick", "smax/3m", "mamba", 2e-3, 20.0),
        ("efficient", "smax/3m", "mabl", 2e-3, 20.0),
    ],
)
def test_maps_and_algorithms_have_their_own(name, env, algo, learning_rate, reward_weight):
    model = preset(name, env, algo).world_model
    assert (model.learning_rate, model.reward_weight) == (learning_rate, reward_weight)


def test_maps_with_settings_of_their_own_exist():
    known = {row.name for row in envs.names()}
    assert {env for _, env in BY_ENV} <= known
    assert {family for _, family, _ in BY_ALGORITHM} <= QUICK.keys()


def test_settings_for_an_algorithm_hold_for_families_that_have_none_of_their_own():
    mamba = preset("quick", "smax/3m", "mamba").world_model
    assert preset("quick", "smac/3m", "mamba").world_model == mamba
    assert (mamba.policy_input, mamba.recurrent_sees) == ("decoded", "latent")
    assert preset("quick", "flatland/5_agents", "mamba").world_model.policy_input == "latent"
    mag = preset("quick", "flatland/5_agents", "mag")
    assert mag.lookahead == preset("quick", "smax/3m", "mag").lookahead


@pytest.mark.parametrize("name", ["quick", "efficient"])
def test_one_setting_serves_all_maps_of_smax(name):
    maps = [row.name for row in envs.names() if row.name.startswith("smax/")]
    for algo in ALGORITHMS:
        settings = {replace(preset(name, env, algo), env="") for env in maps}
        assert len(settings) == 1, algo


def test_efficient_does_more_learning_for_each_step_in_world_models_alone():
    def learned(name, algo):
        config = preset(name, "smax/2s3z", algo)
        spec = EnvSpec("stub", 5, 4, 5, Discrete(3), 10, "win_rate")
        algorithm, plan = make(config, spec), config.training
        steps = plan.num_envs * plan.collect_steps
        return (
            plan.model_updates * algorithm.model_rows / steps,
            plan.policy_updates * algorithm.policy_gradient_steps / steps,
        )

    # 18 updates of 320 rows for 256 rows collected; 4 policy updates of 5 epochs of 3,200 rows in
    # minibatches of 800
    assert learned("quick", "mabl") == (22.5, 80 / 256)
    assert learned("efficient", "mabl") == (100.0, 80 / 256)
    assert learned("efficient", "mamba") == (100.0, 80 / 256)
    assert learned("efficient", "qmix") == learned("quick", "qmix") == (0.0, 16 / 256)
    assert learned("efficient", "mappo") == learned("quick", "mappo") == (0.0, 20 / 1024)


def test_a_preset_without_settings_for_a_family_says_which_has_them():
    with pytest.raises(UserError, match="no settings for flatland: give quick or paper"):
        preset("efficient", "flatland/5_agents", "mabl")
