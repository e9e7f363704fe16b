"""Parts of the page of `mabl watch`: columns and rows of its table, its charts and their lines."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nicegui import ui

from mabl.experiments.watch import Standing
from mabl.training.progress import duration

COLOURS = (
    *("#2878d0", "#c75d1a", "#16875f", "#a8559f", "#9a7400"),
    *("#c2413f", "#0e8291", "#7a64c8", "#6f7d2b", "#7d7f85"),
)
"""Of runs; each has a contrast of 3:1 with a light page and with a dark one."""

DASHES = ("solid", "dashed", "dotted")
"""Of the metrics in one panel."""

STATES = {"running": "primary", "finished": "positive", "failed": "negative"}
"""Colours of their bars; what is stopped or damaged is grey."""

COLUMNS = (
    ("task", "task"),
    ("algorithm", "algorithm"),
    ("seed", "seed"),
    ("state", "state"),
    ("done", "steps"),
    ("score", "score"),
    ("episode_return", "return"),
    ("speed", "steps/s"),
    ("left", "time left"),
    ("begun", "begun"),
    ("note", "note"),
)
"""Of the table: fields and headings."""

WORDS = {"task", "algorithm", "state", "begun", "note"}
"""Columns that are not numbers."""

DIGITS = {"score": 2, "episode_return": 2, "speed": 0}
"""Of columns with decimals."""

BAR = """
<q-td :props="props">
  {{ props.row.steps }}
  <q-linear-progress :value="props.value" :color="props.row.colour" aria-label="steps done" />
</q-td>
"""
CHOOSE_ALL = '<q-checkbox v-model="props.selected" dense aria-label="draw all" />'
CHOOSE = """
<div class="no-wrap row items-center gap-1">
  <q-checkbox v-model="props.selected" dense :aria-label="`draw ${props.row.id}`" />
  <q-icon name="show_chart" :style="{ color: props.row.ink }" />
</div>
"""


def column(field: str, heading: str) -> dict[str, Any]:
    """A column of the table."""
    shown = {"name": field, "field": field, "label": heading, "sortable": field != "left"}
    if field in DIGITS:
        shown[":format"] = f"value => value?.toFixed({DIGITS[field]}) ?? ''"
    return shown | {"align": "left" if field in WORDS else "right"}


def cells(run: Standing) -> dict[str, Any]:
    """A run's row of the table; what is not known is empty."""
    total = run.config.total_steps if run.config else 0
    return {
        "id": str(run.folder),
        "task": run.task,
        "algorithm": run.config.name if run.config else run.folder.parent.parent.name,
        "seed": run.config.seed if run.config else None,
        "state": run.state,
        "done": min(run.step / total, 1.0) if total else 0.0,
        "steps": f"{run.step:,} of {total:,}" if total else "",
        "colour": STATES.get(run.state, "grey"),
        "score": or_none(run.score),
        "episode_return": or_none(run.episode_return),
        "speed": or_none(run.speed),
        "left": duration(run.seconds_left) if math.isfinite(run.seconds_left) else "",
        "begun": run.folder.name if total and run.folder.parent.name.startswith("seed_") else "",
        "note": run.note,
    }


def or_none(value: float) -> float | None:
    """None if it is not."""
    return value if math.isfinite(value) else None


def labels(runs: Sequence[Standing]) -> dict[Path, str]:
    """Short names that tell runs apart."""
    several = len({run.task for run in runs}) > 1
    names = {
        run.folder: " ".join(
            (*((run.task,) if several else ()), run.config.name, f"seed {run.config.seed}")
        )
        if run.config
        else run.folder.name
        for run in runs
    }
    times = Counter(names.values())
    return {
        folder: f"{name} {folder.name}" if times[name] > 1 else name
        for folder, name in names.items()
    }


def chart(panel: str) -> tuple[ui.column, ui.echart]:
    """An empty chart, and it with its title. `currentColor` has its text follow a dark page."""
    text = {"color": "currentColor"}
    axis = {
        "axisLabel": text | {"hideOverlap": True},
        "splitLine": {"lineStyle": {"color": "#8884"}},
    }
    steps = {"name": "environment steps", "nameLocation": "middle", "nameGap": 26}
    with ui.column().classes("min-w-0 gap-0") as whole:
        ui.label(panel).classes("font-medium").props("role=heading aria-level=2")
        element = ui.echart(
            {
                "animation": False,
                "textStyle": text,
                "grid": {"left": 48, "right": 16, "top": 16, "bottom": 80},
                "legend": {"type": "scroll", "bottom": 0, "textStyle": text}
                | {"pageTextStyle": text, "pageIconColor": "#888"},
                "tooltip": {"trigger": "axis", "confine": True},
                "xAxis": axis | steps | {"type": "value", "splitNumber": 4, "nameTextStyle": text},
                "yAxis": axis | {"type": "value", "scale": True},
                "series": [],
            },
            renderer="svg",
        )
        element.classes("w-full h-72").props(f'role=img aria-label="{panel}"')
    return whole, element


def series(name: str, points: list[tuple[float, float]], colour: str, dash: str) -> dict[str, Any]:
    """A line of a chart; what is a single point is drawn as one."""
    return {
        "type": "line",
        "name": name.replace("_", " "),
        "data": [list(point) for point in points],
        "showSymbol": len(points) == 1,
        "itemStyle": {"color": colour},
        "lineStyle": {"width": 1.5, "type": dash},
    }
