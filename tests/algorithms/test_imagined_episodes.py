"""Imagined episodes by hand: a model that counts, ends when told, and pays what it has counted."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from mabl.algorithms.imagined_episodes import compare_episodes, imagine_episode
from mabl.envs.counting import CountingEnv
from mabl.imagination import Imagined
from mabl.world_models.heads import Predictions

N_AGENTS = 2


class Counting:
    """A dream whose latent counts steps; the reward is the count, agents differ by one each way."""

    def __init__(self, ends_at: int):
        self.ends_at = ends_at

    def act(self, state, key):
        return jnp.zeros(N_AGENTS, int), jnp.zeros(N_AGENTS)

    def step(self, state, action, key):
        latent = state.latent + 1
        predicted = SimpleNamespace(reward=latent + jnp.array([-1.0, 1.0]), latent=latent)
        return state._replace(latent=latent), predicted

    def continues(self, predicted: Predictions):
        return jnp.full(N_AGENTS, 1.0) * (predicted.latent != self.ends_at)


def states(shape):
    everyone = jnp.ones((*shape, N_AGENTS), bool)
    return Imagined(jnp.zeros(shape), everyone, everyone)


@pytest.mark.parametrize(
    ("ends_at", "limit", "expected"),
    [(3, 10, (1 + 2 + 3, 3, 3, True)), (3, 3, (6, 3, 3, True)), (3, 2, (3, 2, 2, False))],
)
def test_an_episode_ends_where_the_model_says_or_at_the_limit(ends_at, limit, expected):
    played = imagine_episode(Counting(ends_at), states(()), limit, jax.random.key(0))  # pyright: ignore
    assert tuple(x.item() for x in played) == expected


def rows_of(is_first, reward, score):
    _, row = CountingEnv().reset(jax.random.key(0))
    rows = jax.tree.map(lambda x: jnp.broadcast_to(x, (1, len(is_first), *x.shape)), row)
    score = jnp.array([score])
    ended = jnp.broadcast_to(~jnp.isnan(score)[..., None], rows.terminated.shape)
    reward = jnp.broadcast_to(jnp.array([reward])[..., None], rows.reward.shape)
    return rows._replace(
        is_first=jnp.array([is_first]), reward=reward, score=score, terminated=ended
    )


def compared(rows, ends_at, first=0):
    at = states(rows.is_first.shape)
    at = at._replace(latent=jnp.where(rows.is_first, first, 100.0))  # only first rows can end
    dream = Counting(ends_at)
    told = compare_episodes(dream, at, rows, 10, 2.0, jax.random.key(0))  # pyright: ignore
    return {name.removeprefix("behaviour/imagined_"): value.item() for name, value in told.items()}


@pytest.mark.parametrize(("ends_at", "wins"), [(3, 0.0), (4, 1.0), (20, 0.0)])
def test_episodes_begin_at_first_rows_and_win_by_their_last_reward(ends_at, wins):
    nan = jnp.nan
    # A win pays 6, a loss 1: what pays more than 3.5 in the end is a win, if it ends at all.
    rows = rows_of([False, True, False, True], [6.0, 9.0, 1.0, 9.0], [1.0, nan, 0.0, nan])
    told = compared(rows, ends_at)
    length = min(ends_at, 10)
    assert told["episode_return"] == sum(range(length + 1)) / 2  # reward scale 2
    assert told["episode_length"] == length
    assert told["win_rate"] == wins


def test_without_first_rows_or_both_kinds_of_ends_there_is_no_number():
    nan = jnp.nan
    only_losses = rows_of([True, False], [0.0, 1.0], [nan, 0.0])
    told = compared(only_losses, 3)
    assert told["episode_length"] == 3 and jnp.isnan(told["win_rate"])
    nothing_begins = rows_of([False, False], [0.0, 1.0], [1.0, 0.0])
    assert all(jnp.isnan(value) for value in compared(nothing_begins, 3).values())
