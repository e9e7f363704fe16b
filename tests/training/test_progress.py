"""What progress says of speed and of the time left."""

import io

from rich.console import Console

from mabl.training import progress
from mabl.training.progress import Progress


def test_compiling_and_pretraining_do_not_count_in_the_speed(monkeypatch):
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    out = io.StringIO()
    with Progress(Console(file=out, width=200, force_terminal=False), 10_000, "win_rate") as shown:
        now = 60.0  # the first cycle compiles
        shown.update({"step": 100})
        assert "steps/s ?  left ?" in out.getvalue()
        now = 100.0  # the second pretrains
        shown.update({"step": 200})
        for step in range(300, 3_000, 100):  # ten steps a second
            now += 10.0
            shown.update({"step": step})
    last = out.getvalue().splitlines()[-1]
    assert last.endswith("steps/s 10  left 12:00")  # at step 2,800: 7,200 to go
