"""What is filmed is what is played: same episodes, one picture a row, ends that can be read."""

import ctypes
import sys
from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

from mabl.envs import mamujoco, registry
from mabl.envs.counting_host import HostCountingEnv
from mabl.envs.host import Hosted
from mabl.errors import UserError
from mabl.evaluation import baseline, evaluate
from mabl.playing import FRAMES_PER_SECOND, film, show_of

KEY = jax.random.key(3)


class Drawn(HostCountingEnv):
    """Its pictures are as bright as its clock."""

    spec = replace(HostCountingEnv.spec, name="test/drawn")
    made = 0

    def __init__(self, picture=None):
        super().__init__()
        self.picture, self.closed = picture, False
        Drawn.last = self

    def reset(self, seed):
        return self.keep(super().reset(seed))

    def step(self, action):
        return self.keep(super().step(action))

    def keep(self, row):
        self.t = row.state[0]
        return row

    def render(self):
        if self.picture is not None:
            return self.picture() if callable(self.picture) else self.picture
        return np.full((4, 6, 3), self.t, np.uint8)

    def close(self):
        self.closed = True


def filmed(env, episodes=1, executor=None):
    outcomes = []
    with show_of(env) as show:
        executor = executor or baseline("random", env)
        frames = list(film(show, executor, KEY, episodes, outcomes.append))
    return show, frames, outcomes


def test_compiled_episodes_are_those_that_evaluation_plays():
    env = registry.make("smax/3m")
    allies = env.heuristic()
    show, frames, outcomes = filmed(env, 3, allies)
    counted = evaluate(env, allies, KEY, 3)
    np.testing.assert_allclose([o.episode_return for o in outcomes], counted.episode_return, 1e-5)
    np.testing.assert_array_equal([o.length for o in outcomes], counted.length)
    np.testing.assert_array_equal([o.score for o in outcomes], counted.score)
    assert len(frames) == sum(1 + 4 * o.length + show.frames_per_second for o in outcomes)


def test_hosted_episodes_are_a_picture_a_row_and_stand_still_at_their_ends():
    show, frames, outcomes = filmed(Hosted(Drawn.spec, Drawn), 2)
    assert show.frames_per_second == FRAMES_PER_SECOND
    shown = [frame[0, 0, 0] for frame in frames]
    expected = []
    for outcome in outcomes:
        expected += [*range(outcome.length + 1), *[outcome.length] * 10]
    assert shown == expected and Drawn.last.closed
    one, other = outcomes
    assert one.length > 0 and np.isfinite([*one, *other]).all()
    assert one.episode_return != other.episode_return  # seeds differ


def test_what_draws_is_made_to_draw():
    drawn = partial(Drawn, picture=np.zeros((5, 5, 4), np.uint8))
    _, frames, _ = filmed(Hosted(Drawn.spec, HostCountingEnv, drawn))
    assert frames[0].shape == (5, 5, 3)


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (registry.make("test/counting"), "draws nothing"),
        (Hosted(HostCountingEnv.spec, HostCountingEnv), "draws nothing"),
        (Hosted(Drawn.spec, partial(Drawn, np.zeros(3))), r"drew something of shape \(3,\)"),
        (Hosted(Drawn.spec, HostCountingEnv, lambda: 1 / 0), "while it was filmed: ZeroDiv"),
        (
            Hosted(Drawn.spec, partial(Drawn, lambda: 1 / 0)),
            "failed while it was filmed: ZeroDivisionError",
        ),
    ],
)
def test_what_cannot_be_seen_says_so(env, message):
    with pytest.raises(UserError, match=message):
        filmed(env)


def test_a_parallel_environment_draws_at_its_own_pace():
    pytest.importorskip("mpe2")
    env = registry.make("pettingzoo:mpe2.simple_spread_v3:parallel_env", ("max_cycles=3",))
    show, frames, _ = filmed(env)
    assert show.frames_per_second == 10 and len(frames) == 4 + 10
    assert frames[0].shape == (700, 700, 3) and (frames[0] != frames[3]).any()


def test_mujoco_without_opengl_names_the_package(monkeypatch):
    pytest.importorskip("gymnasium_robotics")
    for name in ("DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(mamujoco, "OPENGL", {"osmesa": ("libNothing.so",)})
    with pytest.raises(UserError, match="apt install libosmesa6"):
        filmed(registry.make("mamujoco/Humanoid"))


def test_mujoco_draws_without_a_display(monkeypatch):
    pytest.importorskip("gymnasium_robotics")
    try:
        ctypes.CDLL("libOSMesa.so.8")
    except OSError:
        pytest.skip("needs libosmesa6")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("MUJOCO_GL", "")
    show, frames, outcomes = filmed(registry.make("mamujoco/Humanoid"))
    assert show.frames_per_second == 67
    assert len(frames) == 1 + outcomes[0].length + 67
    assert frames[0].std() > 10
