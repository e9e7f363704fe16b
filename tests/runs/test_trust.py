"""A stranger's run folder runs no code."""

import re
import shutil
from pathlib import Path

import pytest
import yaml

import mabl
from mabl.algorithms.presets import preset
from mabl.errors import UserError
from mabl.runs.folder import read_config, write_config

FORBIDDEN = (
    r"pickle|marshal|shelve|joblib|torch\.load|allow_pickle|jsonpickle"
    r"|yaml\.load|yaml\.unsafe|\beval\(|\bexec\(|os\.system|shell=True"
)
ATTACK = "pettingzoo:os:mkdir"


@pytest.mark.parametrize("path", sorted(Path(mabl.__file__).parent.rglob("*.py")), ids=str)
def test_no_file_is_read_by_what_runs_code(path):
    found = re.findall(FORBIDDEN, path.read_text())
    assert not found


@pytest.fixture
def run(tmp_path):
    """A folder whose environment is code of this user's own choice."""
    folder = tmp_path / "run"
    folder.mkdir()
    write_config(folder, preset("quick", "pettingzoo:mpe2.simple_spread_v3", "mabl"))
    return folder


def attack(folder: Path, target: Path) -> None:
    path = folder / "config.yaml"
    config = yaml.safe_load(path.read_text())
    config |= {"env": ATTACK, "env_kwargs": [f"path={target}"]}
    path.write_text(yaml.safe_dump(config))


def test_ones_own_run_may_name_its_environment(run):
    assert read_config(run).env == "pettingzoo:mpe2.simple_spread_v3"


@pytest.mark.parametrize("command", ["eval", "resume", "play"])
def test_code_that_a_stranger_names_is_not_run(command, run, mabl, tmp_path):
    attack(run, tmp_path / "owned")
    (run / "checkpoints").mkdir()
    code, _, err = mabl(command, run)
    assert code == 2 and f"its environment {ATTACK} is code that would be run" in err
    assert "add --trust" in err and not (tmp_path / "owned").exists()
    code, _, err = mabl(command, run, "--trust")  # the same attack, let in
    assert code != 0 and (tmp_path / "owned").exists()


def test_a_signature_is_of_one_config_and_one_user(run, tmp_path, monkeypatch):
    other = tmp_path / "other"
    shutil.copytree(run, other)
    assert read_config(other).env.startswith("pettingzoo:")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "another-user"))
    with pytest.raises(UserError, match="was not written by your mabl"):
        read_config(run)
    (run / "config.signature").unlink()
    with pytest.raises(UserError, match="was not written by your mabl"):
        read_config(run)


def test_a_user_without_a_home_signs_nothing(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "file"))
    write_config(tmp_path, preset("quick", "pettingzoo:mpe2.simple_spread_v3", "mabl"))
    with pytest.raises(UserError, match="was not written by your mabl"):
        read_config(tmp_path)
    assert read_config(tmp_path, trust=True).env.startswith("pettingzoo:")


def test_yaml_makes_no_objects(run):
    (run / "config.yaml").write_text("env: !!python/object/apply:os.getcwd []\n")
    with pytest.raises(UserError, match="is not readable YAML"):
        read_config(run)


def test_aliases_that_multiply_are_said_in_short(run):
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    for before, name in zip("abcdefgh", "bcdefghi", strict=True):
        lines.append(f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]")
    (run / "config.yaml").write_text("\n".join([*lines, "seed: *i"]))
    with pytest.raises(UserError) as error:
        read_config(run)
    assert len(str(error.value)) < 2000
