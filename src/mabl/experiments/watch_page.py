"""The page of `mabl watch`: a table of runs, their curves, films of their episodes. Needs NiceGUI.

Whoever opens it has a `Page`, which reads the folders every few seconds; all share one `Studio`.
"""

import asyncio
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from nicegui import app, background_tasks, core, ui
from nicegui import run as nicegui_run
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.responses import FileResponse, Response

from mabl.experiments.filming import Studio, film_at, films
from mabl.experiments.watch import HOST, Line, Standing, Watch
from mabl.experiments.watch_parts import (
    BAR,
    CHOOSE,
    CHOOSE_ALL,
    COLOURS,
    COLUMNS,
    DASHES,
    cells,
    chart,
    column,
    labels,
    series,
)
from mabl.training.curves import PANELS

EVERY = 3.0
"""Seconds between two looks at the folders."""

RECONNECT = 60.0
"""Seconds for which a page that fell silent is kept, with what was chosen on it."""

DRAWN = 10
"""Runs that are drawn at once, at most."""

SHOWN = 6
"""Films of a run that are shown, the newest."""


class Page:
    """What one visitor sees."""

    def __init__(self, logdir: Path, studio: Studio):
        self._logdir, self._studio = logdir, studio
        self._watch = Watch(logdir)
        self._standings: list[Standing] = []
        self._chosen: set[str] | None = None
        """Folders of runs that the visitor chose; None: those of the newest task."""
        self._on_show: tuple[Any, ...] = ()
        self._reading = asyncio.Lock()
        self._build()
        ui.timer(EVERY, self._refresh)

    def _build(self) -> None:
        ui.colors(primary="#1f6bb3", positive="#17803d")  # white on them can be read
        with ui.header(fixed=False).classes("items-baseline bg-slate-800"):
            ui.label("mabl watch").classes("text-lg font-medium").props("role=heading aria-level=1")
            ui.label(str(self._logdir)).classes("text-sm break-all")
        with ui.column().classes("w-full"):
            with ui.row().classes("w-full items-center justify-between"):
                self._summary = ui.label("reading ...").props("aria-live=polite")
                find = ui.input("find runs").props("dense clearable")
            self._table = ui.table(
                rows=[],
                columns=[column(*names) for names in COLUMNS],
                row_key="id",
                selection="multiple",
                pagination=10,
            )
            self._table.classes("w-full").props("dense flat bordered")
            self._table.add_slot("body-cell-done", BAR)
            self._table.add_slot("header-selection", CHOOSE_ALL)
            self._table.add_slot("body-selection", CHOOSE)
            self._table.on_select(self._choose)
            find.bind_value_to(self._table, "filter", lambda text: text or "")
            self._drawn = ui.label()
            with ui.grid().classes("w-full grid-cols-1 md:grid-cols-2 xl:grid-cols-3 gap-4"):
                self._charts = {panel: chart(panel) for panel in PANELS}
            with ui.row().classes("w-full items-center"):
                ui.label("Episodes").classes("text-lg").props("role=heading aria-level=2")
                self._run = ui.select({}, label="of", on_change=self._show_films)
                self._run.classes("min-w-48").props("dense")
                self._button = ui.button("film an episode", on_click=self._film).props("no-caps")
                self._spinner = ui.spinner(size="sm")
                self._said = ui.label().classes("min-w-0 break-all").props("aria-live=polite")
            self._films = ui.row().classes("w-full gap-4")

    async def _refresh(self) -> None:
        """Look at the folders, and show what has changed."""
        async with self._reading:
            standings = await nicegui_run.io_bound(self._watch.standings)
            if standings is None:  # the server ends
                return
            self._standings = standings
            self._show_table()
            drawn = self._to_draw()
            curves = await nicegui_run.io_bound(self._watch.curves, [run.folder for run in drawn])
            if curves is None:
                return
            self._show_charts(drawn, curves)
            self._show_films()

    async def _choose(self) -> None:
        self._chosen = {row["id"] for row in self._table.selected}
        await self._refresh()

    def _selected(self) -> list[Standing]:
        if self._chosen is None:
            known = [run for run in self._standings if run.state not in ("failed", "damaged")]
            return [run for run in known if run.task == known[0].task][:DRAWN]
        return [run for run in self._standings if str(run.folder) in self._chosen]

    def _to_draw(self) -> list[Standing]:
        """In an order that stays as runs go on, so that their colours do."""
        return sorted(self._selected()[:DRAWN], key=lambda run: run.folder)

    def _show_table(self) -> None:
        states = Counter(run.state for run in self._standings)
        self._summary.text = (
            ", ".join(f"{n} {state}" for state, n in states.items())
            or "no runs here yet: they show up by themselves"
        )
        inks = dict(zip((run.folder for run in self._to_draw()), COLOURS, strict=False))
        rows = [
            cells(run) | {"ink": inks.get(run.folder, "transparent")} for run in self._standings
        ]
        chosen = {str(run.folder) for run in self._selected()}
        selected = [row for row in rows if row["id"] in chosen]
        if rows != self._table.rows or selected != self._table.selected:
            self._table.rows, self._table.selected = rows, selected

    def _show_charts(
        self, drawn: Sequence[Standing], curves: dict[Path, dict[str, list[Line]]]
    ) -> None:
        names = labels(drawn)
        left_out = len(self._selected()) - len(drawn)
        self._drawn.text = (
            f"{len(drawn)} runs are drawn, and {left_out} more are chosen" if left_out else ""
        )
        for panel, (whole, element) in self._charts.items():
            lines = [
                series(f"{names[run.folder]} {line.metric}", line.points, colour, dash)
                for run, colour in zip(drawn, COLOURS, strict=False)
                for line, dash in zip(curves[run.folder].get(panel, []), DASHES, strict=False)
            ]
            whole.set_visibility(bool(lines))
            if lines != element.options["series"]:
                element.options["series"] = lines
                element.update()

    def _show_films(self) -> None:
        """Of the run that is looked at, and how it stands with the one to come."""
        drawn = self._to_draw()
        names = {str(folder): name for folder, name in labels(drawn).items()}
        if names != self._run.options:
            value = self._run.value if self._run.value in names else next(iter(names), None)
            self._run.set_options(names, value=value)
        run, studio = Path(self._run.value) if self._run.value else None, self._studio
        self._button.set_enabled(bool(run and not studio.filming))
        self._spinner.set_visibility(bool(studio.filming))
        self._said.text = (
            f"filming {studio.filming.relative_to(self._logdir)} ..."
            if studio.filming
            else studio.failed.get(run, "")
            if run
            else ""
        )
        found = [(path, path.stat().st_mtime_ns) for path in films(run)[:SHOWN]] if run else []
        if (run, found) == self._on_show:
            return
        self._on_show = run, found
        self._films.clear()
        with self._films:
            for path, stamp in found:
                with ui.column().classes("max-w-full gap-1"):
                    where = f"/films/{quote(path.relative_to(self._logdir).as_posix())}?{stamp}"
                    kind = ui.video if path.suffix == ".mp4" else ui.image
                    kind(where).classes("w-96 max-w-full").props["alt"] = path.name
                    ui.label(path.name).classes("text-sm")
            if run and not found:
                ui.label("no films of this run yet")

    async def _film(self) -> None:
        background_tasks.create(self._studio.film(Path(self._run.value)))
        await asyncio.sleep(0)  # it begins
        self._show_films()


def run(logdir: Path, port: int, show: bool) -> None:
    """Serve the page of an absolute folder without links in its path, until Ctrl-C."""
    studio = Studio()
    app.on_shutdown(studio.close)
    # Pages of elsewhere may have their own name lead here, or open a socket to here.
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=["localhost", HOST, "[::1]"])
    core.sio.eio.cors_allowed_origins = None  # the page's own alone

    @app.get("/films/{where:path}")
    def film(where: str) -> Response:
        path = film_at(logdir, where)
        return FileResponse(path) if path else Response("no such film", 404)

    def page() -> None:
        Page(logdir, studio)

    print(f"mabl watch: http://{HOST}:{port} (Ctrl-C ends it)", flush=True)
    with suppress(KeyboardInterrupt):
        ui.run(
            page,
            host=HOST,
            port=port,
            title="mabl watch",
            favicon="📈",
            dark=None,  # as the visitor's system is
            language="en-US",
            show=show,
            reconnect_timeout=RECONNECT,
            reload=False,
            show_welcome_message=False,
        )
