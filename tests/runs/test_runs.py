"""Run folders, as `mabl resume` meets them after a misfortune."""

import json
import shutil

import pytest
from tests.faults.killed import numbers
from tests.tiny import flags

from mabl import cli
from mabl.runs.checkpoint import Checkpoints
from mabl.runs.lock import writing
from mabl.runs.metrics import NOT_SCORES, read, score_name

ENV = "test/coordination"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A short run with two checkpoints."""
    logdir = tmp_path_factory.mktemp("runs")
    given = [*flags("mappo", ENV), "--training.checkpoint-every=40", f"--logdir={logdir}"]
    assert cli.run(["train", *given, "--total-steps=400"]) == 0
    (folder,) = logdir.glob(f"{ENV}/mappo/seed_0/*")
    return folder


@pytest.fixture
def run(whole, tmp_path):
    """A copy of it."""
    shutil.copytree(whole, tmp_path / "run")
    return tmp_path / "run"


def test_the_score_is_told_from_all_else_that_runs_log(whole):
    """Also in runs whose first cycles ended no episode, as of long episodes."""
    rows = read(whole)
    names = {name.removeprefix("train/") for row in rows for name in row if "train/" in name}
    assert names - set(NOT_SCORES) == {"score"} and set(NOT_SCORES) < names
    ended = ("train/score", "train/episode_return", "train/episode_length")
    none = {name: value for name, value in rows[0].items() if name not in ended}
    assert score_name([none, none]) is None
    assert score_name([none, rows[-1]]) == "score"


def test_one_process_writes_and_others_read(run, mabl):
    with writing([run]):
        code, _, err = mabl("resume", run, "--total-steps=500")
        assert code == 2 and f"mabl: {run} is being written by another mabl" in err
        assert mabl("eval", run, "--episodes=1")[0] == 0
    assert mabl("resume", run, "--total-steps=500")[0] == 0


def test_a_run_without_a_checkpoint_begins_anew(run, whole, mabl):
    shutil.rmtree(run / "checkpoints")
    assert mabl("resume", run)[0] == 0
    assert numbers(run) == numbers(whole)


@pytest.mark.filterwarnings("default:.*an older checkpoint is needed")
def test_a_run_whose_newest_checkpoint_is_damaged_goes_on_from_the_one_before(run, whole, mabl):
    checkpoints = Checkpoints(run / "checkpoints")
    newest, older = checkpoints.steps
    path = checkpoints.at(newest) / "policy.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    out = mabl("eval", run, "--episodes=1", "--json")[1]
    assert json.loads(out)["step"] == older
    assert mabl("resume", run)[0] == 0
    assert numbers(run) == numbers(whole) and checkpoints.steps[0] == newest


def test_a_run_without_a_whole_checkpoint_says_so(run, mabl):
    for path in run.rglob("checksums.json"):
        path.unlink()
    with pytest.warns(UserWarning, match="missing or damaged"):
        code, _, err = mabl("resume", run)
    assert code == 2 and "has no whole checkpoint: train it again" in err
