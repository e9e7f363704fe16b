"""Checkpoints are whole or not used, and a stranger's do no harm."""

import errno
import json
import os
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mabl.errors import UserError
from mabl.runs import checkpoint
from mabl.runs.checkpoint import Checkpoints

FILES = ("policy.safetensors", "state.safetensors", "checksums.json")


def state_at(step: int) -> dict:
    """All kinds of leaves: a key, a scalar, nothing at all, and another layout than C's."""
    return {
        "key": jax.random.key(step),
        "steps": jnp.int32(step),
        "none": jnp.zeros((0, 3)),
        "bools": jnp.array([True, False]),
        "bits": jnp.array([step, 7], jnp.uint32),
        "turned": np.arange(6.0, dtype=np.float32).reshape(2, 3).T,
    }


def written(folder: Path, *steps: int) -> Checkpoints:
    checkpoints = Checkpoints.to_write(folder / "checkpoints", keep=2)
    for step in steps:
        checkpoints.save(step, {"w": jnp.full(5, step)}, state_at(step))
    return checkpoints


def assert_is(state: dict, step: int) -> None:
    expected = state_at(step)
    for name, leaf in state.items():
        if name == "key":
            leaf, expected[name] = map(jax.random.key_data, (leaf, expected[name]))
        assert leaf.dtype == expected[name].dtype
        np.testing.assert_array_equal(leaf, expected[name], err_msg=name)


def test_what_was_saved_comes_back_and_the_oldest_go(tmp_path):
    checkpoints = written(tmp_path, 10, 20, 30)
    assert checkpoints.steps == [30, 20]
    step, state = checkpoints.restore("state", state_at(0))
    assert step == 30
    assert_is(state, 30)
    step, policy = checkpoints.restore("policy", {"w": jnp.zeros(5, jnp.int32)})
    assert (policy["w"] == 30).all()


def flip_a_bit(content: bytes, at: int, bit: int) -> bytes:
    changed = bytearray(content)
    changed[at] ^= 1 << bit
    return bytes(changed)


DAMAGES = {
    "emptied": lambda content, draw: b"",
    "truncated": lambda content, draw: content[: draw.integers(1, len(content))],
    "lengthened": lambda content, draw: content + b"\0",
    "one bit flipped": lambda content, draw: flip_a_bit(
        content, draw.integers(len(content)), draw.integers(8)
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("file", FILES)
def test_a_damaged_file_is_named_and_the_checkpoint_before_it_is_used(file, damage, tmp_path):
    checkpoints = written(tmp_path, 10, 20)
    path = checkpoints.at(20) / file
    whole, draw = path.read_bytes(), np.random.default_rng(0)
    for _ in range(100 if damage == "one bit flipped" else 5):
        path.write_bytes(DAMAGES[damage](whole, draw))
        with pytest.warns(UserWarning, match=f"{file}.*older checkpoint"):
            step, state = checkpoints.restore("state", state_at(0))
        assert step == 10
        assert_is(state, 10)
    path.write_bytes(whole)
    assert checkpoints.restore("state", state_at(0))[0] == 20


@pytest.mark.parametrize("file", FILES)
def test_a_lost_file_is_damage_too(file, tmp_path):
    checkpoints = written(tmp_path, 10, 20)
    (checkpoints.at(20) / file).unlink()
    with pytest.warns(UserWarning, match=f"{file} is missing"):
        assert checkpoints.restore("state", state_at(0))[0] == 10


def test_a_policy_is_whole_if_its_own_file_is(tmp_path):
    checkpoints = written(tmp_path, 10, 20)
    (checkpoints.at(20) / "state.safetensors").write_bytes(b"")
    assert checkpoints.restore("policy", {"w": jnp.zeros(5, jnp.int32)})[0] == 20


def test_what_cannot_be_read_is_damage_too(tmp_path, monkeypatch):
    checkpoints = written(tmp_path, 10, 20)

    def refuse(path):
        if "step_20" in str(path):
            raise OSError(errno.EIO, "Input/output error", str(path))
        return whole(path)

    whole = checkpoint.fingerprint
    monkeypatch.setattr(checkpoint, "fingerprint", refuse)
    with pytest.warns(UserWarning, match="Input/output error"):
        assert checkpoints.restore("state", state_at(0))[0] == 10


def test_a_step_is_saved_once(tmp_path):
    checkpoints = written(tmp_path, 10)
    before = checkpoints.at(10).stat()
    checkpoints.save(10, {"w": jnp.full(5, 10)}, state_at(10))
    assert checkpoints.at(10).stat().st_ino == before.st_ino


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    """Sparse files declare what no disk holds."""
    checkpoints = written(tmp_path, 10)
    with (checkpoints.at(10) / "state.safetensors").open("r+b") as file:
        file.truncate(2**40)
    with pytest.raises(UserError, match=r"does not fit this run's config \(1099511627776 bytes\)"):
        checkpoints.restore("state", state_at(0))


def test_none_whole_is_said(tmp_path):
    checkpoints = written(tmp_path, 10)
    (checkpoints.at(10) / "state.safetensors").write_bytes(b"")
    with pytest.warns(UserWarning), pytest.raises(UserError, match="has no whole checkpoint"):
        checkpoints.restore("state", state_at(0))


def test_other_names_are_no_checkpoints(tmp_path):
    checkpoints = written(tmp_path, 10)
    for name in ("step_", "step_07", "step_-1", "step_٣", "step_1e9", "unfinished_20", "99"):
        (checkpoints.folder / name).mkdir()
    assert checkpoints.steps == [10]
    assert Checkpoints.to_write(checkpoints.folder, 2).steps == [10]
    assert not (checkpoints.folder / "unfinished_20").exists()


def test_a_save_that_fails_leaves_the_others_and_no_trace(tmp_path, monkeypatch):
    checkpoints = written(tmp_path, 10)

    def refuse(path):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(checkpoint, "fingerprint", refuse)
    with pytest.raises(OSError, match="No space left"):
        checkpoints.save(20, {}, state_at(20))
    assert [path.name for path in checkpoints.folder.iterdir()] == ["step_10"]


def test_a_checkpoint_of_other_arrays_does_not_fit(tmp_path):
    checkpoints = written(tmp_path, 10)
    for like in (
        {**state_at(0), "more": jnp.zeros(3)},
        {**state_at(0), "steps": jnp.zeros(2, jnp.int32)},
        {**state_at(0), "steps": jnp.float32(0)},
        {name: leaf for name, leaf in state_at(0).items() if name != "steps"},
    ):
        with pytest.raises(UserError, match=r"does not fit this run's config \((more|steps)\)"):
            checkpoints.restore("state", like)


class Bomb:
    """Pickled, it is code."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def forge(checkpoints: Checkpoints, content: bytes) -> None:
    """A state that its checksum calls whole."""
    here = checkpoints.at(20)
    (here / "state.safetensors").write_bytes(content)
    sums = {path.name: checkpoint.fingerprint(path) for path in here.glob("*.safetensors")}
    (here / "checksums.json").write_text(json.dumps(sums))


def header(**entries: object) -> bytes:
    text = json.dumps(entries).encode()
    return len(text).to_bytes(8, "little") + text


HUGE = 2**50
FORGERIES = {
    "pickle": lambda path: pickle.dumps(Bomb(path)),
    "zip": lambda path: b"PK\3\4" + bytes(100),
    "header of petabytes": lambda path: HUGE.to_bytes(8, "little") + b"{}",
    "array of petabytes": lambda path: header(
        steps={"dtype": "F32", "shape": [HUGE], "data_offsets": [0, 4 * HUGE]}
    ),
    "array past the end": lambda path: (
        header(steps={"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}) + bytes(4)
    ),
    "sizes that overflow": lambda path: header(
        steps={"dtype": "F32", "shape": [2**62, 2**62], "data_offsets": [0, 0]}
    ),
    "negative sizes": lambda path: header(
        steps={"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}
    ),
    "names of other places": lambda path: header(
        **{f"../../{path}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}}
    ),
    "types that numpy lacks": lambda path: (
        header(steps={"dtype": "F8_E4M3", "shape": [4], "data_offsets": [0, 4]}) + bytes(4)
    ),
    "deep nesting": lambda path: len(b"[" * 9999).to_bytes(8, "little") + b"[" * 9999,
}


@pytest.mark.parametrize("forgery", FORGERIES)
def test_a_strangers_file_is_refused_before_anything_comes_of_it(forgery, tmp_path):
    checkpoints = written(tmp_path, 20)
    forge(checkpoints, FORGERIES[forgery](tmp_path / "owned"))
    if forgery in ("names of other places", "types that numpy lacks"):
        with pytest.raises(UserError, match="does not fit"):
            checkpoints.restore("state", state_at(0))
    else:
        with pytest.warns(UserWarning, match="is damaged"), pytest.raises(UserError):
            checkpoints.restore("state", state_at(0))
    assert not (tmp_path / "owned").exists()
