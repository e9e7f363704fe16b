"""Diagnostics by hand: shares of variance, within episodes only."""

import jax
import jax.numpy as jnp
import pytest

from mabl.algorithms.diagnostics import (
    diagnose,
    masked_mean,
    open_loop_error,
    unexplained,
    value_metrics,
)
from mabl.envs.base import Discrete, EnvSpec
from mabl.envs.counting import CountingEnv
from mabl.rows import TimeStep
from mabl.types import Metrics
from mabl.world_models.base import WorldModelConfig
from mabl.world_models.mabl import MABL
from mabl.world_models.sequences import observe_sequence


def test_unexplained_is_squared_error_over_variance_where_the_mask_holds():
    real = jnp.array([0.0, 2.0, 4.0, 99.0]).reshape(1, 4, 1, 1)  # [B, T, N, F]
    predicted = jnp.array([1.0, 2.0, 3.0, 0.0]).reshape(1, 4, 1, 1)
    mask = jnp.array([True, True, True, False]).reshape(1, 4, 1)
    assert unexplained(predicted, real, mask) == pytest.approx(2 / 8)  # (1 + 0 + 1) / (4 + 0 + 4)
    assert unexplained(jnp.full_like(real, 2.0), real, mask) == pytest.approx(1.0)
    assert unexplained(real, real, mask) == 0.0


def test_open_loop_error_compares_row_t_plus_k_and_skips_episode_boundaries():
    _, row = CountingEnv().reset(jax.random.key(0))
    length, steps = 6, 2
    rows = jax.tree.map(lambda x: jnp.broadcast_to(x, (1, length, *x.shape)), row)
    rows = rows._replace(is_first=jnp.array([[True, False, False, False, True, False]]))
    real = jnp.arange(6.0)[None, :, None, None]  # [B, T, N, F]
    starts = jnp.arange(4.0)[None, :, None, None]
    exact = jnp.stack([starts + 1, starts + 2])  # [K, B, W, N, F]
    everywhere = jnp.ones((1, length, 1), bool)
    assert open_loop_error(exact, real, everywhere, rows, 1) == 0.0
    assert open_loop_error(exact, real, everywhere, rows, 2) == 0.0
    # Two steps ahead, rows 2 and 3 lead into the next episode: being wrong there is no error.
    wrong = exact.at[1, 0, 2:].add(100.0)
    assert open_loop_error(wrong, real, everywhere, rows, steps) == 0.0
    # Rows 0 and 1 lead to 2 and 3, variance 0.5 in all; one of them off by 1.
    off = exact.at[1, 0, 0].add(1.0)
    assert open_loop_error(off, real, everywhere, rows, steps) == pytest.approx(1 / 0.5)
    # ... unless the mask leaves out the row that it leads to.
    assert open_loop_error(off, real, everywhere.at[0, 2].set(False), rows, steps) == 0.0


def test_the_dead_do_not_count_in_what_is_said_of_observations():
    spec = EnvSpec("stub", 3, 4, 5, Discrete(3), 10, "score")
    config = WorldModelConfig(hidden=8, n_hidden=1, n_categoricals=2, n_classes=3)
    model = MABL(spec, config, jax.random.key(0))
    shape = (2, 18, 3)
    rows = TimeStep(
        prev_action=jnp.zeros(shape, jnp.int32),
        reward=jax.random.normal(jax.random.key(1), shape),
        terminated=jnp.zeros(shape, bool),
        truncated=jnp.zeros(shape[:2], bool),
        obs=jax.random.normal(jax.random.key(2), (*shape, 4)),
        state=jnp.zeros((*shape[:2], 5)),
        available=jnp.ones((*shape, 3), bool),
        alive=jax.random.bernoulli(jax.random.key(3), 0.7, shape),
        is_first=jnp.zeros(shape[:2], bool).at[:, 0].set(True),
        score=jnp.full(shape[:2], jnp.nan),
    )
    keys = jax.random.split(jax.random.key(4), 2)
    latents, _ = jax.vmap(observe_sequence, in_axes=(None, 0, 0))(model, rows, keys)

    @jax.jit
    def told(rows: TimeStep) -> Metrics:
        return diagnose(model, latents, rows, jax.random.key(5), spec.action_space, config)

    dead = jnp.where(rows.alive[..., None], rows.obs, 99.0)
    living = jnp.where(rows.alive[..., None], 99.0, rows.obs)
    before = told(rows)
    names = [n for n in before if "obs" in n or "reconstruction" in n]
    assert len(names) == 5
    for name in names:
        assert told(rows._replace(obs=dead))[name] == before[name], name
        assert told(rows._replace(obs=living))[name] != before[name], name


class Adding:
    """A model whose latent is a number, to which imagination adds 10 and the team's actions."""

    def imagine(self, latent, action, key):
        return latent + 10 + (action @ jnp.arange(3.0)).sum()


def test_the_value_gap_is_that_of_the_prior_over_the_posterior_of_the_same_row_by_hand():
    """Posterior latents are 0, 3, 4, 6, 20, 21; rows 1 and 3 are played 1 and 2, others 0."""
    _, row = CountingEnv().reset(jax.random.key(0))
    rows = jax.tree.map(lambda x: jnp.broadcast_to(x, (1, 6, *x.shape)), row)
    played = jnp.zeros((1, 6, 2), jnp.int32).at[0, 1, 0].set(1).at[0, 3, 1].set(2)
    rows = rows._replace(
        prev_action=played,
        is_first=jnp.array([[True, False, False, False, True, False]]),
        truncated=jnp.array([[False, False, False, True, False, False]]),
    )
    latents = jnp.array([[0.0, 3.0, 4.0, 6.0, 20.0, 21.0]])

    def value(latent, row):
        return 2 * latent

    told = value_metrics(Adding(), value, latents, rows, jax.random.key(0), Discrete(3), 4.0)
    assert told["behaviour/value_at_reset"] == pytest.approx((2 * 0 + 2 * 20) / 2 / 4)
    # Rows 1, 2 and 5: row 3 ends an episode, row 4 is a reset.
    gaps = 2 * ((0 + 10 + 1) - 3), 2 * ((3 + 10) - 4), 2 * ((20 + 10) - 21)
    assert told["behaviour/value_gap"] == pytest.approx(sum(gaps) / 3 / 4)


class Counting(Adding):
    """It also holds the number of the living, as a fraction."""

    def with_life(self, latent, alive):
        return latent + alive.sum() / 8


def test_the_value_gap_leaves_out_unknown_pasts_and_tells_the_prior_who_lives():
    """A sequence begins in mid-episode: latents of rows 5 and 6 are known, those before are not."""
    _, row = CountingEnv().reset(jax.random.key(0))
    rows = jax.tree.map(lambda x: jnp.broadcast_to(x, (1, 8, *x.shape)), row)
    alive = jnp.ones((1, 8, 2), bool).at[0, 6, 0].set(False)
    rows = rows._replace(
        prev_action=jnp.zeros((1, 8, 2), jnp.int32), is_first=jnp.zeros((1, 8), bool), alive=alive
    )
    latents = jnp.array([[9.0, 8.0, 7.0, 6.0, 5.0, 1.0, 4.0, 2.0]])

    def value(latent, row):
        return latent

    told = value_metrics(Counting(), value, latents, rows, jax.random.key(0), Discrete(3), 1.0)
    gaps = (1 + 10 + 1 / 8) - 4, (4 + 10 + 2 / 8) - 2
    assert told["behaviour/value_gap"] == pytest.approx(sum(gaps) / 2)


def test_masked_mean():
    mean = masked_mean(jnp.array([1.0, 5.0, 9.0]), jnp.array([True, False, True]))
    assert mean == pytest.approx(5.0)
    assert jnp.isnan(masked_mean(jnp.ones(2), jnp.zeros(2, bool)))
