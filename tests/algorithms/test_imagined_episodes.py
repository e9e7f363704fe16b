"""Imagined episodes by hand: a model that counts, ends when told, and pays what it has counted."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from mabl.algorithms.imagined_episodes import imagine_episode, imagined_episodes
from mabl.imagination import Imagined

N_AGENTS = 2


class Counting:
    """A dream whose latent counts steps; the reward is the count, agents differ by one each way.

    After steps 2 and 4 episodes end with probabilities 1/4 and 1; there they are won with
    probabilities 1 and 1/2.
    """

    predicts_wins = True

    def act(self, state, key):
        return jnp.zeros(N_AGENTS, int), jnp.zeros(N_AGENTS)

    def step(self, state, action, key):
        count = state.latent + 1
        win = jnp.broadcast_to(jnp.where(count == 2, 99.0, 0.0), N_AGENTS)
        predicted = SimpleNamespace(
            reward=count + jnp.array([-1.0, 1.0]),
            count=count,
            win=win if self.predicts_wins else None,
        )
        return state._replace(latent=count), predicted

    def continues(self, predicted):
        count = predicted.count
        return jnp.broadcast_to(jnp.where(count == 2, 0.75, 1.0 * (count != 4)), N_AGENTS)


class Unscored(Counting):
    predicts_wins = False


class OneGoesOn(Counting):
    """Agent 0 ends at once, agent 1 as they all do in `Counting`."""

    def continues(self, predicted):
        return super().continues(predicted) * jnp.array([0.0, 1.0])


def states(shape):
    everyone = jnp.ones((*shape, N_AGENTS), bool)
    return Imagined(jnp.zeros(shape), everyone, everyone)


# Steps 1 and 2 are always taken, steps 3 and 4 with probability 3/4.
WHOLE = 1 + 2 + 0.75 * (3 + 4), 2 + 0.75 * 2, 0.25 * 1 + 0.75 / 2


@pytest.mark.parametrize(
    ("limit", "reached", "told"),
    [(10, 0, WHOLE), (4, 0, WHOLE), (3, 0.75, (1 + 2 + 0.75 * 3, 2.75, 0.25)), (1, 1, (1, 1, 0))],
)
def test_steps_count_with_the_probability_that_they_are_reached(limit, reached, told):
    played = imagine_episode(Counting(), states(()), limit, jax.random.key(0))  # pyright: ignore
    assert [x.item() for x in played] == pytest.approx([reached, *told])


def test_an_episode_ends_when_the_last_agent_has_ended():
    start, key = states(()), jax.random.key(0)
    played = [imagine_episode(dream(), start, 10, key) for dream in (Counting, OneGoesOn)]  # pyright: ignore
    assert played[0] == played[1]


def told(dream, is_first):
    at = states(is_first.shape)
    at = at._replace(latent=jnp.where(is_first, 0.0, 100.0))  # from others no end is reached
    metrics = imagined_episodes(dream, at, is_first, 10, 2.0, jax.random.key(0))
    return {k.removeprefix("behaviour/imagined_"): v.item() for k, v in metrics.items()}


def test_episodes_begin_at_first_rows_and_rewards_are_the_environments():
    seen = told(Counting(), jnp.array([[False, True], [False, True]]))
    episode_return, length, won = WHOLE
    expected = {"episode_return": episode_return / 2, "episode_length": length, "win_rate": won}
    assert seen == pytest.approx(expected)
    assert told(Unscored(), jnp.array([[True]]))["win_rate"] == 0


def test_without_first_rows_there_is_no_number():
    assert all(jnp.isnan(value) for value in told(Counting(), jnp.zeros((1, 2), bool)).values())
