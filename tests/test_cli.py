"""The command line, as a person meets it: one line for a mistake, and runs that go on."""

import errno
import json
import os
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml
from PIL import Image

from mabl import Policy, TeamPolicy, UserError, cli
from mabl.envs.coordination import CoordinationEnv
from mabl.errors import PREEMPTED
from mabl.runs import folder as run_folder
from mabl.runs.checkpoint import Checkpoints

COORDINATION = ["--env=test/coordination"]
TINY = [
    *COORDINATION,
    "--world-model.hidden=16",
    "--world-model.n-categoricals=2",
    "--world-model.n-classes=4",
    "--world-model.batch-size=4",
    "--mappo.hidden=16",
    "--imagination.n-starts=16",
    "--training.model-updates=2",
    "--training.policy-updates=1",
    "--training.prefill-steps=200",
    "--training.pretrain-updates=3",
    "--training.diagnose-every=300",
]


SECTIONS = {"training", "world_model", "imagination", "mappo"}
"""Parts of the configuration that MABL reads."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of 600 steps, made once."""
    logdir = tmp_path_factory.mktemp("runs")
    assert cli.run(["train", *TINY, "--total-steps=600", f"--logdir={logdir}"]) == 0
    (folder,) = logdir.glob("test/coordination/mabl/seed_0/*")
    return folder


def rows_of(folder):
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if not k.startswith("time/")} for row in rows]


MISTAKES = {
    "environment": (["train", "--env", "smax/3n"], "unknown environment 'smax/3n': did you mean"),
    "family": (["train", "--env", "smox/3m"], "unknown environment 'smox/3m'"),
    "task": (
        ["train", "--env", "3m"],
        "unknown environment '3m': did you mean smac/3m or smax/3m",
    ),
    "algorithm": (["train", "--algo", "mable"], "unknown algorithm 'mable': did you mean mabl or"),
    "preset": (["train", "--preset", "quik"], "unknown preset 'quik': did you mean quick?"),
    "command": (["trian"], "unknown command 'trian': did you mean train?"),
    "range": (["train", "--mappo.gamma", "2"], "--mappo.gamma is 2.0: give a number from 0 to 1"),
    "zero": (["train", "--total-steps", "0"], "--total-steps is 0: give a number above 0"),
    "negative": (["train", "--training.model-updates=-1"], "--training.model-updates is -1"),
    # Rows for each environment: 16 of a cycle, or 20 of a sequence, or an episode of 60 + 1.
    "capacity": (
        ["train", *COORDINATION, "--training.collect-steps=16", "--training.replay-capacity=127"],
        "--training.replay-capacity 127 is too small for 8 environments of test/coordination: "
        "give at least 128\n",
    ),
    "capacity for a sequence": (
        ["train", "--training.replay-capacity=16"],
        "--training.replay-capacity 16 is too small for 16 environments of smax/3m: "
        "give at least 320\n",
    ),
    "capacity for an episode": (
        ["train", "--preset=paper", "--training.replay-capacity=60"],
        "--training.replay-capacity 60 is too small for 1 environment of smax/3m: "
        "give at least 61\n",
    ),
    "sequence": (
        ["train", "--world-model.batch-length=1"],
        "--world-model.batch-length is 1: give a number from 2",
    ),
    "infinite": (["train", "--mappo.clip=inf"], "--mappo.clip is inf: give a number above 0"),
    "heads": (["train", "--mappo.hidden=30"], "--mappo.hidden is 30: give a multiple of its 8"),
    "epsilon": (
        ["train", "--algo=mabl-qmix", "--qmix.epsilon-start=0.1", "--qmix.epsilon-end=0.2"],
        "--qmix.epsilon-end is 0.2: give a number from 0 to 0.1",
    ),
    "burn-in": (
        ["train", "--algo=qmix", "--recurrent-qmix.burn-in=29"],
        "--recurrent-qmix.burn-in is 29: give a number from 0 to 2 less than the 30 rows",
    ),
    "no model to update": (
        ["train", "--algo=qmix", "--training.model-updates=5"],
        "--training.model-updates is 5: qmix has no model: give 0",
    ),
    "off-policy": (
        ["train", "--algo=mappo", "--training.policy-updates=3"],
        "--training.policy-updates is 3: mappo learns once from what it has just done",
    ),
    "no model": (
        ["train", "--algo=mappo", "--training.pretrain-updates=5"],
        "--training.pretrain-updates is 5: mappo has no model and learns from all it does: give 0",
    ),
    "no folder": (["eval", "nowhere"], "nowhere is not a run folder"),
    "resume nothing": (["resume", "nowhere"], "nowhere is not a run folder"),
    "nothing to do": (["eval"], "give either a run folder or --policy random|heuristic"),
    "no environment": (["eval", "--policy", "random"], "--policy random needs --env"),
    "no heuristic": (
        ["eval", "--policy", "heuristic", "--env", "test/counting"],
        "test/counting has no heuristic policy: use --policy random",
    ),
    "nothing to film": (["play"], "give either a run folder or --policy random|heuristic"),
    "no film": (["play", "--policy=random", "--env=smax/3m"], "a baseline has no run folder"),
    "kind of film": (
        ["play", "--policy=random", "--env=smax/3m", "--video=film.avi"],
        "film.avi ends in neither .mp4 nor .gif",
    ),
    "invisible": (
        ["play", "--policy=random", "--env=test/counting", "--video=film.gif"],
        "test/counting cannot be seen: it draws nothing",
    ),
    "episodes": (
        ["eval", "--policy=random", "--env=test/counting", "--episodes=0"],
        "--episodes is 0",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_line_and_exit_code_2(mabl, name):
    arguments, message = MISTAKES[name]
    code, out, err = mabl(*arguments)
    assert code == 2
    assert err.startswith(f"mabl: {message}"), err
    assert err.count("\n") == 1 and not out


def test_a_misspelt_flag_is_explained(mabl):
    code, _, err = mabl("train", "--mappo.gama", "0.9")
    assert code == 2 and "--mappo.gamma" in err


@pytest.mark.parametrize(
    ("algo", "flag"),
    [
        ("mabl", "--qmix.hidden"),
        ("mabl", "--communication.n-layers"),
        ("mabl-qmix", "--mappo.hidden"),
        ("mappo", "--world-model.hidden"),
        ("mappo", "--imagination.horizon"),
        ("qmix", "--qmix.hidden"),
    ],
)
def test_what_an_algorithm_does_not_read_has_no_flags(mabl, algo, flag):
    code, _, err = mabl("train", f"--algo={algo}", f"{flag}=8")
    assert code == 2 and flag in err
    code, out, _ = mabl("train", f"--algo={algo}", "--help")
    assert code == 0 and f"{flag.split('.')[0]}." not in out and "--training.num-envs" in out


def test_a_logdir_that_cannot_be_written_is_named(mabl, tmp_path):
    (tmp_path / "file").write_text("in the way")
    code, _, err = mabl("train", *TINY, f"--logdir={tmp_path}/file")
    assert code == 2 and "cannot write to" in err and "choose another --logdir" in err


class Squares:
    """Pictures as bright as the clock."""

    frames_per_second = 5.0

    def frames(self, before, after):
        yield np.full((8, 8, 3), 9 * int(after.t), np.uint8)


@pytest.mark.parametrize("greedy", ["--greedy", "--sample"])
def test_a_run_is_filmed_in_its_own_folder_or_where_one_likes(
    trained, mabl, tmp_path, monkeypatch, greedy
):
    monkeypatch.setattr(CoordinationEnv, "drawing", lambda _: Squares(), raising=False)
    film, trained = tmp_path / "films" / "film.gif", shutil.copytree(trained, tmp_path / "run")
    code, out, err = mabl("play", trained, greedy, "--episodes=2", f"--video={film}")
    assert code == 0 and out == f"{film}\n"
    assert err.count(" steps\n") == 2 and err.startswith("score ")
    with Image.open(film) as opened:
        assert opened.n_frames > 2
    code, out, _ = mabl("play", trained, greedy)
    (path,) = (trained / "videos").iterdir()
    assert code == 0 and out == f"{path}\n" and path.stem == "step_608" and path.stat().st_size


@pytest.mark.parametrize("reason", [errno.EACCES, errno.EROFS, errno.ENOSPC])
def test_a_run_folder_that_cannot_be_written_is_one_line(trained, mabl, monkeypatch, reason):
    def refuse(path, config):
        raise OSError(reason, os.strerror(reason), str(path))

    monkeypatch.setattr(run_folder, "write_config", refuse)
    code, _, err = mabl("resume", trained, "--total-steps=900")
    assert code == 2
    assert err.endswith(f"mabl: {os.strerror(reason)} ({trained}): give mabl a place to write\n")
    assert "Traceback" not in err


def test_a_run_that_diverges_stops_before_it_spoils_its_checkpoints(mabl, tmp_path):
    given = ["--mappo.critic-learning-rate=1e38", "--training.max-skipped-updates=2"]
    code, _, err = mabl("train", *TINY, "--total-steps=900", *given, f"--logdir={tmp_path}")
    assert code == 2 and "2 gradients in a row were not finite for behaviour.critic_opt" in err
    assert "no checkpoint was written: lower the learning rates" in err
    assert not list(tmp_path.rglob("checkpoints/*"))


def test_a_replay_that_cannot_fit_is_refused_before_it_is_allocated(mabl, tmp_path):
    huge = "--training.replay-capacity=1000000000000"
    code, _, err = mabl("train", *TINY, huge, f"--logdir={tmp_path}")
    assert code == 2 and "the replay needs" in err and not list(tmp_path.iterdir())


def test_a_resume_that_cannot_fit_is_refused_too(trained, mabl, monkeypatch):
    monkeypatch.setattr("mabl.training.run.free_memory", lambda: 1)
    code, _, err = mabl("resume", trained, "--total-steps=900")
    assert code == 2 and "the replay needs" in err


def test_runs_that_start_within_a_second_get_folders_of_their_own(monkeypatch, tmp_path):
    monkeypatch.setattr(Path, "exists", lambda path: False)  # another run is always a bit faster
    names = [run_folder.make_unused(tmp_path, "20260101-120000").name for _ in range(3)]
    assert names == ["20260101-120000", "20260101-120000-2", "20260101-120000-3"]


def test_the_commit_is_mabls_not_that_of_a_repository_it_is_installed_in(monkeypatch, tmp_path):
    package = tmp_path / ".venv/lib/python3/site-packages/mabl/runs"
    package.mkdir(parents=True)
    git = ["git", "-C", tmp_path, "-c", "user.name=x", "-c", "user.email=x@example.org"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "theirs"], check=True)
    monkeypatch.setattr("mabl.runs.folder.__file__", str(package / "folder.py"))
    assert run_folder.git_commit() == "unknown"


def test_a_run_folder_holds_what_the_documentation_says(trained):
    present = {path.name for path in trained.iterdir()}
    assert present == {
        ".lock",
        "config.yaml",
        "versions.yaml",
        "metrics.jsonl",
        "curves.png",
        "tensorboard",
        "checkpoints",
    }
    config = yaml.safe_load((trained / "config.yaml").read_text())
    assert {name for name, value in config.items() if isinstance(value, dict)} == SECTIONS
    assert config["algo"] == "mabl" and config["imagination"]["n_starts"] == 16
    steps = [row["step"] for row in rows_of(trained)]
    assert steps == sorted(set(steps)) and steps[-1] >= 600
    last = rows_of(trained)[-1]
    for name in ("train/episode_return", "world_model/kl_agent", "behaviour/entropy"):
        assert name in last
    assert any("world_model/open_loop_obs_15" in row for row in rows_of(trained))


@pytest.mark.parametrize(
    ("number", "expected"), [(signal.SIGINT, cli.INTERRUPTED), (signal.SIGTERM, PREEMPTED)]
)
def test_a_signal_saves_and_the_run_can_be_resumed(mabl, tmp_path, number, expected):
    logdir = tmp_path / "runs"

    def interrupt():
        pattern = "test/coordination/mabl/seed_0/*/metrics.jsonl"
        while not any(path.stat().st_size for path in logdir.glob(pattern)):
            time.sleep(0.05)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=interrupt)
    thread.start()
    code, _, err = mabl("train", *TINY, "--total-steps=10000000", f"--logdir={logdir}")
    thread.join()
    assert code == expected and "interrupted at" in err and "mabl resume" in err
    (folder,) = logdir.glob("test/coordination/mabl/seed_0/*")
    (done,) = Checkpoints(folder / "checkpoints").steps
    assert rows_of(folder)[-1]["step"] == done
    assert mabl("resume", folder, f"--total-steps={done + 100}")[0] == 0
    assert rows_of(folder)[-1]["step"] >= done + 100


def test_seeds_of_one_program_have_their_own_folders(mabl, tmp_path):
    code, _, _ = mabl("train", *TINY, "--num-seeds=2", "--total-steps=600", f"--logdir={tmp_path}")
    assert code == 0
    folders = sorted(tmp_path.glob("test/coordination/mabl/seed_*/*"))
    assert [folder.parent.name for folder in folders] == ["seed_0", "seed_1"]
    first, second = map(rows_of, folders)
    assert first[-1]["world_model/loss"] != second[-1]["world_model/loss"]
    assert mabl("resume", folders[1], "--total-steps=700")[0] == 0


def test_one_agent_acts_with_its_own_policy(trained):
    policy = Policy.load(trained, greedy=False, seed=3)
    obs, available = np.zeros(6, np.float32), np.array([False, True, False, True])
    first = [policy.act(obs, available) for _ in range(20)]
    assert set(first) <= {1, 3} and all(isinstance(action, int) for action in first)
    again = Policy.load(trained, greedy=False, seed=3)
    assert [again.act(obs, available) for _ in range(20)] == first
    with pytest.raises(UserError, match=r"obs has shape \(5,\), the policy expects \(6,\)"):
        policy.act(np.zeros(5))
    with pytest.raises(UserError, match=r"available has shape \(3,\), the policy expects \(4,\)"):
        policy.act(obs, np.ones(3, bool))


def test_a_greedy_policy_starts_anew_after_reset(trained):
    policy = Policy.load(trained)
    before = policy._memory
    policy.act(np.ones(6))
    policy.reset()
    jax.tree.map(np.testing.assert_array_equal, before, policy._memory)


def test_a_team_acts_with_one_policy(trained):
    team = TeamPolicy.load(trained, greedy=False, seed=3)
    obs = np.zeros((2, 6), np.float32)
    available = np.array([[False, True, False, True], [True, False, False, True]])
    first = np.stack([team.act(obs, available) for _ in range(20)])
    assert set(first[:, 0]) <= {1, 3} and set(first[:, 1]) <= {0, 3}
    assert first.shape == (20, 2) and first.dtype == np.int32
    again = TeamPolicy.load(trained, greedy=False, seed=3)
    alive = np.ones(2, bool)
    assert (np.stack([again.act(obs, available, alive) for _ in range(20)]) == first).all()
    with pytest.raises(UserError, match=r"obs has shape \(6,\), the policy expects \(2, 6\)"):
        team.act(np.zeros(6))
    with pytest.raises(UserError, match=r"available has shape \(4,\), the policy expects \(2, 4\)"):
        team.act(obs, np.ones(4, bool))
    with pytest.raises(UserError, match=r"alive has shape \(3,\), the policy expects \(2,\)"):
        team.act(obs, available, np.ones(3, bool))


def test_a_team_starts_anew_after_reset(trained):
    """With the same random key it remembers after a reset what it did at the first row."""
    obs, other = np.ones((2, 6)), np.arange(12.0).reshape(2, 6)
    team = TeamPolicy.load(trained)
    key = team._key
    team.act(obs)
    first = team._memory
    team.act(other)
    going_on = team._memory
    team.reset()
    team._key = key
    team.act(obs)
    jax.tree.map(np.testing.assert_array_equal, first, team._memory)
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), first, going_on)
    assert any(jax.tree.leaves(changed))


def test_resuming_a_finished_run_says_so(trained, mabl):
    code, _, err = mabl("resume", trained)
    assert code == 2 and "has already done" in err and "larger --total-steps" in err


def test_eval_prints_one_json_object(trained, mabl):
    code, out, _ = mabl("eval", trained, "--episodes=10", "--json")
    numbers = json.loads(out)
    assert code == 0 and numbers["episodes"] == 10 and numbers["env"] == "test/coordination"
    assert numbers["episode_length"] == 4.0 and numbers["episode_length_std"] == 0.0
    assert 0 <= numbers["score"] <= 1 and numbers["episode_return"] == 4 * numbers["score"]
    assert json.loads(mabl("eval", trained, "--episodes=10", "--json")[1]) == numbers
    assert json.loads(mabl("eval", trained, "--sample", "--json")[1])["greedy"] is False


def test_eval_in_another_environment_says_what_does_not_fit(trained, mabl):
    code, _, err = mabl("eval", trained, "--env", "test/counting")
    assert code == 2 and err == (
        "mabl: test/counting has 4 observation features, the checkpoint expects 6: "
        "pass --env test/coordination\n"
    )


def test_a_damaged_config_is_named(trained, mabl, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    text = (copy / "config.yaml").read_text()
    for damage, message in (
        (text.replace("gamma: 0.99", "gama: 0.99"), "unknown config field 'mappo.gama'"),
        (text.replace("hidden: 16", "hidden: wide"), "config field world_model.hidden is 'wide'"),
        ("{", "is not readable YAML"),
    ):
        (copy / "config.yaml").write_text(damage)
        code, _, err = mabl("eval", copy)
        assert code == 2 and message in err and err.count("\n") == 1


def test_the_lists_name_everything(mabl):
    from mabl.algorithms.registry import ALGORITHMS, COLUMNS

    code, out, _ = mabl("algos")
    assert code == 0 and all(column.heading in out.splitlines()[0] for column in COLUMNS)
    # Long descriptions go on in a line of their own, whose first column is empty.
    listed = {line.split()[0]: line for line in out.splitlines()[1:] if line[1] != " "}
    assert set(listed) == set(ALGORITHMS) and "mabl" in listed
    for name, entry in ALGORITHMS.items():
        marks = ["yes" if getattr(entry, column.field) else "no" for column in COLUMNS]
        assert listed[name].split()[1 : 1 + len(COLUMNS)] == marks
        assert entry.description[:20] in listed[name]
    from mabl.envs import registry

    code, out, _ = mabl("envs")
    assert code == 0
    assert all(row.name in out for row in registry.names())


def test_help_is_readable(mabl):
    code, out, _ = mabl("--help")
    assert code == 0 and all(f"mabl {name}" in out for name in cli.COMMANDS)
    code, out, _ = mabl("train", "--help")
    assert code == 0 and "--total-steps" in out and "--mappo.ent-coef" in out
