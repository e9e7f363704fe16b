"""Checkpoints: all that decides a run's future, written whole or not at all, the last K kept.

checkpoints/step_N/policy.safetensors   what acting needs: filter and actor
                   state.safetensors    everything
                   checksums.json       size and SHA-256 of both

Arrays are stored under readable names. Reading one runs no code, and takes no more memory than the
arrays that are wanted.
"""

import hashlib
import json
import math
import os
import re
import shutil
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from mabl.errors import UserError
from mabl.runs.files import flush_folder, flush_to_disk

T = TypeVar("T")

ITEMS = ("policy", "state")
CHECKSUMS = "checksums.json"
CHECKSUMS_SIZE = 4096
"""Bytes of it, at most."""
HEADER_SIZE = 4_000_000
"""Bytes for names and shapes in a file of arrays, at most."""
PREFIX = "step_"
UNFINISHED = "unfinished_"
"""Of a checkpoint's folder while it is written."""


class Damaged(Exception):
    """A checkpoint is not as it was written."""


class Checkpoints:
    """The checkpoints of one run folder."""

    def __init__(self, folder: Path, keep: int = 2):
        """Raises UserError if there is no such folder."""
        self.folder, self._keep = folder, keep
        if not folder.is_dir():
            raise UserError(f"{folder.parent} has no checkpoints: train it first with mabl train")

    @classmethod
    def to_write(cls, folder: Path, keep: int) -> "Checkpoints":
        """To be written by this process alone: what another did not finish is removed."""
        folder.mkdir(exist_ok=True)
        for unfinished in folder.glob(f"{UNFINISHED}*"):
            shutil.rmtree(unfinished)
        return cls(folder, keep)

    @property
    def steps(self) -> list[int]:
        """Environment steps of all checkpoints, newest first."""
        named = (
            re.fullmatch(f"{PREFIX}(0|[1-9][0-9]*)", path.name) for path in self.folder.iterdir()
        )
        return sorted((int(match[1]) for match in named if match), reverse=True)

    def at(self, step: int) -> Path:
        """The folder of one checkpoint."""
        return self.folder / f"{PREFIX}{step}"

    def save(self, step: int, policy: Any, state: Any) -> None:
        """Write one checkpoint, then let go of the oldest. Raises OSError, and leaves no trace.

        One that is there already is of the same run at the same step, and stays.
        """
        if step in self.steps:
            return
        unfinished = self.folder / f"{UNFINISHED}{step}"
        try:
            unfinished.mkdir()
            written = {}
            for item, tree in zip(ITEMS, (policy, state), strict=True):
                path = unfinished / f"{item}.safetensors"
                write(path, to_arrays(tree))
                written[path.name] = fingerprint(path)
            (unfinished / CHECKSUMS).write_text(json.dumps(written))
            for path in unfinished.iterdir():
                with path.open("rb") as file:
                    flush_to_disk(file.fileno())
            flush_folder(unfinished)
            unfinished.rename(self.at(step))
        except BaseException:
            shutil.rmtree(unfinished, ignore_errors=True)
            raise
        flush_folder(self.folder)
        for old in self.steps[self._keep :]:
            shutil.rmtree(self.at(old))

    def restore(self, item: str, like: T) -> tuple[int, T]:
        """An item of the newest checkpoint that is whole, and its step; see `restore`."""
        step, (tree,) = restore([self], item, like)
        return step, tree

    def forget_after(self, step: int) -> None:
        """Remove what is past `step`, as it is not whole: the run will produce it again."""
        for later in self.steps:
            if later > step:
                shutil.rmtree(self.at(later))


def restore(runs: Sequence[Checkpoints], item: str, like: T) -> tuple[int, list[T]]:
    """An item of the newest checkpoint that is whole in each run, and its step.

    `like` has arrays or their shapes, as one run's. For `policy`, its own file decides, for `state`
    all do. Warns of damaged checkpoints. Raises UserError if none is whole, or if that one has
    other arrays than `like`.
    """
    wanted = jax.eval_shape(to_arrays, like)
    items = ITEMS[: ITEMS.index(item) + 1]

    def read_one(checkpoint: Path) -> T:
        check_whole(checkpoint, items, tree_bytes(wanted))
        return from_arrays(like, read(checkpoint / f"{item}.safetensors", wanted))

    for step in shared_steps(runs):
        try:
            return step, [read_one(run.at(step)) for run in runs]
        except (Damaged, OSError) as damage:
            warnings.warn(f"{damage}: an older checkpoint is needed", stacklevel=2)
    raise UserError(f"{runs[0].folder.parent} has no whole checkpoint: train it again")


def shared_steps(runs: Sequence[Checkpoints]) -> list[int]:
    """Environment steps of checkpoints that all of these runs have, newest first."""
    return [step for step in runs[0].steps if all(step in run.steps for run in runs[1:])]


def check_whole(checkpoint: Path, items: Sequence[str], size: int) -> None:
    """Raises Damaged unless these files of a checkpoint are as they were written.

    Raises UserError, and does not read it, if one has more bytes than arrays of `size` bytes take.
    """
    checksums = checkpoint / CHECKSUMS
    try:
        with checksums.open("rb") as file:
            written = json.loads(file.read(CHECKSUMS_SIZE))
    except (OSError, ValueError, RecursionError) as error:
        raise Damaged(f"{checksums} is missing or damaged") from error
    if not isinstance(written, dict) or len(written) != len(ITEMS):
        raise Damaged(f"{checksums} is damaged")
    for path in (checkpoint / f"{item}.safetensors" for item in items):
        if not path.is_file():
            raise Damaged(f"{path} is missing")
        if path.stat().st_size > size + HEADER_SIZE:
            raise misfit(path, f"{path.stat().st_size} bytes")
        if fingerprint(path) != written.get(path.name):
            raise Damaged(f"{path} is damaged, or its checksum in {CHECKSUMS} is")


def tree_bytes(tree: Any) -> int:
    """Bytes of all arrays of a pytree (or of their shapes)."""
    return sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(tree))


def fingerprint(path: Path) -> dict[str, Any]:
    """By which a file is known to be as it was written."""
    with path.open("rb") as file:
        return {
            "sha256": hashlib.file_digest(file, "sha256").hexdigest(),
            "bytes": path.stat().st_size,
        }


def write(path: Path, arrays: dict[str, jax.Array]) -> None:
    """Arrays to a safetensors file. Raises OSError."""
    try:
        save_file({name: np.asarray(x, order="C") for name, x in arrays.items()}, path)
    except SafetensorError as error:
        code = re.search(r"os error (\d+)", str(error))
        if code is None:
            raise
        raise OSError(int(code[1]), os.strerror(int(code[1])), str(path)) from error


def read(path: Path, wanted: dict[str, jax.ShapeDtypeStruct]) -> dict[str, np.ndarray]:
    """Arrays of a file. Raises UserError unless it has exactly those that are wanted."""
    try:
        with safe_open(path, "numpy") as file:
            if other := set(file.keys()) ^ set(wanted):
                raise misfit(path, min(other))
            arrays = {name: file.get_tensor(name) for name in wanted}
    except (SafetensorError, AttributeError, TypeError) as error:  # the latter: numpy lacks a type
        raise Damaged(f"{path} is damaged ({error})") from error
    for name, array in arrays.items():
        if (array.shape, array.dtype) != (wanted[name].shape, wanted[name].dtype):
            raise misfit(path, name)
    return arrays


def misfit(path: Path, name: str) -> UserError:
    """What to say of a file that has another array, or none."""
    return UserError(
        f"{path} does not fit this run's config ({name}): use it with the mabl that wrote it"
    )


def to_arrays(tree: Any) -> dict[str, jax.Array]:
    """Leaves by readable path; random keys as their data."""
    return {name: jax.random.key_data(leaf) if is_key(leaf) else leaf for name, leaf in named(tree)}


def from_arrays(like: T, arrays: dict[str, Any]) -> T:
    """The inverse of `to_arrays`, for a tree structured like `like`."""
    leaves = []
    for name, leaf in named(like):
        array = jnp.asarray(np.asarray(arrays[name]))
        leaves.append(jax.random.wrap_key_data(array) if is_key(leaf) else array)
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def named(tree: Any) -> list[tuple[str, Any]]:
    """Leaves with their paths, such as `learner.model.filter.encoder.layers.0.weight`."""
    paths = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in paths]


def is_key(leaf: Any) -> bool:
    """True for typed random keys."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
