"""Whatever is given ends in success, or in a message and exit code 2: no traceback, no hang.

`MABL_FUZZ=N` draws N cases for each test; the fault program draws many more than CI does.
"""

import contextlib
import io
import json
import os
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.runs.test_checkpoint import forge, state_at, written
from tests.tiny import flags

from mabl import cli
from mabl.errors import UserError
from mabl.runs.metrics import MetricsLog, read
from mabl.training import curves
from mabl.training import run as training_run

CASES = int(os.environ.get("MABL_FUZZ", "40"))
FUZZ = settings(
    max_examples=CASES,
    deadline=60_000,
    derandomize="MABL_FUZZ" not in os.environ,
    database=None,
    suppress_health_check=list(HealthCheck),
)


def ends_well(*arguments: str) -> None:
    """Run a command in this process and look at how it ends."""
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.MonkeyPatch.context() as patch,
        pytest.raises(SystemExit) as exit_,
    ):
        patch.setattr("sys.argv", ["mabl", *arguments])
        cli.main()
    said = err.getvalue() + out.getvalue()
    assert exit_.value.code in (0, 1, 2), arguments
    assert "Traceback" not in said
    if exit_.value.code == 2:
        assert err.getvalue().splitlines()[-1].startswith("mabl: "), (arguments, said)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short run of an algorithm whose programs are traced quickly."""
    logdir = tmp_path_factory.mktemp("runs")
    given = [*flags("mappo", "test/coordination"), "--total-steps=100", f"--logdir={logdir}"]
    assert cli.run(["train", *given]) == 0
    (folder,) = logdir.glob("test/coordination/mappo/seed_0/*")
    return folder


words = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=12)
values = st.one_of(
    words,
    st.integers().map(str),
    st.floats().map(str),
    st.sampled_from(["smax/3m", "test/coordination", "pettingzoo:os:system", "mabl", "1e999"]),
)
names = st.sampled_from(
    [
        "env",
        "algo",
        "preset",
        "seed",
        "num-seeds",
        "total-steps",
        "logdir",
        "env-kwargs",
        "episodes",
        "training.num-envs",
        "mappo.gamma",
        "world-model.hidden",
        "num-devices",
        "workers",
        "policy",
        "precision",
        "video",
        "json",
        "against",
        "repeats",
        "parts",
        "trust",
        "help",
        "greedy",
    ]
)
arguments = st.lists(
    st.one_of(
        st.builds("--{}={}".format, st.one_of(names, words), values),
        st.builds("--{}".format, st.one_of(names, words)),
        values,
    ),
    max_size=5,
)


@FUZZ
@given(st.one_of(st.sampled_from([*cli.COMMANDS]), words), arguments)
def test_command_lines(nowhere, command, given):
    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(nowhere):
        # What has been understood is not carried out: that is for other tests.
        ended = training_run.Outcome([], None, finished=True)
        patch.setattr(training_run, "train", lambda config: ended)
        patch.setattr("mabl.envs.registry.names", refuse)
        patch.setattr("mabl.evaluation.evaluate", refuse)
        patch.setattr("mabl.playing.film", refuse)
        patch.setattr("mabl.checking.check", refuse)
        patch.setattr("mabl.bench.measure", refuse)
        ends_well(command, *given)


def refuse(*_, **__):
    raise UserError("this would take its time")


@pytest.fixture(scope="module")
def nowhere(tmp_path_factory):
    """A folder of no importance."""
    return tmp_path_factory.mktemp("nowhere")


junk = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), words),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(words, inner, max_size=3)),
    max_leaves=5,
)


@FUZZ
@given(st.data())
def test_configs(trained, data):
    """Fields replaced, added and removed; then bytes."""
    folder = copy_of(trained)
    path = folder / "config.yaml"
    config = yaml.safe_load(path.read_text())
    for _ in range(data.draw(st.integers(1, 2))):
        sections = [value for value in config.values() if isinstance(value, dict)]
        section = data.draw(st.sampled_from([config, *sections]))
        name = data.draw(st.one_of(st.sampled_from([*section]), words)) if section else "x"
        if data.draw(st.booleans()):
            section[name] = data.draw(junk)
        else:
            section.pop(name, None)
    content = yaml.safe_dump(config).encode()
    if data.draw(st.booleans()):
        content = mangled(content, data)
    path.write_bytes(content)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mabl.evaluation.evaluate", refuse)
        ends_well("eval", str(folder))


def mangled(content: bytes, data: st.DataObject) -> bytes:
    """A stretch of it replaced."""
    start = data.draw(st.integers(0, len(content)))
    end = data.draw(st.integers(start, min(len(content), start + 50)))
    return content[:start] + data.draw(st.binary(max_size=20)) + content[end:]


def copy_of(folder: Path) -> Path:
    """A copy that may be spoiled; the one before it is removed."""
    copy = folder.parent / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    return copy


@FUZZ
@given(st.data())
def test_metrics(trained, data):
    folder = copy_of(trained)
    path = folder / "metrics.jsonl"
    content = path.read_bytes()
    line = json.dumps(data.draw(st.one_of(junk, st.fixed_dictionaries({"step": junk, "x": junk}))))
    content += data.draw(st.sampled_from([b"", line.encode() + b"\n"]))
    path.write_bytes(mangled(content, data) if data.draw(st.booleans()) else content)
    with contextlib.suppress(UserError):
        rows = read(folder)
        curves.draw(rows[:2], "title", folder / "curves.png")
        MetricsLog(folder, resume_at=50).close()
        assert all(row["step"] <= 50 for row in read(folder))


@FUZZ
@given(st.data())
def test_arrays(tmp_path_factory, data):
    checkpoints = written(tmp_path_factory.mktemp("arrays"), 20)
    content = (checkpoints.at(20) / "state.safetensors").read_bytes()
    forge(checkpoints, mangled(content, data))
    with no_warnings(), contextlib.suppress(UserError):
        _, state = checkpoints.restore("state", state_at(0))
        assert np.asarray(state["turned"]).shape == (3, 2)


@contextlib.contextmanager
def no_warnings():
    """Damage is warned of; here that is no error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


KINDS = ("nothing", "folder", "empty", "junk")


@settings(FUZZ, max_examples=max(10, CASES // 4))
@given(st.data())
def test_run_folders(trained, data):
    """Something else lies where a file should."""
    folder = copy_of(trained)
    paths = sorted(path for path in folder.rglob("*") if "tensorboard" not in path.parts)
    path, kind = data.draw(st.sampled_from(paths)), data.draw(st.sampled_from(KINDS))
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind != "nothing":
        path.write_bytes(b"" if kind == "empty" else data.draw(st.binary(max_size=100)))
    with no_warnings(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("mabl.evaluation.evaluate", refuse)
        ends_well("eval", str(folder))
        ends_well("resume", str(folder), "--total-steps=120")


NAMES = [
    "config.yaml",
    ".config.yaml",
    "versions.yaml",
    "metrics.jsonl",
    ".metrics.jsonl",
    "curves.png",
    ".curves.png",
    "tensorboard",
    "checkpoints",
    "checkpoints/step_7",
    "checkpoints/unfinished_7",
    ".lock",
    "videos",
    "anything",
]


@pytest.mark.parametrize("command", ["eval", "resume", "play"])
@pytest.mark.parametrize("kind", ["link to a file", "link to a folder", "pipe"])
@pytest.mark.parametrize("name", NAMES)
def test_links_and_pipes_are_refused(name, kind, command, trained, tmp_path):
    folder, elsewhere = copy_of(trained), tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "file").write_text("precious")
    path = folder / name
    if path.exists():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to(elsewhere / "file" if kind == "link to a file" else elsewhere)
    ends_well(command, str(folder))
    assert [p.name for p in elsewhere.iterdir()] == ["file"]
    assert (elsewhere / "file").read_text() == "precious"
