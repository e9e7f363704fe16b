"""Trains for a long time, and looks whether memory stays flat.

uv run python -m tests.faults.soak --minutes 60 --out docs/results/raw/reliability/soak.json
"""

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

EVERY = 10.0
"""Seconds between samples."""
WARM_UP = 0.2
"""Share of the time in which programs are compiled and the replay is touched."""
ALLOWED = 0.02
"""Growth of the resident size after that, as a share."""


def resident(pid: int) -> float:
    """MiB of a process in memory."""
    lines = dict(
        line.split(":") for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line
    )
    return int(lines["VmRSS"].split()[0]) / 1024


def soak(minutes: float, flags: list[str]) -> dict:
    """Train so long; resident sizes as time went by, and their growth once warm."""
    with tempfile.TemporaryDirectory() as logdir:
        command = ["-m", "tests.faults.fragile", "train", f"--logdir={logdir}", *flags]
        process = subprocess.Popen([sys.executable, *command, "--total-steps=1000000000"])
        began, samples = time.monotonic(), []
        while (passed := time.monotonic() - began) < 60 * minutes and process.poll() is None:
            samples.append((round(passed), round(resident(process.pid), 1)))
            time.sleep(EVERY)
        process.send_signal(signal.SIGTERM)
        code = process.wait()
        (metrics,) = Path(logdir).rglob("metrics.jsonl")
        last = json.loads(metrics.read_text().splitlines()[-1])
    seconds, sizes = np.array(samples).T
    warm = seconds >= WARM_UP * seconds[-1]
    slope, start = np.polyfit(seconds[warm] - seconds[warm][0], sizes[warm], 1)
    growth = slope * (seconds[-1] - seconds[warm][0])
    return {
        "minutes": minutes,
        "flags": flags,
        "exit_code": code,
        "env_steps": last["step"],
        "mib_when_warm": round(start, 1),
        "mib_grown": round(growth, 1),
        "mib_most": float(sizes.max()),
        "flat": bool(growth < ALLOWED * start),
        "samples": samples,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--out", type=Path)
    given, flags = parser.parse_known_args()
    report = soak(given.minutes, flags)
    print(json.dumps({name: value for name, value in report.items() if name != "samples"}))
    if given.out:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(report) + "\n")
    sys.exit(not report["flat"])
