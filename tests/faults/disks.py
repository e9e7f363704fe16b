"""Disks that are full, or for reading only: small file systems of this test's own, in memory."""

import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from tests.faults.killed import MABL, newest, numbers, outcome


class Refused(NamedTuple):
    """How a run ended that could not write."""

    code: int
    said: str


@contextmanager
def small_disk(place: Path, mebibytes: int) -> Iterator[Path]:
    """A file system in memory. Raises CalledProcessError where this user may not mount one."""
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={mebibytes}m", "mabl", place], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", place], check=True)


def fill(disk: Path) -> Path:
    """Leave no room; the file that takes it all."""
    filler = disk / "filler"
    with suppress(OSError), filler.open("wb") as file:
        while True:
            file.write(bytes(4096))
            file.flush()
    return filler


class Full(NamedTuple):
    """A run whose disk was full for a while."""

    refused: Refused
    kept: int
    """Its newest checkpoint then."""
    equal: bool
    """Resumed with room, it ended with the numbers of a run that always had room."""


def full(place: Path, whole: Path) -> Full:
    """A disk fills while a run writes to it; room is made, and the run is resumed.

    `whole` is the same run, which had room.
    """
    with small_disk(place / "disk", 64) as disk:
        return refused_and_resumed(disk / "run", whole, fill=lambda: fill(disk))


def limited(place: Path, whole: Path) -> Full:
    """The same where no file may be longer than ten blocks, which needs no rights."""
    return refused_and_resumed(place / "limited", whole, limit=10)


def refused_and_resumed(
    folder: Path, whole: Path, fill: Callable[[], Path] | None = None, limit: int | None = None
) -> Full:
    """What became of a run in `folder` when its disk was filled, or files were limited."""
    folder.mkdir()
    shutil.copy(whole / "config.yaml", folder)
    limited = ["sh", "-c", f'ulimit -f {limit}; exec "$@"', "sh"] if limit else []
    command = [*limited, *MABL, "resume", folder]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    if fill:
        while newest(folder / "checkpoints") == 0 and process.poll() is None:
            time.sleep(0.005)
        filler = fill()
    said = process.communicate()[1]
    kept = newest(folder / "checkpoints")
    if fill:
        filler.unlink()
    if kept < newest(whole / "checkpoints"):
        outcome(["resume", folder])
    return Full(Refused(process.returncode, said), kept, numbers(folder) == numbers(whole))


def read_only(place: Path, run: Path) -> Refused:
    """`mabl resume` of a run that lies where nobody may write."""
    place.mkdir()
    subprocess.run(["mount", "--bind", run, place], check=True)
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", place], check=True)
        command = [*MABL, "resume", place, "--total-steps=9999"]
        done = subprocess.run(command, capture_output=True, text=True)
        return Refused(done.returncode, done.stderr)
    finally:
        subprocess.run(["umount", "-l", place], check=True)
