"""Multi-agent MuJoCo, row by row against the library's own environment."""

import numpy as np
import pytest
from gymnasium_robotics import mamujoco_v1
from numpy.testing import assert_allclose, assert_array_equal
from tests.tiny import learn_a_cycle

from mabl.algorithms.presets import preset
from mabl.envs import registry
from mabl.envs.base import Continuous
from mabl.errors import UserError


def symlog(x):
    return np.sign(x) * np.log(1 + np.abs(x))


def test_rows_are_what_the_library_gave():
    hosted = registry.make("mamujoco/Humanoid")
    spec, env = hosted.spec, hosted.make()
    assert (spec.obs_dims, spec.action_dims) == ((236, 167), (9, 8))
    assert spec.obs_dim == 236 + 2 and spec.state_dim == 348
    assert spec.action_space == Continuous(9) and spec.episode_limit == 1000
    bare = mamujoco_v1.parallel_env("Humanoid", "9|8", agent_obsk=0)
    obs, _ = bare.reset(seed=3)
    row, rng = env.reset(3), np.random.default_rng(0)
    for _ in range(5):
        assert_allclose(row.obs[0, :236], symlog(obs["agent_0"]), rtol=1e-4, atol=1e-6)
        assert_allclose(row.obs[1, :167], symlog(obs["agent_1"]), rtol=1e-4, atol=1e-6)
        assert not row.obs[1, 167:236].any()
        assert_array_equal(row.obs[:, 236:], np.eye(2))
        assert_allclose(row.state, symlog(bare.state()), rtol=1e-4, atol=1e-6)
        assert_array_equal(row.available, [[True] * 9, [True] * 8 + [False]])
        action = rng.uniform(-1.5, 1.5, (2, 9)).astype(np.float32)
        row = env.step(action)
        joints = 0.4 * np.clip(action, -1, 1)
        obs, rewards, terminations, *_ = bare.step(
            {"agent_0": joints[0].astype(np.float32), "agent_1": joints[1, :8].astype(np.float32)}
        )
        assert_allclose(row.reward, [rewards["agent_0"]] * 2, rtol=1e-4)
        assert_array_equal(row.terminated, [terminations["agent_0"]] * 2)


def test_falling_terminates_and_time_truncates():
    env = registry.make("mamujoco/Humanoid").make()
    row, steps = env.reset(0), 0
    while not row.terminated.all():
        row, steps = env.step(np.ones((2, 9), np.float32)), steps + 1
        assert not row.truncated
    assert steps < 200
    env = registry.make("mamujoco/HumanoidStandup").make()
    row, total = env.reset(0), 0.0
    for step in range(1, 1001):
        row = env.step(np.zeros((2, 9), np.float32))
        assert not row.terminated.any() and row.truncated == (step == 1000)
        total += row.reward.mean()
    assert row.score == pytest.approx(total, rel=1e-3)


def test_one_leg_each():
    env = registry.make("mamujoco/HumanoidStandup-legs").make()
    assert (env.spec.action_dims, env.spec.obs_dims) == ((10, 7), (239, 164))
    inner = env._env
    parts = [[joint.label for joint in part] for part in inner.agent_action_partitions]
    assert sum("left" in label for label in parts[0]) == 0 and "right_knee" in parts[0]
    assert all(label.startswith("left") for label in parts[1]) and "left_knee" in parts[1]
    joints = [joint.act_ids for part in inner.agent_action_partitions for joint in part]
    assert sorted(joints) == list(range(17))


@pytest.mark.parametrize(
    "name", [row for row in registry.FAMILIES["mamujoco"]() if not row.endswith("Humanoid")]
)
def test_every_split_of_the_library_steps(name):
    hosted = registry.make(name)
    env, spec = hosted.make(), hosted.spec
    row = (
        env.step(np.zeros((spec.n_agents, spec.action_space.size), np.float32))
        if env.reset(0)
        else None
    )
    assert row is not None and np.isfinite(row.obs).all() and np.isfinite(row.state).all()
    assert row.state.shape == (spec.state_dim,) and row.obs.shape == (spec.n_agents, spec.obs_dim)


@pytest.mark.parametrize(
    ("robot", "rates"),
    [
        ("Humanoid", (3e-4, 1e-5, 1e-5)),
        ("HumanoidStandup", (3e-4, 5e-6, 5e-6)),
        ("HumanoidStandup-legs", (3e-4, 5e-6, 5e-6)),
    ],
)
def test_paper_presets_learn_for_a_cycle(robot, rates):
    """Their schedule; networks and batches are small."""
    config = preset("paper", f"mamujoco/{robot}", "mabl")
    mappo, model = config.mappo, config.world_model
    found = mappo.actor_learning_rate, mappo.critic_learning_rate, model.learning_rate
    assert found == rates and config.training.collect_steps is None
    learn_a_cycle(config, replay_capacity=4_000)


def test_without_the_extra_its_name_is_said(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gymnasium_robotics", None)
    with pytest.raises(UserError, match=r"pip install 'mabl\[mujoco\]'"):
        registry.make("mamujoco/Humanoid")
