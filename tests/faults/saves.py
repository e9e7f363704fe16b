"""Saves that die at every one of their operations on files in turn: a whole checkpoint must remain.

It forks, so it is a program of its own: `python -m tests.faults.saves FOLDER` prints how often it
died.
"""

import os
import sys
from pathlib import Path

import numpy as np
from tests.faults.fragile import die_at

from mabl.runs.checkpoint import ITEMS, Checkpoints, check_whole

STATE = {"x": np.arange(10.0)}


def save_and_die(folder: Path, keep: int, step: int, operation: int) -> bool:
    """Whether a process that saves lived to its end."""
    child = os.fork()
    if child == 0:
        die_at(operation)
        Checkpoints.to_write(folder, keep).save(step, STATE, STATE)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def main(folder: Path) -> None:
    """Die at the first operation, then at the second, until a save gets through."""
    died = 0
    for keep in (1, 2):
        place = folder / f"killed-{keep}"
        Checkpoints.to_write(place, keep).save(0, STATE, STATE)
        step, operation, done = 1, 1, False
        while not done:
            before = Checkpoints(place).steps[0]
            done = save_and_die(place, keep, step, operation)
            died += not done
            newest = Checkpoints(place).steps[0]
            assert newest in (before, step), (keep, operation, newest)
            check_whole(Checkpoints(place).at(newest), ITEMS, 10**6)
            assert len(Checkpoints(place).steps) <= keep + 1
            step, operation = step + 1, operation + 1
    print(died)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
