"""Diagnostic of the world model: whole imagined episodes, to compare with real ones."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mabl.imagination import Dream, Imagined
from mabl.types import Metrics, PRNGKey

EPISODES = 64
"""Imagined episodes of one diagnosis."""


class Episode(NamedTuple):
    """An imagined episode so far; every step counts with the probability that it is reached."""

    reached: Float[Array, "*b"]
    """Probability that no end was reached yet."""
    total_reward: Float[Array, "*b"]
    """Mean over agents, scaled units."""
    length: Float[Array, "*b"]
    """Joint steps."""
    won: Float[Array, "*b"]
    """Probability of an end that is a win; an episode that the limit cuts is none."""


def imagine_episode(dream: Dream, start: Imagined, limit: int, key: PRNGKey) -> Episode:
    """Play the policy in the model for `limit` steps from one state; the caller vmaps."""

    def advance(
        carry: tuple[Imagined, Episode], key: PRNGKey
    ) -> tuple[tuple[Imagined, Episode], None]:
        state, so_far = carry
        key_action, key_step = jax.random.split(key)
        action, _ = dream.act(state, key_action)
        state, predicted = dream.step(state, action, key_step)
        # An episode ends when all agents have ended, and their ends may coincide.
        goes_on = so_far.reached * dream.continues(predicted).max()
        wins = 0.0 if predicted.win is None else jax.nn.sigmoid(predicted.win).mean()
        after = Episode(
            reached=goes_on,
            total_reward=so_far.total_reward + so_far.reached * predicted.reward.mean(),
            length=so_far.length + so_far.reached,
            won=so_far.won + (so_far.reached - goes_on) * wins,
        )
        return (state, after), None

    fresh = Episode(jnp.ones(()), *jnp.zeros(3))
    return jax.lax.scan(advance, (start, fresh), jax.random.split(key, limit))[0][1]


def imagined_episodes(
    dream: Dream,
    states: Imagined,
    is_first: Bool[Array, "*b"],
    limit: int,
    reward_scale: float,
    key: PRNGKey,
) -> Metrics:
    """Mean return, length and win rate of imagined episodes, in the environment's units.

    They start from `states` `[*b, ...]` that begin an episode, drawn with replacement; all values
    are NaN if none does.
    """
    key_start, key_play = jax.random.split(key)
    first = is_first.ravel()
    which = jax.random.categorical(key_start, jnp.log(1.0 * first), shape=(EPISODES,))
    start = jax.tree.map(lambda x: x.reshape(-1, *x.shape[is_first.ndim :])[which], states)
    played = jax.vmap(lambda start, key: imagine_episode(dream, start, limit, key))(
        start, jax.random.split(key_play, EPISODES)
    )
    values = {
        "imagined_episode_return": played.total_reward / reward_scale,
        "imagined_episode_length": played.length,
        "imagined_win_rate": played.won,
    }
    return {
        f"behaviour/{name}": jnp.where(first.any(), value.mean(), jnp.nan)
        for name, value in values.items()
    }
