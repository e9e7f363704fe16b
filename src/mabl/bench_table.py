"""Tables of what `mabl bench` measured, alone or beside an earlier report."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from mabl.bench import Report
from mabl.errors import UserError


def read(path: Path) -> dict[str, Any]:
    """Read a file that `Report.write` wrote. Raises UserError for any other file."""
    try:
        found = json.loads(path.read_text())
        timings = {k: v["median"] for k, v in found["timings"].items()}
        return {
            "subject": {**found["subject"]},
            "machine": {**found["machine"]},
            "timings": timings,
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} is no report of mabl bench --json: {error}") from error


def table(report: Report, baseline: dict[str, Any] | None = None) -> Table:
    """For people; with a baseline, how many times faster each part is than it was there."""
    made = Table(
        box=None, title=title(report), caption=caption(report, baseline), title_justify="left"
    )
    made.caption_justify = "left"
    headings = ["part", "median", "least", "greatest", "GFLOP", "GFLOP/s", "of peak", "temporary"]
    for heading in headings + ["times as fast"] * (baseline is not None):
        made.add_column(heading, justify="left" if heading == "part" else "right")
    for name, timing in report.timings.items():
        rate = timing.flop / timing.median
        cells = [name, *(milliseconds(float(f(timing.seconds))) for f in (np.median, min, max))]
        cells += [f"{timing.flop / 1e9:,.1f}", f"{rate / 1e9:,.0f}"] if rate else ["", ""]
        cells.append(f"{rate / report.peak[report.subject['precision']]:.0%}" if rate else "")
        cells.append(f"{timing.temporary / 2**20:,.0f} MiB" if timing.temporary else "")
        if baseline is not None:
            before = baseline["timings"].get(name)
            cells.append(f"{before / timing.median:.2f}" if before else "-")
        made.add_row(*cells)
    return made


def title(report: Report) -> str:
    """Name the benchmarked configuration and the machine."""
    subject, on = report.subject, report.machine
    seeds = "" if subject["num_seeds"] == 1 else f", {subject['num_seeds']} seeds"
    devices = "" if subject["num_devices"] == 1 else f" on {subject['num_devices']} devices"
    return (
        f"{subject['algo']} on {subject['env']} ({subject['n_agents']} agents{seeds}), preset "
        f"{subject['preset']}, {subject['precision']}{devices}; {on['device']}, {on['cores']} "
        f"cores, jax {on['jax']}"
    )


def caption(report: Report, baseline: dict[str, Any] | None = None) -> str:
    """List peak rates, compile time and memory, and differences of settings from the baseline's."""
    peak = ", ".join(
        f"{kind} {rate / 1e9:,.0f} G{'B' if kind == 'copy' else 'FLOP'}/s"
        for kind, rate in report.peak.items()
    )
    lines = [
        f"peak: {peak}",
        f"compiling, and a first collection: {report.compile_seconds:.1f} s; "
        f"most memory: {report.memory / 2**20:,.0f} MiB",
    ]
    if baseline is not None:
        ours, theirs = (
            {k: v for of in ("subject", "machine") for k, v in found[of].items()}
            for found in (report._asdict(), baseline)
        )
        changed = [f"{k} {theirs.get(k)} -> {v}" for k, v in ours.items() if theirs.get(k) != v]
        lines.append(f"against another: {', '.join(changed) or 'the same, run before'}")
    return "\n".join(lines)


def milliseconds(seconds: float) -> str:
    """Three digits."""
    return f"{1e3 * seconds:,.{max(0, 2 - int(np.floor(np.log10(1e3 * seconds))))}f} ms"
