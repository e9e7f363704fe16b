"""Whole episodes in imagination: what the model promises the policy, to compare with real ones."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mabl.algorithms.diagnostics import masked_mean
from mabl.imagination import Dream, Imagined
from mabl.rows import TimeStep, is_last
from mabl.types import Metrics, PRNGKey

EPISODES = 64
"""Imagined episodes of one diagnosis."""


class Episode(NamedTuple):
    """An imagined episode, as far as it has gone."""

    episode_return: Float[Array, "*b"]
    """Sum of rewards, mean over agents, scaled units."""
    length: Float[Array, "*b"]
    """Joint steps."""
    last_reward: Float[Array, "*b"]
    """Of the step that ended it, mean over agents, scaled units."""
    ended: Bool[Array, "*b"]
    """False if the limit cut it."""


def imagine_episode(dream: Dream, start: Imagined, limit: int, key: PRNGKey) -> Episode:
    """Play the policy in the model from one state until an end is drawn, `limit` steps at most."""

    def advance(
        carry: tuple[Imagined, Episode], key: PRNGKey
    ) -> tuple[tuple[Imagined, Episode], None]:
        state, episode = carry
        key_action, key_step, key_end = jax.random.split(key, 3)
        action, _ = dream.act(state, key_action)
        state, predicted = dream.step(state, action, key_step)
        reward = predicted.reward.mean()
        ends = jax.random.uniform(key_end) >= dream.continues(predicted).mean()
        after = Episode(
            episode.episode_return + reward, episode.length + 1, last_reward=reward, ended=ends
        )
        kept = jax.tree.map(lambda old, new: jnp.where(episode.ended, old, new), episode, after)
        return (state, kept), None

    zero = jnp.zeros(())
    fresh = Episode(zero, zero, zero, jnp.zeros((), bool))
    return jax.lax.scan(advance, (start, fresh), jax.random.split(key, limit))[0][1]


def compare_episodes(
    dream: Dream,
    states: Imagined,
    rows: TimeStep,
    limit: int,
    reward_scale: float,
    key: PRNGKey,
) -> Metrics:
    """Return, length and win rate of imagined episodes, in the environment's units.

    `states` `[B, T, ...]` are those of the rows `[B, T]`. Episodes start from rows that begin one,
    drawn with replacement; without such rows all values are NaN. A win is an imagined end whose
    reward is nearer to the mean reward of the replayed wins (`score` above 0) than to that of the
    other ends: NaN while the rows do not hold both.
    """
    first = rows.is_first.ravel()
    key_start, key_play = jax.random.split(key)
    which = jax.random.categorical(key_start, jnp.log(1.0 * first), shape=(EPISODES,))
    start = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[which], states)
    keys = jax.random.split(key_play, EPISODES)
    played = jax.vmap(lambda *at: imagine_episode(dream, at[0], limit, at[1]))(start, keys)
    reward, won = rows.reward.mean(-1), jnp.nan_to_num(rows.score) > 0
    lost = is_last(rows) & ~won
    threshold = (masked_mean(reward, won) + masked_mean(reward, lost)) / 2
    wins = jnp.where(jnp.isnan(threshold), jnp.nan, played.ended & (played.last_reward > threshold))
    told = {
        "imagined_episode_return": played.episode_return.mean() / reward_scale,
        "imagined_episode_length": played.length.mean(),
        "imagined_win_rate": wins.mean(),
    }
    return {f"behaviour/{k}": jnp.where(first.any(), v, jnp.nan) for k, v in told.items()}
