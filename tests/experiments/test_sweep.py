"""Searches: what they search, and that they go on where they were left."""

import csv
import shlex
import signal
import subprocess
import sys

import pytest
from tests.experiments.tiny_suite import wait_for
from tests.tiny import flags

from mabl import UserError
from mabl.algorithms.presets import preset
from mabl.cli.runs import chosen_preset, parse_config
from mabl.experiments import processes
from mabl.experiments.sweep import flags_of, parse_space, settings

optuna = pytest.importorskip("optuna")
ENV = "test/coordination"


def command(logdir, trials):
    space = ["--space", "recurrent_mappo.learning_rate=1e-3..1e-2:log", "total_steps=100,150"]
    own = [*space, f"--trials={trials}", "--parallel=1", "--eval-episodes=4", "--name=mine"]
    return ["sweep", *flags("mappo", ENV), *own, f"--logdir={logdir}"]


def trials_of(logdir):
    with (logdir / "mine" / "trials.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_search_that_is_killed_goes_on_and_the_best_is_told(tmp_path, mabl):
    args = [sys.executable, "-m", "mabl", *command(tmp_path, 2)]
    process = subprocess.Popen(args, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    wait_for(lambda: any(tmp_path.glob(f"mine/{ENV}/trial-1/seed_0/*/metrics.jsonl")))
    process.send_signal(signal.SIGKILL)
    process.wait()
    code, out, said = mabl(*command(tmp_path, 2))
    assert code == 0
    rows = trials_of(tmp_path)
    assert [row["trial"] for row in rows] == ["0", "1"]
    assert all(row["state"] == "complete" for row in rows)
    for number in range(2):
        assert len(list(tmp_path.glob(f"mine/{ENV}/trial-{number}/seed_0/2*"))) == 1
    scores = [float(row["score"]) for row in rows]
    best = max(rows, key=lambda row: float(row["score"]))
    assert f"{max(scores):.3f}" in out
    assert f"--recurrent-mappo.learning-rate {best['recurrent_mappo.learning_rate'][:6]}" in said
    study = optuna.load_study(study_name="mine", storage=f"sqlite:///{tmp_path}/mine/study.db")
    assert [trial.value for trial in study.trials] == pytest.approx(scores, abs=1e-5)

    assert mabl(*command(tmp_path, 4))[0] == 0
    rates = [row["recurrent_mappo.learning_rate"] for row in trials_of(tmp_path)]
    assert len(rates) == len(set(rates)) == 4  # none is tried twice

    with pytest.raises(UserError, match="another space or config"):
        from mabl import cli

        cli.run([*command(tmp_path, 2), "--training.num-envs=4"])


def test_spaces_are_intervals_logarithms_and_choices():
    space = parse_space(["a.b=1e-4..1e-2:log", "c=4..20", "d=64,128", "e=.1..1"])
    make = optuna.distributions
    assert space == {
        "a.b": make.FloatDistribution(1e-4, 1e-2, log=True),
        "c": make.IntDistribution(4, 20),
        "d": make.CategoricalDistribution([64, 128]),
        "e": make.FloatDistribution(0.1, 1.0),
    }
    choices = parse_space(["mappo.ent_coef=1e-3,.1"])["mappo.ent_coef"].choices
    config = preset("quick", "smax/3m", "mabl")
    found = [settings(config, {"mappo.ent_coef": one}).mappo.ent_coef for one in choices]
    assert found == [0.001, 0.1]


def test_what_a_signal_kills_is_tried_again(tmp_path, mabl, monkeypatch):
    """It is no failure of the settings."""
    code, _, said = mabl(*command(tmp_path, 1), "--eval-episodes=0")
    assert code == 2 and "give a number above 0" in said
    whole = processes.start

    def killed(job, cores=()):
        process = whole(job, cores)
        process.kill()
        return process

    with monkeypatch.context() as patch:
        patch.setattr(processes, "start", killed)
        assert mabl(*command(tmp_path, 1))[0] == 1
    assert [row["state"] for row in trials_of(tmp_path)] == ["running"]
    assert mabl(*command(tmp_path, 1))[0] == 0
    assert [row["state"] for row in trials_of(tmp_path)] == ["complete"]


def test_the_best_can_be_trained():
    """As it is told: flags that are on or off have no value."""
    config = preset("quick", "smax/3m", "mabl")
    on = config.mappo.normalise_advantage
    chosen = {"mappo.normalise_advantage": not on, "mappo.ent_coef": 0.03, "total_steps": 7}
    default, flags = chosen_preset(shlex.split(flags_of(config, chosen)))
    assert parse_config(flags, default) == settings(config, chosen)


def test_settings_are_put_into_their_sections():
    config = preset("quick", "smax/3m", "mabl")
    changed = settings(config, {"mappo.ent_coef": 0.5, "total_steps": 7})
    assert (changed.mappo.ent_coef, changed.total_steps) == (0.5, 7)


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        ([], "--space is empty"),
        (["mappo.ent_coef"], "give FIELD=LOW..HIGH"),
        (["mappo.ent_coef=1..x"], "could not convert"),
        (["mappo.ent_coef=1..2:exp"], "exp is no scale"),
        (["mappo.ent_coef=2..1"], "mappo.ent_coef=2..1"),
        (["mappo.ent_coef=0..1:log"], "mappo.ent_coef=0..1:log"),
        (["mappo.ent_coef=1,2", "mappo.ent_coef=1,2"], "is there twice"),
        (["mappo.entropy=1,2"], "unknown config field 'mappo.entropy'"),
        (["recurrent_mappo.gamma=.9,.99"], "mabl does not read it"),
        (["mappo.n_epochs=.5..1.5"], "config field mappo.n_epochs is 0.5: give int"),
    ],
)
def test_a_mistake_in_a_space_is_one_line(space, expected, mabl, tmp_path):
    given = [part for one in space for part in ("--space", one)] if len(space) < 2 else [
        "--space", *space
    ]  # fmt: skip
    code, _, said = mabl("sweep", *given, f"--logdir={tmp_path}")
    assert code == 2 and expected in said and said.count("\n") == 1
