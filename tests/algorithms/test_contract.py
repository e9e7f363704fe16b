"""What every registered algorithm must do: a new one is tested as soon as it is registered."""

import json
import shutil
from functools import cache
from pathlib import Path

import jax
import numpy as np
import pytest
from tests.tiny import flags, tiny

from mabl import Policy, TeamPolicy, UserError, cli, preset
from mabl.algorithms.registry import ALGORITHMS
from mabl.runs.checkpoint import Checkpoints, named
from mabl.runs.folder import read_config
from mabl.training.programs import build, forget_programs, programs

ENV = "test/counting"
"""Its episodes end and are cut short, actions are unavailable, and an agent dies."""
STEPS, MORE_STEPS = 400, 500
"""Between checkpoints, and of a run: more than one interval, less than two."""

EVERY = pytest.mark.parametrize(
    # Tests of one algorithm share its compiled program, so they belong to one worker.
    "algo",
    [pytest.param(name, marks=pytest.mark.xdist_group(name)) for name in ALGORITHMS],
)


@pytest.fixture(scope="module")
def logdir(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def run(logdir):
    """`run(algo)` is the folder of a run with two checkpoints."""

    def train(algo: str) -> Path:
        given = [*flags(algo, ENV), f"--total-steps={MORE_STEPS}", f"--logdir={logdir / 'whole'}"]
        assert cli.run(["train", *given, f"--training.checkpoint-every={STEPS}"]) == 0
        (folder,) = (logdir / "whole").glob(f"{ENV}/{algo}/seed_0/*")
        return folder

    return cache(train)


@pytest.fixture(scope="module")
def killed(run, logdir):
    """`killed(algo)` is a copy of it without its last checkpoint and with damaged metrics."""

    @cache
    def kill(algo: str) -> Path:
        folder = logdir / "killed" / algo
        shutil.copytree(run(algo), folder)
        checkpoints = Checkpoints(folder / "checkpoints")
        last, first = checkpoints.steps
        assert first < MORE_STEPS <= last
        shutil.rmtree(checkpoints.at(last))
        with (folder / "metrics.jsonl").open("a") as file:
            file.write('{"step": 9999, "train/score": 1.0}\n{"step": 10')  # past it; torn
        return folder

    return kill


@pytest.fixture(scope="module")
def resumed(killed, logdir):
    """`resumed(algo)` is a copy of that, resumed in a process like new."""

    @cache
    def resume(algo: str) -> Path:
        folder = logdir / "resumed" / algo
        shutil.copytree(killed(algo), folder)
        if algo == "mabl":  # as in a new process; for one, as tracing takes its time
            forget_programs()
        assert cli.run(["resume", str(folder)]) == 0
        return folder

    return resume


def metrics_of(folder: Path) -> list[dict]:
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if not k.startswith("time/")} for row in rows]


def learner_of(folder: Path) -> dict[str, np.ndarray]:
    """All that learning changes, from the newest checkpoint, by name."""
    training = programs(read_config(folder)).training
    shape = jax.eval_shape(training.init, jax.random.key(0))
    _, state = Checkpoints(folder / "checkpoints").restore("state", shape)
    return {name: np.asarray(leaf) for name, leaf in named(state.learner)}


@EVERY
def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(algo, resumed, run):
    whole = run(algo)
    assert metrics_of(resumed(algo)) == metrics_of(whole)
    assert metrics_of(whole)[-1]["step"] >= MORE_STEPS
    one, other = learner_of(resumed(algo)), learner_of(whole)
    for name in one:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


@EVERY
def test_learning_moves_every_parameter_and_keeps_them_finite(algo, killed, resumed):
    learned = metrics_of(resumed(algo))[-1]
    assert any(name.startswith("behaviour/") for name in learned)
    assert all(value is not None and np.isfinite(value) for value in learned.values())
    before, after = learner_of(killed(algo)), learner_of(resumed(algo))
    assert all(np.isfinite(value).all() for value in after.values())
    still = [n for n in before if before[n].size > 1 and np.array_equal(before[n], after[n])]
    assert not still


@EVERY
def test_its_policy_is_evaluated_and_can_be_taken_away(algo, run, capsys):
    folder = run(algo)
    assert cli.run(["eval", str(folder), "--episodes=8", "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["episodes"] == 8 and 0 <= numbers["score"] < 1000

    available = np.array([[True, False, True]] * 2)
    seen = np.random.default_rng(0).normal(size=(60, 2, 4)).astype(np.float32)
    team = TeamPolicy.load(folder, greedy=False)
    joint = np.stack([team.act(obs, available) for obs in seen])
    assert set(joint.ravel()) == {0, 2}
    with pytest.raises(UserError, match=r"obs has shape \(3, 4\), the policy expects \(2, 4\)"):
        team.act(np.zeros((3, 4)))
    if ALGORITHMS[algo].decentralised:
        one = Policy.load(folder, greedy=False)
        assert {one.act(obs[0], available[0]) for obs in seen} == {0, 2}
    else:
        with pytest.raises(UserError, match=f"{algo} executes centrally"):
            Policy.load(folder)


@EVERY
def test_seeds_of_one_program_keep_their_shapes(algo):
    """`test_cli.py` runs two seeds of MABL; whether others can is a matter of shapes."""
    training = build(tiny(algo, ENV))
    keys = jax.random.split(jax.random.key(0), 2)
    states = jax.eval_shape(jax.vmap(training.init), keys)
    cycle = jax.vmap(training.cycle, in_axes=(0, None, None))
    after, metrics = jax.eval_shape(cycle, states, 1, 1)
    kind = lambda x: (x.shape, x.dtype, getattr(x, "weak_type", False))  # noqa: E731
    assert jax.tree.map(kind, after) == jax.tree.map(kind, states)
    assert not any(kind(x)[2] for x in jax.tree.leaves(states))  # a resumed run has none
    assert all(x.shape == (2,) for x in jax.tree.leaves(metrics))


@EVERY
def test_continuous_actions_of_different_sizes_go_through_or_are_refused(algo):
    """Agent 0 has one dimension and agent 1 has two; `test_learns.py` learns with them."""
    config = tiny(algo, "test/aiming")
    if ALGORITHMS[algo].discrete:
        with pytest.raises(UserError, match=f"test/aiming has continuous actions, {algo} needs"):
            build(config)
        return
    training = build(config)
    state = jax.jit(training.init)(jax.random.key(0))
    collect = jax.jit(training.collect)
    rows = collect(state.learner, state.collectors, jax.random.key(1))[1].rows
    actions = rows.prev_action[~rows.is_first]
    assert not actions[:, 0, 1].any() and actions[:, 1].all()
    assert np.abs(actions).max() <= 1
    after, _ = jax.eval_shape(training.cycle, state, 1, 1)
    kind = lambda x: (x.shape, x.dtype, getattr(x, "weak_type", False))  # noqa: E731
    assert jax.tree.map(kind, after) == jax.tree.map(kind, state)


@EVERY
@pytest.mark.parametrize("name", ["quick", "paper"])
@pytest.mark.parametrize("env", ["smax/3m", "smax/2s3z", "test/coordination"])
def test_every_preset_builds_it(algo, name, env):
    config = preset(name, env, algo)
    shape = jax.eval_shape(build(config).init, jax.random.key(0))
    assert sum(x.size for x in jax.tree.leaves(shape.learner)) > 1000
