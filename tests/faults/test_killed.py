"""The short version of `python -m tests.faults`: a run that is killed a few times."""

import subprocess
import sys

from tests.faults.killed import kill_again_and_again


def test_a_save_that_dies_anywhere_leaves_a_whole_checkpoint(tmp_path):
    command = [sys.executable, "-m", "tests.faults.saves", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(done.stdout) > 10


def test_a_killed_run_ends_as_if_nothing_had_happened(tmp_path):
    report = kill_again_and_again(tmp_path, kills=3, algo="mappo", seed=0)
    assert report.kills == 3 and report.equal and report.lost == 0
    assert report.steps_after[-1] > 0
