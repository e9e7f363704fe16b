"""The fault program: injects faults, and reports how many were survived and what was lost.

uv run python -m tests.faults --kills 30 --fuzz 250 --out docs/results/raw/reliability/faults.json
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.table import Table
from tests.faults.disks import Full, full, limited, read_only
from tests.faults.killed import kill_again_and_again, train
from tests.runs.test_checkpoint import DAMAGES, FILES

from mabl.runs.checkpoint import Checkpoints
from mabl.runs.folder import read_config
from mabl.training.programs import programs

ENVIRONMENTS_AND_GRADIENTS = ("tests/envs/test_pool.py", "tests/training/test_faults.py")

SHOW_CASES = ("--hypothesis-show-statistics",)

console = Console(stderr=True)


class Result(NamedTuple):
    """Faults of one kind."""

    fault: str
    injected: int
    survived: int
    lost: int
    """Rows, checkpoints or runs that are not what they would be without the faults."""
    seconds: float
    detail: dict


def kills(place: Path, number: int) -> Result:
    """SIGKILL at random moments, saves among them."""
    began = time.monotonic()
    report = kill_again_and_again(place / "kills", number, "mabl", 0, console.print)
    seconds = time.monotonic() - began
    assert report.during_saves, "no kill hit a save: take more"
    lost = report.lost
    detail = report._asdict()
    return Result("SIGKILL", report.kills, report.kills - lost, lost, seconds, detail)


def damages(place: Path, each: int) -> Result:
    """Every file of the killed run's newest checkpoint, spoiled in every way."""
    began, draw = time.monotonic(), np.random.default_rng(0)
    folder = place / "kills" / "killed"
    checkpoints = Checkpoints(folder / "checkpoints")
    newest, older = checkpoints.steps
    like = jax.eval_shape(programs(read_config(folder)).training.init, jax.random.key(0))
    injected = named = fallen_back = 0
    for file in FILES:
        path = checkpoints.at(newest) / file
        whole = path.read_bytes()
        for how in DAMAGES:
            for _ in range(1 if how in ("emptied", "lengthened") else each):
                path.write_bytes(DAMAGES[how](whole, draw))
                with warnings.catch_warnings(record=True) as said:
                    step, _ = checkpoints.restore("state", like)
                injected += 1
                named += file in str(said[0].message) if said else 0
                fallen_back += step == older
        path.write_bytes(whole)
    survived = min(named, fallen_back)
    detail = {"named": named, "fallen_back": fallen_back}
    seconds = time.monotonic() - began
    return Result("damaged file", injected, survived, injected - survived, seconds, detail)


def disks(place: Path) -> list[Result]:
    """Full, limited and read-only."""
    results = []
    whole = train(place / "room", "mappo", 2000)
    for name, do in (("full disk", full), ("limit on files", limited)):
        began = time.monotonic()
        report: Full = do(place, whole)
        good = report.refused.code == 2 and report.equal
        detail = {"said": report.refused.said.splitlines()[-1], "kept": report.kept}
        seconds = time.monotonic() - began
        results.append(Result(name, 1, int(good), int(not good), seconds, detail))
    began = time.monotonic()
    refused = read_only(place / "there", whole)
    good = refused.code == 2
    detail = {"said": refused.said.splitlines()[-1]}
    seconds = time.monotonic() - began
    return [*results, Result("read-only folder", 1, int(good), int(not good), seconds, detail)]


def tests(name: str, cases: int, *paths: str) -> Result:
    """Tests in a process of their own, with so many cases for each that draws them."""
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:xdist", "-o", "addopts=-q", *SHOW_CASES, *paths],
        env=os.environ | {"MABL_FUZZ": str(cases)},
        capture_output=True,
        text=True,
    )
    last = done.stdout.strip().splitlines()[-1]
    counts = {word: int(n) for n, word in re.findall(r"(\d+) (passed|failed|error)", last)}
    failed = counts.get("failed", 0) + counts.get("error", 0)
    if failed:
        console.print(done.stdout)
    reports = done.stdout.split("Hypothesis Statistics")[-1].split("\ntests/")[1:]
    drawn = [sum(map(int, re.findall(r"(\d+) passing", report))) for report in reports]
    injected = sum(counts.values()) - len(drawn) + sum(drawn)
    seconds = time.monotonic() - began
    return Result(name, injected, injected - failed, failed, seconds, {"pytest": last})


def main() -> None:
    """Inject all, print a table, write the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--damages", type=int, default=50, help="of each kind, for each file")
    parser.add_argument("--fuzz", type=int, default=250, help="cases for each of the fuzz tests")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        results = [kills(place, given.kills), damages(place, given.damages), *disks(place)]
    results += [
        tests("environments and gradients", 40, *ENVIRONMENTS_AND_GRADIENTS),
        tests("strangers' and damaged files", 40, "tests/runs"),
        tests("bad input", given.fuzz, "tests/faults/test_fuzz.py"),
    ]
    table = Table("fault", "injected", "survived", "lost", "seconds")
    for result in results:
        fault, *counts, seconds, _ = result
        table.add_row(fault, *map(str, counts), f"{seconds:.0f}")
    Console().print(table)
    if given.out:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps([result._asdict() for result in results], indent=1) + "\n")
    sys.exit(any(result.lost for result in results))


if __name__ == "__main__":
    main()
