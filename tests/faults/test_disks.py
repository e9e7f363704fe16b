"""Disks that take no more cost nothing that was written before."""

import subprocess

import pytest
from tests.faults.disks import full, limited, read_only, small_disk
from tests.faults.killed import train


@pytest.fixture
def may_mount(tmp_path):
    try:
        with small_disk(tmp_path / "try", 1):
            pass
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this user may not mount file systems")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that had room."""
    return train(tmp_path_factory.mktemp("runs"), "mappo", 1000)


def test_a_limit_on_files_stops_the_run_and_loses_nothing(tmp_path, whole):
    (code, said), kept, equal = limited(tmp_path, whole)
    assert code == 2 and "Traceback" not in said
    assert "mabl: cannot write" in said and "(File too large); no checkpoint" in said
    assert kept == 0 and equal


def test_a_full_disk_stops_the_run_and_loses_nothing(tmp_path, may_mount, whole):
    (code, said), kept, equal = full(tmp_path, whole)
    assert code == 2 and "Traceback" not in said
    assert f"(No space left on device); its checkpoint at {kept} is kept: make room" in said
    assert kept > 0 and equal


def test_a_read_only_folder_is_said(tmp_path, may_mount, whole):
    refused = read_only(tmp_path / "there", whole)
    assert refused.code == 2 and "Traceback" not in refused.said
    assert "mabl: Read-only file system" in refused.said
