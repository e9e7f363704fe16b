"""SMAC's interface, through a fake that answers and refuses as the official one does."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.tiny import learn_a_cycle

from mabl.algorithms.presets import preset
from mabl.envs import registry, smac
from mabl.envs.base import Discrete
from mabl.envs.pool import RESET, STEP
from mabl.envs.workers import open_pool
from mabl.errors import UserError

OWN = "smac:tests.envs.fake_smac"
ALL_TYPES = pytest.mark.parametrize("kind", ["FakeSMAC", "Cousin", "Lite"])
STAY, MOVE, ATTACK = [1, 1, 1], [2, 1, 1], [3, 4, 5]


def opened(kind, *kwargs):
    given = (*kwargs, "episode_limit=6") if kind == "Lite" else kwargs
    return registry.make(f"{OWN}:{kind}", given).make()


def play(env, *joint_actions):
    row = env.reset(0)
    for action in joint_actions:
        row = env.step(np.array(action, np.int32))
    return row


@ALL_TYPES
def test_rows_say_what_the_battle_said(kind):
    env = opened(kind)
    spec = env.spec
    assert (spec.n_agents, spec.obs_dim, spec.state_dim) == (3, 4, 5)
    assert (spec.action_space, spec.episode_limit, spec.score_name) == (Discrete(6), 6, "win_rate")
    row = play(env)
    assert row.is_first and not row.prev_action.any() and not row.reward.any()
    row = play(env, MOVE)
    assert_array_equal(row.prev_action, MOVE)
    assert_allclose(row.reward, np.full(3, 4 / 7), rtol=1e-6)
    assert_array_equal(row.obs, [[0, 1, 0, 1], [1, 1, 0, 1], [2, 1, 0, 1]])
    assert_array_equal(row.state, [1, 0, 0, 0, 9])
    assert_array_equal(row.available[1], [0, 1, 1, 0, 1, 0])
    assert row.alive.all() and not row.terminated.any() and not row.truncated
    assert np.isnan(row.score) and not row.is_first


@ALL_TYPES
def test_the_dead_may_do_nothing_and_only_they(kind):
    row = play(opened(kind), STAY, STAY, MOVE)
    assert_array_equal(row.alive, [0, 1, 1])
    assert_array_equal(row.available[0], [1, 0, 0, 0, 0, 0])
    assert not row.obs[0].any()
    assert not row.available[1:, 0].any()


@ALL_TYPES
def test_a_won_battle_and_a_lost_one_are_over(kind):
    won = play(opened(kind), STAY, ATTACK)
    assert won.terminated.all() and not won.truncated and won.score == 1
    lost = play(opened(kind), STAY, STAY, [2, 2, 2])
    assert lost.terminated.all() and not lost.truncated and lost.score == 0
    assert not lost.alive.any()


@ALL_TYPES
@pytest.mark.parametrize("tells", ["true", "false"])  # with continuing_episode info says so
def test_a_time_limit_cuts_an_episode_that_is_not_over(kind, tells):
    env = opened(kind, f"continuing_episode={tells}")
    cut = play(env, *[STAY] * 6)
    assert cut.truncated and not cut.terminated.any() and cut.score == 0
    won = play(env, *[STAY] * 5, ATTACK)
    assert won.terminated.all() and not won.truncated and won.score == 1


@ALL_TYPES
def test_no_limit_is_no_environment(kind):
    if kind == "Lite":
        with pytest.raises(UserError, match="no episode limit: give --env-kwargs episode_limit"):
            registry.make(f"{OWN}:Lite")
    else:
        assert opened(kind, "episode_limit=4").spec.episode_limit == 4


def test_the_first_seed_is_the_games_and_ones_own_is_kept():
    env = opened("FakeSMAC")
    env.reset(2**31 + 5)
    assert env._env.seed == 5
    env.reset(6)
    assert env._env.seed == 5
    env = opened("FakeSMAC", "seed=9")
    env.reset(5)
    assert env._env.seed == 9


def test_a_crashed_game_costs_its_episode():
    pool = open_pool(registry.make(f"{OWN}:FakeSMAC", ("crash_at=2",)), 1, 0, 60.0)
    pool.slots.action[:] = 1
    for command, losses in ((RESET, 0), (STEP, 0), (STEP, 1), (RESET, 0)):
        pool.slots.command[:] = command
        pool.send()
        assert ["the game crashed" in lost.reason for lost in pool.receive()] == [True] * losses


@pytest.mark.parametrize(
    "map_name", ["2s_vs_1sc", "3s_vs_4z", "3s_vs_5z", "corridor", "3s5z_vs_3s6z"]
)
def test_the_paper_preset_of_every_map_learns_for_a_cycle(map_name, monkeypatch):
    """Its schedule, in the fake; networks and batches are small."""
    entry = registry.Entry(lambda: registry.make(f"{OWN}:FakeSMAC"), "")
    monkeypatch.setitem(registry.FAMILIES, "smac", lambda: {f"smac/{map_name}": entry})
    config = preset("paper", f"smac/{map_name}", "mabl")
    assert config.world_model.learning_rate == (5e-4 if map_name == "3s_vs_5z" else 3e-4)
    assert config.training.reward_scale == 1 and config.training.collect_steps is None
    learn_a_cycle(config, replay_capacity=1_000)


@pytest.mark.parametrize(
    ("name", "package"), [("smac/3s_vs_5z", "smac"), ("smacv2/terran_5_vs_5", "smacv2")]
)
def test_what_is_missing_is_said_in_two_lines(name, package, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(UserError) as caught:
        registry.make(name)
    first, second = str(caught.value).splitlines()
    assert first.startswith(f"{name} needs {package}: pip install git+") and "SC2PATH" in second


def test_official_environments_are_made_as_published(monkeypatch, tmp_path):
    monkeypatch.setenv("SC2PATH", str(tmp_path))
    asked = {}

    def record(name, target, options):
        asked.update(target=target, **options)

    monkeypatch.setattr(smac, "make", record)
    registry.make("smac/corridor", ("difficulty=A",))
    assert asked == {
        "target": "smac.env:StarCraft2Env",
        "map_name": "corridor",
        "difficulty": "A",
        "continuing_episode": True,
    }
    registry.make("smacv2/zerg_10_vs_11")
    config = asked["capability_config"]
    assert asked["map_name"] == "10gen_zerg" and (config["n_units"], config["n_enemies"]) == (
        10,
        11,
    )
    assert config["team_gen"]["unit_types"] == ["zergling", "hydralisk", "baneling"]
