"""A stranger's run folder runs no code."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

import mabl
from mabl.algorithms.presets import preset
from mabl.envs import registry
from mabl.errors import UserError
from mabl.runs.folder import read_config, write_config

FORBIDDEN = (
    r"pickle|marshal|shelve|joblib|torch\.load|allow_pickle|jsonpickle"
    r"|(?<!\w)yaml\.load\((?!text, PlainLoader)|yaml\.unsafe"
    r"|\beval\(|\bexec\(|os\.system|shell=True"
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
    assert code == 2 and f"was not written by your mabl, and would have {ATTACK} made" in err
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


def test_an_environment_with_arguments_is_only_made_for_those_who_trust(tmp_path):
    config = preset("quick", "mamujoco/Ant", "mabl")
    write_config(tmp_path, replace(config, env_kwargs=("xml_file=/etc/passwd",)))
    assert read_config(tmp_path).env_kwargs
    path = tmp_path / "config.yaml"
    path.write_text(path.read_text().replace("passwd", "shadow"))
    with pytest.raises(UserError, match="would have mamujoco/Ant made with xml_file=/etc/shadow"):
        read_config(tmp_path)


def test_built_in_environments_are_not_looked_for_in_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "smac").mkdir()
    (tmp_path / "smac" / "env.py").write_text("open('owned', 'w')")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError):
        registry.make("smac/3m")
    assert not (tmp_path / "owned").exists()


def test_aliases_that_multiply_are_not_read(run):
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    for before, name in zip("abcdefgh", "bcdefghi", strict=True):
        lines.append(f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]")
    merges = ["a: &a {x: 1}", "b: &b {<<: [*a, *a]}"]
    for text in ("\n".join([*lines, "seed: *i"]), "\n".join(merges)):
        (run / "config.yaml").write_text(text)
        with pytest.raises(UserError, match="is not readable YAML"):
            read_config(run)
