"""A report in a folder: one page that needs nothing else, and the same as Markdown and pictures.

OUT/index.html        everything, self-contained
    report.md         the same, with the pictures beside it
    figures/*.png, *.svg
    data/*.csv        what figures and tables are made of
    marl_eval.json    for marl-eval's tools, where every algorithm was evaluated on every task
"""

import base64
import csv
import io
import json
from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import jinja2

from mabl.errors import UserError
from mabl.experiments.comparison import LAST, Comparison
from mabl.experiments.figures import Picture, Row, columns, pictures, slug
from mabl.experiments.marl_eval import exported
from mabl.experiments.records import Record, collect
from mabl.experiments.statistics import RESAMPLES
from mabl.experiments.tables import Table, tables

TEMPLATES = files("mabl.experiments") / "templates"


class Written(NamedTuple):
    """What a report consists of."""

    page: Path
    comparison: Comparison
    without_marl_eval: str | None
    """Why there is no export, if there is none."""


def write_report(paths: Sequence[Path], out: Path, title: str, command: str) -> Written:
    """Compare all finished runs under some folders; `command` is told as what made the report.

    Raises UserError if none is finished, or where it cannot be written.
    """
    comparison = Comparison(collect(paths))
    drawn, tabled = pictures(comparison), tables(comparison)
    content = {
        "title": title,
        "command": command,
        "comparison": comparison,
        "tables": tabled,
        "pictures": drawn,
        "settings": settings(comparison.records),
        "last": LAST,
        "resamples": RESAMPLES,
    }
    try:
        for folder in (out / "figures", out / "data"):
            folder.mkdir(parents=True, exist_ok=True)
        for picture in drawn:
            for kind in ("png", "svg"):
                (out / "figures" / f"{picture.name}.{kind}").write_bytes(picture.image(kind))
        for part in (*drawn, *tabled):
            (out / "data" / f"{slug(part.name)}.csv").write_text(as_csv(part.rows))
        page, text = render("report.html.j2", content), render("report.md.j2", content)
        (out / "index.html").write_text(page, encoding="utf-8")
        (out / "report.md").write_text(text, encoding="utf-8")
        reason = write_marl_eval(comparison, out / "marl_eval.json")
    except OSError as error:
        raise UserError(f"cannot write to {out} ({error.strerror}): give another --out") from error
    return Written(out / "index.html", comparison, reason)


def write_marl_eval(comparison: Comparison, path: Path) -> str | None:
    """The export; or why there is none."""
    try:
        path.write_text(json.dumps(exported(comparison), allow_nan=False))
    except UserError as error:
        path.unlink(missing_ok=True)
        return str(error)
    return None


def settings(records: Iterable[Record]) -> list[str]:
    """What runs were made with, as far as they say: commits, packages, machines."""
    said: dict[str, set[str]] = {}
    for record in records:
        said.setdefault("preset", set()).add(record.config.preset)
        said.setdefault("precision", set()).add(record.config.precision)
        for name, version in record.versions.items():
            said.setdefault("commit" if name == "git" else name, set()).add(str(version))
    return [f"{name} {' and '.join(sorted(values))}" for name, values in said.items()]


def as_csv(rows: Iterable[Row]) -> str:
    """Rows under all names that any of them has."""
    rows = list(rows)
    out = io.StringIO()
    writer = csv.DictWriter(out, columns(rows), lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in r.items()} for r in rows
    )
    return out.getvalue()


def render(template: str, content: dict) -> str:
    """A template of this package, filled in."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(str(TEMPLATES)),
        autoescape=template.endswith(".html.j2"),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"svg": svg_uri, "csv": csv_uri, "file": slug}
    return environment.get_template(template).render(content)


def svg_uri(picture: Picture) -> str:
    """A figure, for an `img`."""
    return f"data:image/svg+xml;base64,{base64.b64encode(picture.image('svg')).decode()}"


def csv_uri(part: Picture | Table) -> str:
    """Its raw data, for a link."""
    return f"data:text/csv;base64,{base64.b64encode(as_csv(part.rows).encode()).decode()}"
