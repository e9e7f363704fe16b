"""The oracle imagines what the simulator does, in the parts that it replaces and in no others."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks import agreement as comparison
from benchmarks import oracle as instrument
from benchmarks import oracle_table
from benchmarks.agreement import action_values, returns, within_states
from benchmarks.oracle import Oracle, Parts
from numpy.testing import assert_allclose, assert_array_equal
from tests.tiny import flags, tiny

from mabl.algorithms.base import Experience
from mabl.behaviour.mappo import MAPPO
from mabl.nets.categorical import still
from mabl.training.loop import cycle_keys
from mabl.training.programs import build

SCALE = 10.0
"""Reward scale in the preset of the test environments."""


def imagined(parts: Parts, algo: str = "mabl", **options):
    """A trajectory `[H, B, N]` from replayed steps of the coordination task."""
    config = tiny(algo)
    config = replace(config, imagination=replace(config.imagination, n_starts=8, **options))
    training = build(config)
    oracle = Oracle(training.env, training.algorithm, parts)

    @jax.jit
    def run(key):
        state = oracle.init(key)
        for _ in range(3):
            state, _ = oracle.cycle(state, 0, 0, 1000)
        return oracle.imagine(state.learner, state.replay, jax.random.key(1))[0]

    return jax.device_get(run(jax.random.key(0)))


def truth(trajectory):
    """Rewards and ends that the rules of the task give to the imagined actions."""
    state = trajectory.view.critic_features[1][..., 0, :]
    cue, t = state[..., :3].argmax(-1), np.rint(4 * state[..., 3])
    wanted = (cue[:-1, :, None] + np.arange(2)) % 3
    paid = SCALE * (trajectory.action == wanted).all(-1, keepdims=True)
    return np.broadcast_to(paid, trajectory.action.shape), (t[1:] == 4)[..., None], t


@pytest.mark.parametrize("algo", ["mabl", "dreamer-v2"])
def test_what_is_imagined_follows_the_rules_of_the_task(algo):
    trajectory = imagined(Parts("observations", "true", "true", "true"), algo)
    paid, ended, t = truth(trajectory)
    going_on = trajectory.weight > 0
    assert going_on[0].all() and not going_on.all()
    assert_array_equal(trajectory.reward[going_on], paid[going_on])
    assert 0 < trajectory.reward[going_on].mean() < SCALE
    assert_array_equal(
        trajectory.continues[going_on], (~ended * np.ones(2, bool))[going_on].astype(float)
    )
    assert (np.diff(t, axis=0)[going_on[..., 0]] == 1).all()
    # Rows past an end have weight 0.
    after = np.concatenate([np.zeros_like(ended[:1]), ended[:-1]]).cumsum(0) > 0
    assert_array_equal(trajectory.weight, 1.0 - (after * np.ones(2)))


def test_policies_see_latents_or_observations():
    seen = imagined(Parts("observations", "true", "true", "true")).view.actor_features
    assert seen.shape[-1] == 6
    z, h = imagined(Parts("latents", "true", "true", "true")).view.actor_features
    assert h.shape[-1] == 16 and z.index.shape[-1] == 2


@pytest.mark.parametrize("reward", ["true", "learned"])
@pytest.mark.parametrize("ends", ["true", "learned"])
@pytest.mark.parametrize("dynamics", ["true", "learned"])
def test_each_part_is_the_simulators_or_the_models(dynamics, reward, ends):
    trajectory = imagined(Parts("latents", dynamics, reward, ends))
    rewards = np.unique(trajectory.reward[0])
    assert (set(rewards) <= {0.0, SCALE}) == (reward == "true")
    assert (set(np.unique(trajectory.continues)) <= {0.0, 1.0}) == (ends == "true")
    # The fourth action is never available; a model that has learned nothing does not know.
    available = trajectory.view.available[1:]
    assert not available[..., 3].any() or dynamics == "learned"
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(trajectory))


def test_learned_ends_are_those_of_imagination():
    own = imagined(Parts("latents", "true", "true", "learned"), team_end=False).continues
    assert (own[..., 0] != own[..., 1]).all()
    team = imagined(Parts("latents", "true", "true", "learned"), team_end=True).continues
    assert_array_equal(team[..., 0], team[..., 1])
    assert_allclose(team[0, :, 0], own[0].mean(-1), rtol=1e-5)


def test_with_everything_learned_it_is_plain_training():
    config = tiny("mabl")
    training = build(config)
    oracle = Oracle(training.env, training.algorithm, Parts("latents", *3 * ("learned",)))

    @jax.jit
    def run(key):
        state = oracle.init(key)
        state, _ = oracle.cycle(state, 0, 0, 1000)
        after, _ = oracle.cycle(state, 0, 1, 1000)
        rows = after.replay._replace(rows=after.replay.rows.row)
        experience = Experience(rows, None, None, state.env_steps / 1000)
        key_policy = jax.random.fold_in(cycle_keys(state.key).policy, 0)
        plain, _ = training.algorithm.update_policy(state.learner, experience, key_policy)
        return after.learner, plain, oracle.diagnose(after)

    oracles, plain, told = run(jax.random.key(0))
    jax.tree.map(assert_array_equal, oracles, plain)
    assert 1 <= told["behaviour/imagined_episode_length"] <= 4


def test_qmix_learns_from_observations_and_the_state():
    config = tiny("mabl-qmix")
    training = build(config)
    oracle = Oracle(training.env, training.algorithm, Parts("observations", "true", "true", "true"))

    @jax.jit
    def run(key):
        state = oracle.init(key)
        state, _ = oracle.cycle(state, 0, 0, 1000)
        return state.learner.behaviour, oracle.cycle(state, 0, 1, 1000)

    before, (after, metrics) = run(jax.random.key(0))
    assert jnp.isfinite(metrics["behaviour/critic_loss"])
    moved = jax.tree.map(
        lambda a, b: jnp.any(a != b), before.values, after.learner.behaviour.values
    )
    assert all(jax.tree.leaves(moved))


def test_it_tells_its_points_and_the_table_reads_them(tmp_path, capsys):
    file = tmp_path / "points.jsonl"
    for seed in (0, 1):
        instrument.run(
            [
                *flags("mabl", "test/coordination"),
                *("--total-steps=400", "--every=200", "--evaluate-every=400", f"--seed={seed}"),
                *("--name=tiny", f"--json={file}"),
            ]
        )
    points = [json.loads(line) for line in file.read_text().splitlines()]
    assert [point["seed"] for point in points] == sorted(point["seed"] for point in points)
    assert points[-1]["step"] >= 400 and 0 <= points[-1]["greedy"] <= 1
    assert 0 < points[-1]["entropy_share"] <= 1
    assert "loss" not in points[-1]  # there is no model
    table = oracle_table.table(oracle_table.read([file]), [400])
    ends = [point["greedy"] for point in points if "greedy" in point][-2:]
    assert f"| test/coordination | tiny | 0, 1 | {np.mean(ends):.2f} (" in table
    oracle_table.draw(oracle_table.read([file]), tmp_path / "points.png")
    assert (tmp_path / "points.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--algo=mappo", "--env=test/coordination"], "needs a compiled environment"),
        (["--env=test/host-counting"], "needs a compiled environment"),
        (["--env=test/coordination", "--reward=learned"], "give --inputs latents"),
    ],
)
def test_mistakes_are_one_line(arguments, message, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["oracle", *arguments])
    with pytest.raises(SystemExit) as exit_:
        instrument.main()
    assert exit_.value.code == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1


def test_scores_of_an_evaluation_are_means_over_seeds():
    points = {
        ("e", "s"): {
            seed: [{"step": 20_010, "greedy": greedy, "sampled": 0.5, "cpu_seconds": 60.0}]
            for seed, greedy in ((0, 0.25), (1, 0.75))
        }
    }
    assert oracle_table.table(points, [20_000]).splitlines()[-1] == (
        "| e | s | 0, 1 | 0.50 (0.25 to 0.75) | 0.50 (0.50 to 0.50) | 1.0 |"
    )
    assert_allclose(oracle_table.score_of({"episode_return": 3.0}), 3.0)


def test_agreement_is_the_correlation_within_states_by_hand():
    """Deviations (-1, 1), (-2, 2) against (-1, 1), (2, -2): (2 - 8) / sqrt(10 * 10)."""
    a = jnp.array([[0.0, 2.0], [10.0, 14.0]])
    b = jnp.array([[5.0, 7.0], [3.0, -1.0]])
    assert_allclose(within_states(a, b), -0.6, rtol=1e-6)
    assert_allclose(within_states(a, 3 * a + jnp.array([[7.0], [-50.0]])), 1.0, rtol=1e-6)


def test_agreement_compares_the_right_worlds_and_actions(monkeypatch):
    """The model ranks the policy's actions the other way round, the others like the simulator.

    Estimates differ by factors and by what each state adds, which no correlation sees.
    """

    def values(oracle, learner, env_state, row, latent, key):
        n_actions = comparison.BY_POLICY + comparison.UNIFORM
        x = jax.random.normal(key, (n_actions, 2, len(comparison.STEPS)))
        turned = jnp.where(jnp.arange(n_actions) < comparison.BY_POLICY, -1.0, 1.0)
        said = x * turned[:, None, None]
        return jnp.stack([x, 2 * x + 5, 3 * said, 4 * said - 7], 1)

    monkeypatch.setattr(comparison, "action_values", values)
    training = build(tiny("mabl"))
    oracle = Oracle(training.env, training.algorithm, Parts("latents", *3 * ("learned",)))

    @jax.jit
    def run(key):
        state = oracle.init(key)
        for _ in range(3):
            state, _ = oracle.cycle(state, 0, 0, 1000)
        return comparison.agreement(oracle, state, jax.random.key(1))

    told = jax.device_get(run(jax.random.key(0)))
    for k in comparison.STEPS:
        assert_allclose(told[f"policy_action_correlation_{k}"], -1, rtol=1e-5)
        assert -0.6 < told[f"action_correlation_{k}"] < 0  # 8 of 12 turned
        for prefix in ("action", "policy_action"):
            assert_allclose(told[f"{prefix}_ceiling_{k}"], 1, rtol=1e-5)
            assert_allclose(told[f"{prefix}_repeat_{k}"], 1, rtol=1e-5)


class Seven(MAPPO):
    """Values everything 7."""

    def value(self, state, view):
        return jnp.full(view.alive.shape, 7.0)


@pytest.mark.parametrize("algo", ["mabl", "mamba"])
def test_the_simulators_side_of_agreement_follows_the_rules_of_the_task(algo):
    """Rewards are 0 or the scale, and what row 3 leads to is worth nothing; a model says more."""
    training = build(tiny(algo))
    algorithm = training.algorithm._replace(behaviour=Seven(*training.algorithm.behaviour))
    oracle = Oracle(training.env, algorithm, Parts("latents", *3 * ("learned",)))

    @jax.jit
    def values(key):
        state, _ = oracle.cycle(oracle.init(key), 0, 0, 1000)
        begun = jax.tree.map(lambda x: x[:, :4].reshape(-1, *x.shape[2:]), state.replay.rows)
        latent = still(algorithm.dream(state.learner).model.initial())
        keys = jax.random.split(jax.random.key(1), begun.row.is_first.shape[0])
        return jax.vmap(
            lambda env_state, row, key: action_values(
                oracle, state.learner, env_state, row, latent, key
            )
        )(begun.env_state, begun.row, keys)

    found = np.asarray(values(jax.random.key(0)))  # [2 lanes of rows 0 to 3, A, 4, 2, K]
    gamma, left = algorithm.config.mappo.gamma, np.tile(np.arange(4, 0, -1), 2)[:, None]
    for world in (0, 1):
        (paid, paid_5), (worth, worth_5) = np.moveaxis(found[:, :, world], (2, 3), (0, 1))
        assert (np.isclose(paid, 0) | np.isclose(paid, SCALE)).all() and 0 < paid.mean() < SCALE
        expected = gamma * 7.0 * (left > 1)
        assert_allclose(worth, np.broadcast_to(expected, worth.shape), rtol=1e-5)
        assert_allclose(worth_5, 0)  # no episode has five steps
        later, bound = paid_5 - paid, SCALE * sum(gamma**i * (left > i) for i in range(1, 4))
        assert (later >= -1e-4).all() and (later <= bound + 1e-4).all()
        assert later[left[:, 0] > 1].mean() > 0.1 * SCALE
    (said, _), (promised, _) = np.moveaxis(found[:, :, 2], (2, 3), (0, 1))
    assert not np.array_equal(found[:, :, 2], found[:, :, 3])
    assert not np.allclose(said, paid, atol=0.5)
    assert (promised > 0).all() and (promised < gamma * 7.0).all()


def test_returns_of_a_trajectory_by_hand():
    """Rewards are action + state, with actions 3, then 1; goes on with .5; V of state n is 100 n.

    With gamma .8, after one step: 3 and .8 (.5) 100. After five: 3 and the sum of .4^i (1 + i) from
    i = 1, and .4^5 500.
    """

    def step(state, action, key):
        del key
        return state + 1, action + state, jnp.float32(0.5), 100.0 * (state + 1)

    def act(state, key):
        del state, key
        return jnp.float32(1.0)

    found = returns(step, act, jnp.float32(0), jnp.float32(3.0), 0.8, jax.random.key(0))
    rewards = [3.0, 3.0 + sum(0.4**i * (1 + i) for i in range(1, 5))]
    assert_allclose(found, [rewards, [0.4 * 100, 0.4**5 * 500]], rtol=1e-6)
