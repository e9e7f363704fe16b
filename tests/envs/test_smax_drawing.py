"""Pictures of battles show who is where, who is hurt, and who shoots at whom."""

from itertools import pairwise

import jax
import numpy as np
import pytest
from PIL import ImageColor

from mabl.envs import registry
from mabl.envs.smax_drawing import (
    GROUND,
    HEADER,
    HEALTH,
    HEALTH_LOST,
    LABELS,
    PICTURES,
    SCALE,
    TEAMS,
    VISION,
    WALL,
    _units,
)


def battle(name, n_steps, seed=0):
    """States of a battle between two heuristics, as numpy."""
    env = registry.make(name)
    allies = env.heuristic()
    act, step = jax.jit(allies.act), jax.jit(env.step)
    state, row = jax.jit(env.reset)(jax.random.key(seed))
    memory, states = allies.initial(row), [state]
    for key in jax.random.split(jax.random.key(seed + 1), n_steps):
        memory, action = act(memory, row, key)
        state, row = step(key, state, action)
        states.append(state)
        if row.terminated.all():
            break
    return env, jax.device_get(states)


@pytest.fixture(scope="module")
def fought():
    return battle("smax/2s3z", 60)


def pixel(frame, position, shift=(0.0, 0.0)):
    """The colour at a place of the map, so many pixels beside it."""
    x, y = position * SCALE
    return tuple(frame[int(HEADER + 32 * SCALE - y + shift[1]), int(x + shift[0])])


def rgb(colour):
    return ImageColor.getrgb(colour)


def test_who_is_shot_at_is_who_is_hurt(fought):
    env, states = fought
    drawing, seen = env.drawing(), 0
    for old, new in pairwise(states):
        shots = drawing._shots(old.game, new.game)
        seen += len(shots)
        hurt = np.flatnonzero(new.game.unit_health < old.game.unit_health)
        assert {target for _, target in shots} == set(hurt.tolist())
        for shooter, target in shots:
            assert old.game.unit_alive[shooter]
            assert (shooter < 5) != (target < 5)
    assert seen > 20


def test_a_step_is_several_pictures_between_its_ends(fought):
    env, states = fought
    drawing = env.drawing()
    (first,) = drawing.frames(None, states[0])
    assert first.shape == (32 * SCALE + HEADER, 32 * SCALE, 3) and first.dtype == np.uint8
    frames = list(drawing.frames(states[0], states[1]))
    assert len(frames) == PICTURES
    for before, after in zip([first, *frames], frames, strict=False):
        assert (before != after).any()
    (end,) = drawing.frames(None, states[1])
    np.testing.assert_array_equal(frames[-1], end)


def test_units_lie_where_they_are_in_the_colours_of_their_teams(fought):
    env, states = fought
    game = states[0].game
    (frame,) = env.drawing().frames(None, states[0])
    for i, position in enumerate(game.unit_positions):
        radius = float(env.game.unit_type_radiuses[game.unit_types[i]]) * SCALE
        assert pixel(frame, position, (0, 0.7 * radius)) == rgb(TEAMS[i >= 5])
        assert pixel(frame, position, (0, -radius - 4)) == rgb(HEALTH)
    assert pixel(frame, np.array([0.5, 31.0])) == rgb(GROUND)
    assert pixel(frame, game.unit_positions[0], (0, -8 * SCALE)) == rgb(VISION)


def test_the_hurt_have_shorter_bars_and_the_dead_none(fought):
    env, states = fought
    last = next(s for s in states if not s.game.unit_alive.all())
    (frame,) = env.drawing().frames(None, last)
    (whole,) = env.drawing().frames(None, states[0])

    def count(picture, colour):
        return (picture == rgb(colour)).all(-1).sum()

    assert count(frame, HEALTH) < count(whole, HEALTH)
    assert count(frame, HEALTH_LOST) > count(whole, HEALTH_LOST) == 0


@pytest.mark.parametrize("name", ["smax/3m", "smax/2s_vs_1sc", "smax/corridor"])
def test_every_kind_of_unit_has_its_label(name):
    labels = registry.make(name).drawing()._labels
    assert set(labels) <= set(LABELS.values()) and len(set(labels)) == len(labels)


def test_walls_are_seen():
    env, states = battle("smax/corridor", 0)
    (frame,) = env.drawing().frames(None, states[0])
    assert pixel(frame, np.array([15.0, 5.0])) == rgb(WALL) != pixel(frame, np.array([15.0, 16.0]))


def test_the_header_says_how_it_stands(fought):
    env, states = fought
    drawing = env.drawing()
    game = states[-1].game
    allies, clock, enemies = drawing._says(game, _units(game))
    assert f"step {int(game.step)} of 120" in clock
    assert clock.endswith("won" if game.unit_alive[:5].any() else "lost")
    assert allies.startswith(f"allies {game.unit_alive[:5].sum()} of 5, health")
    assert enemies.startswith(f"enemies {game.unit_alive[5:].sum()} of 5, health")
