"""A report: the page in a browser, its files, and marl-eval's format."""

import csv
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
from tests.experiments.browser import SIZES, chromium, needs_chromium, visit
from tests.experiments.runs import make_comparison, make_run

from mabl import cli
from mabl.experiments.comparison import Comparison
from mabl.experiments.marl_eval import STEPS, exported
from mabl.experiments.records import collect


@pytest.fixture(scope="module")
def logdir(tmp_path_factory):
    """Three algorithms on two tasks; a seed of a fourth that did not end, and one that failed."""
    logdir = tmp_path_factory.mktemp("runs") / "made-up"
    make_comparison(logdir)
    make_run(logdir, [0.1] * 3, "mag", total_steps=40_000)
    return logdir


@pytest.fixture(scope="module")
def report(logdir):
    """Its folder."""
    assert cli.run(["report", str(logdir), "--title", "A <comparison>"]) == 0
    return logdir / "report"


@pytest.fixture(scope="module")
def browser():
    with chromium() as one:
        yield one


@needs_chromium
@pytest.mark.parametrize("size", SIZES)
def test_the_page_stands_alone_and_can_be_read_by_everybody(report, browser, size, tmp_path):
    address = (report / "index.html").resolve().as_uri()
    seen = visit(browser, address, size, offline=True)
    assert seen.errors == [] and seen.requests == [address]
    assert not seen.overflow()
    # On a phone parts of tables lie under their first column.
    assert seen.inaccessible(unclear=size == "desk") == []
    assert seen.page.title() == "A <comparison>"
    widths = seen.page.evaluate("[...document.images].map(i => [i.naturalWidth, i.clientWidth])")
    assert len(widths) == 8 and all(natural > 0 and width > 300 for natural, width in widths)
    seen.page.screenshot(path=tmp_path / "page.png", full_page=True)
    shades = np.asarray(Image.open(tmp_path / "page.png").convert("L"))
    assert shades.shape[0] > 3 * SIZES[size][1] and 0.01 < (shades < 128).mean() < 0.5


@needs_chromium
def test_what_the_test_of_accessibility_calls_good_is(browser, tmp_path):
    """It sees what is pale, and an image without words."""
    bad = tmp_path / "bad.html"
    bad.write_text(
        '<html lang="en"><title>x</title><p style="color:#bbb">pale</p><img src="data:,">'
    )
    found = " ".join(visit(browser, bad.as_uri(), "desk").inaccessible())
    assert "color-contrast" in found and "image-alt" in found


class Links(HTMLParser):
    """All that a page refers to."""

    def __init__(self, page: str):
        super().__init__()
        self.found: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.found += [value for name, value in attrs if name in ("src", "href", "srcset")]


def test_the_page_refers_to_nothing_outside_itself(report):
    page = (report / "index.html").read_text()
    links = Links(page).found
    assert len(links) > 20 and all(link.startswith(("#", "data:")) for link in links)
    assert "<script" not in page and "@import" not in page and "url(" not in page


def test_every_figure_and_table_has_its_raw_data(report):
    text = (report / "report.md").read_text()
    shown = re.findall(r"\((figures/[^)]+|data/[^)]+)\)", text)
    assert len(shown) >= 8 + 8 + 5 and all((report / name).is_file() for name in shown)
    with (report / "data" / "curve_mean_smax_3m.csv").open() as file:
        rows = list(csv.DictReader(file))
    mine = [row for row in rows if row["algorithm"] == "mabl"]
    assert len(mine) > 90
    for row in mine:
        seeds = [float(row[f"seed_{k}"]) for k in range(3)]
        assert float(row["mean"]) == pytest.approx(np.mean(seeds), abs=1e-4)
        assert (float(row["low"]), float(row["high"])) == (min(seeds), max(seeds))


def test_what_is_missing_is_said(report, logdir, capsys, tmp_path):
    said = "mag on smax/3m, seed 0: unfinished: 3,000 of 40,000 steps"
    assert (
        said in (report / "index.html").read_text() and said in (report / "report.md").read_text()
    )
    assert cli.run(["report", str(logdir), "--out", str(tmp_path)]) == 0
    assert said in capsys.readouterr().err


def test_the_command_is_told(report, logdir):
    assert f"mabl report {logdir} --title" in (report / "index.html").read_text()


def test_the_same_runs_give_the_same_report(report, logdir, tmp_path):
    assert cli.run(["report", str(logdir), "--out", str(tmp_path)]) == 0
    for name in ("figures/curve_iqm_smax_3m.svg", "data/aggregates.csv", "marl_eval.json"):
        assert (tmp_path / name).read_bytes() == (report / name).read_bytes()


def check_marl_eval(data: dict) -> None:
    """What marl-eval's DiagnoseData asks for, and what its pipeline breaks on beside that."""
    tasks = [task for env in data.values() for task in env.values()]
    algorithms = {frozenset(task) for task in tasks}
    assert len(algorithms) == 1 and not any("," in name for name in next(iter(algorithms)))
    runs = [task[name] for task in tasks for name in task]
    assert len({frozenset(run) for run in runs}) == 1
    seeds = [seed for run in runs for seed in run.values()]
    assert len({frozenset(seed) for seed in seeds}) == 1 and "absolute_metrics" in seeds[0]
    for task in tasks:
        steps = [
            {k: v.get("step_count") for k, v in s.items()}
            for r in task.values()
            for s in r.values()
        ]
        assert all(step == steps[0] for step in steps)
        names = {
            frozenset(point) - {"step_count"}
            for run in task.values()
            for seed in run.values()
            for point in seed.values()
        }
        assert len(names) == 1
    for seed in (seed for run in runs for seed in run.values()):
        for point in seed.values():
            values = [v for name, v in point.items() if name != "step_count"]
            assert all(isinstance(v, list) and v and np.isfinite(v).all() for v in values)


def test_the_export_is_what_marl_eval_reads(report):
    data = json.loads((report / "marl_eval.json").read_text())
    check_marl_eval(data)
    assert set(data) == {"smax", "flatland"} and set(data["smax"]) == {"3m"}
    seed = data["smax"]["3m"]["mabl"]["seed_0"]
    assert [seed[f"step_{k}"]["step_count"] for k in (0, STEPS - 1)] == [2_000, 40_000]
    for name in ("win_rate", "score"):
        assert seed["absolute_metrics"][name] == [1.0, 1.0]


def test_points_of_the_export_are_means_since_the_one_before(tmp_path):
    make_run(tmp_path, [k / 20 for k in range(20)], evaluation=[0.5])
    data = exported(Comparison(collect([tmp_path])))
    seed = data["smax"]["3m"]["mabl"]["seed_0"]
    assert [seed[f"step_{k}"]["win_rate"] for k in range(20)] == [[k / 20] for k in range(20)]


def test_where_a_run_was_not_evaluated_there_is_no_export(tmp_path, capsys):
    make_run(tmp_path, [0.5] * 20)
    assert cli.run(["report", str(tmp_path)]) == 0
    assert "no marl_eval.json: marl-eval needs" in capsys.readouterr().err
    assert not (tmp_path / "report" / "marl_eval.json").exists()


def test_one_seed_and_one_algorithm_are_reported_too(tmp_path):
    make_run(tmp_path, [0.5] * 20)
    assert cli.run(["report", str(tmp_path)]) == 0
    assert (
        "| mabl | 1 | 0.50 ± - | 0.50 | 0.50 |" in (tmp_path / "report" / "report.md").read_text()
    )
