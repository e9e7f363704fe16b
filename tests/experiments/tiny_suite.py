"""A suite whose jobs take seconds, as a user would write it."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import yaml
from filelock import FileLock, Timeout
from tests.tiny import SIZES, tiny

from mabl.algorithms.registry import entry
from mabl.experiments.jobs import plain

ENV = "test/coordination"


def write_suite(
    folder: Path, algorithms: dict[str, dict], steps: int = 1_000, seeds: int = 2
) -> Path:
    """`tiny.yaml` in a folder; `algorithms` may change what is tiny about them."""
    contenders = []
    for name, changes in algorithms.items():
        algo = name.partition("+")[0]
        config = {s: getattr(tiny(algo, ENV), s) for s in SIZES if s in entry(algo).sections}
        sections = {s: asdict(section) for s, section in config.items()}
        sections["training"] |= {"checkpoint_every": 100, **changes}
        contenders.append({"algo": algo, "label": name if "+" in name else "", "config": sections})
    suite = {
        "tasks": [ENV],
        "algorithms": contenders,
        "seeds": seeds,
        "eval_episodes": 4,
        "config": {"total_steps": steps},
    }
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump(plain(suite)))
    return path


def start(suite: Path, logdir: Path, *flags: str) -> subprocess.Popen:
    """`mabl suite run`, its words in `logdir`.said."""
    command = [sys.executable, "-m", "mabl", "suite", "run", str(suite), f"--logdir={logdir}"]
    with Path(f"{logdir}.said").open("a") as said:
        return subprocess.Popen(
            [*command, *flags], stdout=said, stderr=said, env=os.environ | {"NO_COLOR": "1"}
        )


def said(logdir: Path) -> str:
    """What it said."""
    return Path(f"{logdir}.said").read_text()


def finish(suite: Path, logdir: Path, *flags: str) -> int:
    """Run it to its end; its exit code."""
    return start(suite, logdir, *flags).wait(300)


def runs_of(logdir: Path, algo: str, seed: int) -> list[Path]:
    """Run folders of a seed."""
    return sorted((logdir / "tiny" / ENV / algo / f"seed_{seed}").glob("2*"))


def rows_of(logdir: Path, algo: str, seed: int) -> list[dict]:
    """Rows of a seed's only run, but for times."""
    (run,) = runs_of(logdir, algo, seed)
    lines = (run / "metrics.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    return [{k: v for k, v in row.items() if not k.startswith("time/")} for row in rows]


def wait_for(what: Callable[[], bool], seconds: float = 200) -> None:
    """Until it is so. Raises TimeoutError."""
    end = time.monotonic() + seconds
    while not what():
        if time.monotonic() > end:
            raise TimeoutError
        time.sleep(0.05)


def is_free(run: Path) -> bool:
    """Whether nobody writes a run."""
    try:
        with FileLock(run / ".lock", timeout=0):
            return True
    except Timeout:
        return False
