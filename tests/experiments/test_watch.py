"""What `mabl watch` reads from folders, and its page in a browser."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import pytest
from filelock import FileLock
from PIL import Image
from tests.experiments.browser import SIZES, chromium, needs_chromium, visit
from tests.experiments.runs import configured, make_run

from mabl.errors import UserError
from mabl.experiments import watch
from mabl.experiments.filming import film_at, films
from mabl.experiments.following import Follower
from mabl.experiments.jobs import Job
from mabl.experiments.watch import Watch, panels, serve, thin


def line(step, **metrics):
    return json.dumps({"step": step, **metrics}) + "\n"


def append(run, text):
    with (run / "metrics.jsonl").open("a") as file:
        file.write(text)


def rest(run):
    """Have a run look as if it had last written long ago."""
    for path in run.iterdir():
        os.utime(path, (1e9, 1e9))


def steps(follower):
    return [row["step"] for row in follower.rows]


class TestFollower:
    def test_reads_what_is_appended_once(self, tmp_path):
        file = tmp_path / "metrics.jsonl"
        follower = Follower(file)
        assert not follower.read()
        file.write_text(line(1) + line(2))
        assert follower.read() and steps(follower) == [1, 2]
        first = follower.rows[0]
        assert not follower.read()
        append(tmp_path, line(3))
        assert follower.read() and steps(follower) == [1, 2, 3]
        assert follower.rows[0] is first

    def test_a_line_counts_when_it_has_ended(self, tmp_path):
        follower = Follower(tmp_path / "metrics.jsonl")
        append(tmp_path, line(1) + '{"step": 2, "train/ep')
        assert follower.read() and steps(follower) == [1] and follower.torn
        assert not follower.read()
        append(tmp_path, 'isodes": 3}\n')
        assert follower.read() and steps(follower) == [1, 2] and not follower.torn
        assert follower.rows[1]["train/episodes"] == 3 and not follower.damaged

    @pytest.mark.parametrize("in_place", [True, False])
    def test_reads_anew_what_was_cut_or_replaced(self, tmp_path, in_place):
        file = tmp_path / "metrics.jsonl"
        append(tmp_path, line(1) + line(2) + line(3))
        follower = Follower(file)
        follower.read()
        if in_place:
            file.write_text(line(1) + line(9))
        else:  # as `MetricsLog` does at a resume; it may be larger by now
            other = tmp_path / "other"
            other.write_text(line(1) + line(9) + line(10) + line(11))
            other.replace(file)
        assert follower.read() and steps(follower)[:2] == [1, 9]
        file.unlink()
        assert follower.read() and not follower.rows

    def test_skips_damaged_lines_and_counts_them(self, tmp_path):
        bad = ["", "[]", "7", '{"a": 1}', '{"step": 1, "train/x": "y"}', "\0\xff", "[" * 5000]
        bad += ['{"step": 1, "train/x": 1' + "0" * 400 + "}", '{"step": NaN}']
        append(tmp_path, line(1) + "\n".join(bad) + "\n" + line(2, **{"train/score": float("nan")}))
        follower = Follower(tmp_path / "metrics.jsonl")
        follower.read()
        assert follower.rows == [{"step": 1}, {"step": 2}]
        assert follower.damaged == len(bad)

    def test_the_tail_begins_with_a_whole_line_and_then_grows(self, tmp_path):
        append(tmp_path, "".join(line(k) for k in range(1000, 2000)))
        follower = Follower(tmp_path / "metrics.jsonl", tail=100)
        follower.read()
        assert steps(follower) == list(range(1994, 2000)) and not follower.damaged
        append(tmp_path, line(2000))
        follower.read()
        assert steps(follower)[-1] == 2000

    def test_reads_no_link_and_no_pipe(self, tmp_path):
        (tmp_path / "other").write_text(line(1))
        (tmp_path / "metrics.jsonl").symlink_to(tmp_path / "other")
        os.mkfifo(tmp_path / "pipe")
        assert not Follower(tmp_path / "metrics.jsonl").read()
        assert not Follower(tmp_path / "pipe").read()


class TestStandings:
    def test_states(self, tmp_path):
        finished = make_run(tmp_path / "quick", [0.5] * 5)
        stopped = make_run(tmp_path / "quick", [0.5] * 5, seed=1, total_steps=9_000)
        fresh = make_run(tmp_path / "quick", [0.5] * 5, seed=2, total_steps=9_000)
        broken = make_run(tmp_path / "quick", [0.5], seed=3)
        (broken / "config.yaml").write_text("algo: [")
        rest(finished), rest(stopped)
        board = Watch(tmp_path)
        found = {run.folder: run for run in board.standings()}
        states = {folder: run.state for folder, run in found.items()}
        assert states == {
            finished: "finished",
            stopped: "stopped",
            fresh: "running",
            broken: "damaged",
        }
        run = found[fresh]
        assert (run.task, run.step, run.score, run.episode_return) == ("smax/3m", 5_000, 0.5, 1.0)
        assert run.speed == pytest.approx(1_000 / 3) and run.seconds_left == pytest.approx(12)
        assert "config.yaml" in found[broken].note

        later = make_run(tmp_path, [0.1], env="flatland/5_agents")
        append(stopped, line(6_000) + "{torn")
        rest(stopped)
        found = {run.folder: run for run in board.standings()}
        assert later in found and found[stopped].step == 6_000
        assert "torn" in found[stopped].note

    @pytest.mark.skipif(not Path("/proc/locks").exists(), reason="the system lists no locks")
    def test_who_holds_its_lock_is_running(self, tmp_path):
        run = make_run(tmp_path, [0.5], total_steps=9_000)
        with FileLock(run / ".lock"):
            rest(run)
            assert Watch(tmp_path).standings()[0].state == "running"
        assert Watch(tmp_path).standings()[0].state == "stopped"

    def test_failed_jobs(self, tmp_path):
        begun = make_run(tmp_path / "a", [0.5], total_steps=9_000)
        config = replace(configured(begun), logdir="elsewhere by now", seed=0)
        job = replace(Job(config, (0, 1), 1), config=replace(config, logdir=str(tmp_path / "a")))
        job.write()
        job.failed.write_text("it ran out of memory\n")
        (job.folder / "torn.yaml").write_text("config: 3")
        (job.folder / "torn.failed").write_text("no")
        found = {run.folder: run for run in Watch(tmp_path).standings()}
        assert found.keys() == {begun, begun.parent.parent / "seed_1"}
        for run in found.values():
            assert (run.state, run.note) == ("failed", "it ran out of memory")

    def test_an_empty_folder_and_a_run_itself(self, tmp_path):
        assert Watch(tmp_path).standings() == []
        run = make_run(tmp_path, [0.5])
        assert [each.folder for each in Watch(run).standings()] == [run]

    def test_a_hundred_runs(self, tmp_path, monkeypatch):
        text = "".join(
            line(k, **{"train/episodes": 1, "train/win_rate": 0.5, "train/episode_return": 1})
            for k in range(1, 5_001)
        )
        first = make_run(tmp_path, [0.5], total_steps=9_000)
        (first / "metrics.jsonl").write_text(text)
        runs = [first.parents[1] / f"seed_{k}" / first.name for k in range(100)]
        for run in runs[1:]:
            shutil.copytree(first, run, copy_function=os.link)
        config = configured(first)  # to read a hundred takes seconds, once
        monkeypatch.setattr(watch, "read_again", lambda folder, stamp: config)
        board = Watch(tmp_path)
        assert {run.step for run in board.standings()} == {5_000}
        curves = board.curves(runs[:3])
        began = time.perf_counter()
        board.standings()
        assert board.curves(runs[:3]) == curves
        print(f"a second look at 100 runs took {time.perf_counter() - began:.3f} s")


class TestCurves:
    def test_lines_are_those_of_the_panels(self, tmp_path):
        run = make_run(tmp_path, [0.0, 1.0], env="flatland/5_agents")
        append(run, line(3_000, **{"behaviour/entropy": 1.5, "world_model/loss": 9.0}))
        board = Watch(tmp_path)
        lines = board.curves([run])[run]
        assert lines["score of training and imagined episodes"] == [
            ("arrived", [(1_000, 0), (2_000, 0.5)])
        ]
        assert lines["entropy of the policy (nats)"] == [("entropy", [(3_000, 1.5)])]
        assert lines["KL (nats)"] == []
        append(run, line(4_000, **{"behaviour/entropy": 1.0}))
        lines = board.curves([run])[run]
        assert lines["entropy of the policy (nats)"] == [("entropy", [(3_000, 1.5), (4_000, 1.0)])]
        assert not any(panels([]).values())

    @pytest.mark.parametrize("n", [0, 1, 499, 500, 501, 998, 999, 1_000, 12_345])
    def test_thinned_lines_end_with_the_newest_point(self, n):
        points = thin(range(n), range(n))
        assert len(points) <= watch.POINTS
        assert points[-1:] == [(n - 1, n - 1)][:n] and points[:1] == [(0, 0)][:n]
        assert len(set(points)) == len(points)


def draw_film(run, name="step_1000.gif"):
    folder = run / "videos"
    folder.mkdir(exist_ok=True)
    Image.new("RGB", (40, 30), "green").save(folder / name)
    return folder / name


class TestFilms:
    def test_newest_first_and_whole(self, tmp_path):
        run = make_run(tmp_path, [0.5])
        assert films(run) == []
        old, new = draw_film(run), draw_film(run, "step_2000.gif")
        draw_film(run, "unfinished-step_3000.gif")
        os.utime(old, (1e9, 1e9))
        (run / "videos" / "link.gif").symlink_to(old)
        (run / "videos" / "notes.txt").write_text("no film")
        assert films(run) == [new, old]

    def test_nothing_else_is_served(self, tmp_path):
        logdir = tmp_path.resolve() / "runs"
        run = make_run(logdir, [0.5])
        film = draw_film(run)
        where = film.relative_to(logdir).as_posix()
        assert film_at(logdir, where) == film
        (run / "videos" / "link.gif").symlink_to(run / "config.yaml")
        (logdir / "alias").symlink_to(run)
        outside = tmp_path / "x" / "videos"
        outside.mkdir(parents=True)
        shutil.copy(film, outside / "a.gif")
        (tmp_path / "x" / "config.yaml").touch()
        for other in (
            where.replace("step_1000.gif", "link.gif"),
            where.replace("step_1000.gif", "../config.yaml"),
            where.replace("videos/step_1000.gif", "config.yaml"),
            "alias/videos/step_1000.gif",
            "../x/videos/a.gif",
            str(outside / "a.gif"),
            "a\0.gif",
            "",
        ):
            assert film_at(logdir, other) is None, other


class TestServe:
    def test_what_a_person_can_mend(self, tmp_path, monkeypatch):
        with pytest.raises(UserError, match="there is no folder"):
            serve(tmp_path / "none")
        with pytest.raises(UserError, match="--port is 0"):
            serve(tmp_path, 0)
        monkeypatch.setattr(watch, "find_spec", lambda name: None)
        with pytest.raises(UserError, match=r"pip install 'mabl\[watch\]'"):
            serve(tmp_path, free_port())

    def test_a_port_in_use(self, tmp_path):
        with socket.create_server(("127.0.0.1", 0)) as other:
            port = other.getsockname()[1]
            with pytest.raises(UserError, match=f"port {port} cannot be had"):
                serve(tmp_path, port)


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


@pytest.fixture(scope="module")
def logdir(tmp_path_factory):
    logdir = tmp_path_factory.mktemp("watched") / "runs"
    for algo in ("mabl", "mappo"):
        for seed in range(2):
            make_run(logdir / "quick", [0.1, 0.4, 0.6], algo, seed=seed, total_steps=9_000)
    run = make_run(logdir / "other", [0.25], "mag", env="flatland/5_agents", total_steps=9_000)
    draw_film(run)
    return logdir


@pytest.fixture(scope="module", autouse=True)
def starting(logdir):
    """A server's process and address; it takes seconds to start, in which other tests run.

    What it takes for Python, to film with, says how it was called, and fails.
    """
    port, play = free_port(), logdir.parent / "play"
    play.write_text('#!/bin/sh\nsleep 2\necho working\necho "$JAX_PLATFORMS $(nice) $@"\nexit 2\n')
    play.chmod(0o755)
    call = "import sys; from pathlib import Path; from mabl.experiments import watch_page; "
    call += "from mabl.experiments.watch import serve; watch_page.EVERY = 1.0; "
    call += "sys.executable = sys.argv[3]; serve(Path(sys.argv[1]), int(sys.argv[2]), show=False)"
    process = subprocess.Popen(
        [sys.executable, "-c", call, logdir, str(port), play],
        stderr=subprocess.PIPE,
        env={name: value for name, value in os.environ.items() if "PYTEST" not in name},
    )
    yield process, f"http://127.0.0.1:{port}"
    process.kill()


@pytest.fixture(scope="module")
def server(starting):
    """The page's address; Ctrl-C ends it quietly."""
    process, address = starting
    for _ in range(300):
        if process.poll() is not None or answer(address) == 200:
            break
        time.sleep(0.1)
    yield address
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=15)
    assert process.returncode == 0
    assert b"Traceback" not in said, said.decode()


def answer(address, **headers):
    """A status; None if nobody answers."""
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=10) as response:
            return response.status
    except urllib.error.HTTPError as error:
        return error.code
    except OSError:
        return None


@pytest.fixture(scope="module")
def browser(server):
    with chromium() as one:
        yield one


class TestServer:
    def test_answers_to_its_own_names_alone(self, server):
        port = server.rpartition(":")[2]
        for host in ("127.0.0.1", "localhost", "[::1]"):
            assert answer(server, Host=f"{host}:{port}") == 200
        for host in (
            "evil.example",
            "127.0.0.1.evil.example",
            "localhost.evil.example",
            "10.0.0.1",
        ):
            assert answer(server, Host=f"{host}:{port}") == 400

    def test_opens_no_socket_to_pages_of_elsewhere(self, server):
        socket_io = f"{server}/_nicegui_ws/socket.io/?EIO=4&transport=polling"
        assert answer(socket_io, Origin=server) == 200
        for origin in ("http://evil.example", "http://127.0.0.1:1", "null"):
            assert answer(socket_io, Origin=origin) == 400

    def test_listens_on_loopback_alone(self, server):
        assert answer(server.replace("127.0.0.1", "127.0.0.2"), Host="localhost") is None

    def test_serves_films_alone(self, server, logdir):
        (film,) = logdir.rglob("*.gif")
        where = film.relative_to(logdir).as_posix()
        assert answer(f"{server}/films/{where}") == 200
        for other in ("videos/..%2Fconfig.yaml", "config.yaml", "metrics.jsonl"):
            at = where.replace("videos/step_1000.gif", other)
            assert answer(f"{server}/films/{at}") == 404
        assert answer(f"{server}/films/%2Fetc/passwd") == 404


@needs_chromium
class TestPage:
    @pytest.mark.parametrize("size", SIZES)
    def test_shows_runs_without_errors_or_requests_elsewhere(self, browser, server, size, tmp_path):
        seen = visit(browser, server, size)
        page = seen.page
        page.wait_for_selector("tbody >> text=flatland/5_agents")
        assert page.locator("tbody tr").count() == 5
        page.get_by_label("find runs").fill("mappo")
        page.wait_for_function("document.querySelectorAll('tbody tr').length == 2")
        page.get_by_label("find runs").fill("")
        page.wait_for_selector("svg >> text=mag seed 0 arrived")
        picture = page.locator("img[src*=films]").first
        picture.wait_for()
        assert not seen.overflow()
        assert seen.inaccessible(unclear=False) == []
        page.screenshot(path=tmp_path / f"{size}.png", full_page=True)
        page.close()
        assert seen.errors == []
        assert all(url.startswith((server, "data:", "blob:")) for url in seen.requests)

    def test_is_live(self, browser, server, logdir):
        page = visit(browser, server, "desk").page
        (run,) = [path.parent for path in logdir.glob("quick/smax/3m/mabl/seed_0/*/config.yaml")]
        page.wait_for_selector("tbody >> text=3,000 of 9,000")
        append(run, line(4_321, **{"train/episodes": 10, "train/win_rate": 0.9}))
        late = make_run(logdir / "late", [0.7], "mamba", total_steps=9_000)
        page.wait_for_selector("tbody >> text=4,321 of 9,000")
        page.wait_for_selector("tbody >> text=mamba")
        shutil.rmtree(late)
        self.film(page, logdir)
        page.close()

    def film(self, page, logdir):
        """One at a time; why it failed is said."""
        (run,) = [path.parent for path in logdir.glob("other/**/config.yaml")]
        nice = min(os.nice(0) + 10, 19)
        page.wait_for_selector("text=step_1000.gif")
        button = page.get_by_role("button", name="film an episode")
        button.click()
        page.wait_for_selector(f"text=filming {run.relative_to(logdir)}")
        assert button.is_disabled()
        page.wait_for_selector(f"text=cpu {nice} -m mabl play {run} --episodes 1")
        assert button.is_enabled()
