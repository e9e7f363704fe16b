"""The short version of `python -m tests.faults`: a run that is killed a few times."""

from tests.faults.killed import kill_again_and_again


def test_a_killed_run_ends_as_if_nothing_had_happened(tmp_path):
    report = kill_again_and_again(tmp_path, kills=3, algo="mappo", seed=0)
    assert report.kills == 3 and report.equal
    assert report.steps_after == sorted(report.steps_after) and report.steps_after[-1] > 0
