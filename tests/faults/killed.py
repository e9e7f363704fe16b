"""A run that is killed again and again must end as if nothing had happened."""

import json
import math
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from tests.tiny import flags

from mabl.runs.checkpoint import Checkpoints

ENV = "test/coordination"
EVERY = "--training.checkpoint-every=40"
"""Environment steps between checkpoints: one for each cycle, so that many kills hit a save."""
MABL = (sys.executable, "-m", "tests.faults.fragile")
FILES = ("policy.safetensors", "state.safetensors")
STEPS_PER_KILL = 200
OPERATIONS_PER_KILL = 60
"""At most: those of starting, and of some cycles with their saves."""


class Kill(NamedTuple):
    """When a process is killed: the first that holds."""

    operation: int | None = None
    """The process is about to do so many things to files of its run folder."""
    checkpoint: float = math.inf
    """The folder has a checkpoint at so many steps,"""
    seconds: float = 0.0
    """and so many seconds have passed since then."""


NEVER = Kill()


def outcome(arguments: list[object], checkpoints: Path | None = None, kill: Kill = NEVER) -> int:
    """Exit code of `mabl` with these arguments, -9 if it was killed."""
    fragile = [f"--kill-at={kill.operation}"] if kill.operation else []
    command = [*MABL, *fragile, *map(str, arguments)]
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, stdout=said, stderr=said)
        while process.poll() is None:
            if checkpoints and newest(checkpoints) >= kill.checkpoint:
                time.sleep(kill.seconds)
                process.kill()
                process.wait()
            time.sleep(0.005)
        said.seek(0)
        assert process.returncode in (0, -9), said.read().decode()
    return process.returncode


def train(logdir: Path, algo: str, steps: int) -> Path:
    """A whole run's folder."""
    given = [*flags(algo, ENV), EVERY, f"--total-steps={steps}", f"--logdir={logdir}"]
    outcome(["train", *given])
    (folder,) = logdir.glob(f"{ENV}/{algo}/seed_0/*")
    return folder


def numbers(folder: Path) -> tuple[list[dict], bytes]:
    """What must be equal: rows of metrics but for times, and the newest checkpoint's bytes."""
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    rows = [
        {name: value for name, value in json.loads(line).items() if not name.startswith("time/")}
        for line in lines
    ]
    checkpoints = Checkpoints(folder / "checkpoints")
    last = checkpoints.at(checkpoints.steps[0])
    return rows, b"".join((last / name).read_bytes() for name in FILES)


class Report(NamedTuple):
    """What became of a run that was killed."""

    kills: int
    during_saves: int
    """Kills that left an unfinished checkpoint."""
    steps_after: list[int]
    """Newest checkpoint after each kill."""
    rows: int
    equal: bool
    """Metrics and the last checkpoint are those of the undisturbed run."""

    @property
    def lost(self) -> int:
        """Checkpoints that a kill took away, and an end that differs."""
        pairs = pairwise(self.steps_after)
        return sum(after < before for before, after in pairs) + (not self.equal)


def kill_again_and_again(
    logdir: Path, kills: int, algo: str, seed: int, say: Callable[[str], None] = print
) -> Report:
    """Train undisturbed; then begin the same run, kill and resume it, again and again; compare."""
    draw, steps = random.Random(seed), STEPS_PER_KILL * (kills + 1)
    undisturbed = train(logdir, algo, steps)
    expected = numbers(undisturbed)
    say(f"undisturbed: {len(expected[0])} rows")
    folder = logdir / "killed"
    folder.mkdir()
    shutil.copy(undisturbed / "config.yaml", folder)  # as if killed before the first checkpoint
    checkpoints, during_saves, steps_after = folder / "checkpoints", 0, [0]
    while len(steps_after) <= kills:
        if draw.random() < 0.5:
            kill = Kill(operation=draw.randint(1, OPERATIONS_PER_KILL))
        else:
            at = steps_after[-1] + draw.randint(0, STEPS_PER_KILL)
            kill = Kill(checkpoint=at, seconds=draw.uniform(0, 0.1 if at else 10))
        if outcome(["resume", folder], checkpoints, kill) == 0:
            break
        unfinished = any(checkpoints.glob("unfinished_*"))
        during_saves += unfinished
        steps_after.append(newest(checkpoints))
        where = ", in a save" if unfinished else ""
        say(f"kill {len(steps_after) - 1}: checkpoint at {steps_after[-1]}{where}")
    if newest(checkpoints) < steps:
        outcome(["resume", folder])
    found = numbers(folder)
    return Report(len(steps_after) - 1, during_saves, steps_after, len(found[0]), found == expected)


def newest(checkpoints: Path) -> int:
    """Steps of the newest checkpoint, 0 without any."""
    return next(iter(Checkpoints(checkpoints).steps), 0) if checkpoints.is_dir() else 0
