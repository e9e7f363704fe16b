"""Suites on a Ray cluster of two nodes, of which one is lost."""

import signal
import subprocess
import threading
from types import SimpleNamespace

import pytest
from tests.experiments.tiny_suite import (
    finish,
    rows_of,
    runs_of,
    said,
    start,
    wait_for,
    write_suite,
)

from mabl.experiments.cluster import _run, stop_file_of

ALGORITHMS = ("mappo", "mappo+more")
STEPS = 6_000


@pytest.fixture
def nodes():
    """A cluster of two nodes of one core each, which this process does not join; the second."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    yield cluster, cluster.add_node(num_cpus=1)
    cluster.shutdown()


def on(cluster) -> tuple[str, str]:
    """Flags that have a suite run there."""
    return "--backend=ray", f"--address={cluster.address}"


def jobs_on(node, logdir) -> list[str]:
    """Algorithms whose jobs run there."""
    places = (logdir / "tiny" / "jobs").glob("*.node")
    return [p.name.split("_")[1] for p in places if node.node_id in p.read_text()]


def has_saved(logdir, algo) -> bool:
    return any(path for run in runs_of(logdir, algo, 0) for path in run.glob("checkpoints/step_*"))


def test_a_suite_survives_the_loss_of_a_node(nodes, tmp_path):
    """Its job goes on elsewhere from its checkpoint, and ends like one that nothing happened to."""
    cluster, second = nodes
    suite = write_suite(tmp_path, {name: {} for name in ALGORITHMS}, STEPS, seeds=1)
    undisturbed, logdir = tmp_path / "whole", tmp_path / "cut"
    assert finish(suite, undisturbed) == 0
    process = start(suite, logdir, *on(cluster))
    wait_for(lambda: any(has_saved(logdir, name) for name in jobs_on(second, logdir)))
    cluster.remove_node(second, allow_graceful=False)
    assert process.wait(200) == 0 and "2 done" in said(logdir)
    logs = sorted((logdir / "tiny" / "jobs").glob("*.log"))
    assert sorted(log.read_text().count("compiling") for log in logs) == [1, 2]
    for name in ALGORITHMS:
        assert rows_of(logdir, name, 0) == rows_of(undisturbed, name, 0)


def test_jobs_of_a_cluster_save_and_end_when_told(nodes, tmp_path):
    """Though they have long to go. What no node has room for is refused."""
    cluster, _ = nodes
    suite, logdir = write_suite(tmp_path, {"mappo": {}}, 10_000_000, seeds=1), tmp_path / "runs"
    assert finish(suite, logdir, *on(cluster), "--cpus=2") == 2
    assert "no node of the cluster has them" in said(logdir)
    process = start(suite, logdir, *on(cluster))
    wait_for(lambda: has_saved(logdir, "mappo"))
    process.send_signal(signal.SIGTERM)
    assert process.wait(100) == 75 and "1 to go on" in said(logdir)
    (log,) = (logdir / "tiny" / "jobs").glob("*.log")
    assert "interrupted at" in log.read_text()


def test_a_stop_file_ends_a_job_whose_cancellation_was_lost(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sleeping = subprocess.Popen(["sleep", "300"])
    monkeypatch.setattr("mabl.experiments.cluster.start", lambda job: sleeping)
    node = SimpleNamespace(get_node_id=lambda: "a")
    monkeypatch.setattr("ray.get_runtime_context", lambda: node)
    job = SimpleNamespace(name="job", folder=tmp_path)
    threading.Timer(0.5, stop_file_of(job).touch).start()
    assert _run(tmp_path, job) == -signal.SIGTERM
    assert not list(tmp_path.iterdir())


def test_a_cluster_that_is_not_there_is_named(tmp_path):
    suite = write_suite(tmp_path, {"mappo": {}})
    assert finish(suite, tmp_path / "runs", "--backend=ray", "--address=127.0.0.1:1") == 2
    assert "no Ray cluster at 127.0.0.1:1" in said(tmp_path / "runs")
