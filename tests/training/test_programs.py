"""Programs are shared by runs that compute the same, and by no others."""

from dataclasses import replace

import jax
import pytest
from tests.tiny import tiny

from mabl.algorithms import registry as algorithms
from mabl.algorithms.presets import preset
from mabl.envs import registry as envs
from mabl.runs.checkpoint import named
from mabl.runs.folder import read_config, write_config
from mabl.training.programs import programs

CONFIG = tiny("mabl")


def test_runs_that_differ_in_seed_length_or_folder_share_them():
    assert programs(CONFIG) is programs(replace(CONFIG, seed=3, total_steps=99, logdir="other"))


def test_other_settings_or_another_number_of_seeds_have_their_own():
    for other in (replace(CONFIG, num_seeds=2), tiny("mabl-sg"), tiny("mabl", "test/counting")):
        assert programs(other) is not programs(CONFIG)


def test_what_is_registered_anew_under_a_name_has_its_own(monkeypatch):
    before = programs(CONFIG)
    peer = algorithms.entry("mabl-sg")
    monkeypatch.setitem(algorithms.ALGORITHMS, "mabl", peer)
    assert type(model_of(programs(CONFIG))) is not type(model_of(before))
    monkeypatch.undo()
    assert programs(CONFIG) is before
    family = envs.FAMILIES["test"]
    monkeypatch.setitem(envs.FAMILIES, "test", lambda: family())
    assert programs(CONFIG) is not before


def model_of(run):
    """The world model that a run starts with, as shapes."""
    return jax.eval_shape(run.training.init, jax.random.key(0)).learner.model


@pytest.mark.parametrize("algo", algorithms.ALGORITHMS)
def test_a_run_folder_gives_back_the_programs(algo, tmp_path):
    """What an algorithm does not read is not written down, and makes no difference."""
    config = preset("quick", "test/coordination", algo)
    write_config(tmp_path, config)
    assert programs(read_config(tmp_path)) is programs(config)


@pytest.mark.parametrize("env", ["test/counting", "test/aiming", "smax/3m"])
def test_first_states_have_no_weak_types(env):
    """No checkpoint keeps them, so a resumed run would be traced anew."""
    training = programs(preset("quick", env, "mappo")).training
    state = jax.eval_shape(training.init, jax.random.key(0))
    assert not [name for name, leaf in named(state) if getattr(leaf, "weak_type", False)]
