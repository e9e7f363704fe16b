"""Suites on a Ray cluster of two nodes, of which one is lost."""

import logging
import os

import pytest
from rich.console import Console
from tests.experiments.tiny_suite import finish, rows_of, runs_of, wait_for, write_suite

from mabl import UserError
from mabl.experiments.cluster import RayBackend, place_of
from mabl.experiments.jobs import jobs_of
from mabl.experiments.running import run_jobs
from mabl.experiments.suite import load

ALGORITHMS = ("mappo", "mappo+more")
STEPS = 3_000


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    algorithms = {name: {} for name in ALGORITHMS}
    return write_suite(tmp_path_factory.mktemp("suite"), algorithms, STEPS, seeds=1)


@pytest.fixture
def cluster():
    """Two nodes of one core each; the first is the head."""
    os.environ["RAY_ENABLE_UV_RUN_RUNTIME_ENV"] = "0"
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    one = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    one.second = one.add_node(num_cpus=1)
    ray.init(one.address, log_to_driver=False, logging_level=logging.ERROR)
    yield one
    ray.shutdown()
    one.shutdown()


class Losing(RayBackend):
    """Loses the second node once jobs on both are under way."""

    def __init__(self, cluster, logdir):
        super().__init__(cluster.address)
        self._cluster, self._logdir, self.lost = cluster, logdir, False

    def ended(self):
        begun = [
            any((run / "checkpoints").glob("step_*"))
            for name in ALGORITHMS
            for run in runs_of(self._logdir, name, 0)
        ]
        if not self.lost and begun == [True, True]:
            assert len(self.running()) == 2
            self._cluster.remove_node(self._cluster.second, allow_graceful=False)
            self.lost = True
        return super().ended()


def test_a_suite_survives_the_loss_of_a_node(cluster, suite, tmp_path):
    """Its job goes on elsewhere from its checkpoint, and ends like one that nothing happened to."""
    undisturbed, logdir = tmp_path / "whole", tmp_path / "cut"
    assert finish(suite, undisturbed) == 0
    jobs = jobs_of(load(str(suite)), logdir / "tiny")
    backend = Losing(cluster, logdir)
    tally = run_jobs(jobs, backend, Console(stderr=True))
    assert backend.lost and len(tally.done) == 2
    assert not any(place_of(job).exists() for job in jobs)
    assert sorted(job.log.read_text().count("compiling") for job in jobs) == [1, 2]
    for name in ALGORITHMS:
        assert rows_of(logdir, name, 0) == rows_of(undisturbed, name, 0)


def test_jobs_of_a_cluster_save_and_end_when_told(cluster, tmp_path):
    """Though they have long to go."""
    suite = write_suite(tmp_path, {"mappo": {}}, 10_000_000, seeds=1)
    (job,) = jobs_of(load(str(suite)), tmp_path / "tiny")
    job.write()
    backend = RayBackend(cluster.address)
    backend.submit(job)
    wait_for(lambda: any(tmp_path.glob("tiny/test/*/mappo/seed_0/*/checkpoints/step_*")))
    backend.stop()
    codes = {}
    wait_for(lambda: codes.update(backend.ended()) or bool(codes), 60)
    assert codes[job.name] != 0 and "interrupted at" in job.log.read_text()


def test_what_no_node_has_room_for_is_refused(cluster, suite, tmp_path):
    (job, _) = jobs_of(load(str(suite)), tmp_path)
    backend = RayBackend(cluster.address)
    with pytest.raises(UserError, match="no node of the cluster has them"):
        backend.submit(job.__class__(job.config, job.seeds, job.eval_episodes, cpus=2))


def test_a_cluster_that_is_not_there_is_named(suite, mabl, tmp_path):
    where = ("--backend=ray", "--address=127.0.0.1:1", f"--logdir={tmp_path}")
    code, _, said = mabl("suite", "run", suite, *where)
    assert code == 2 and "no Ray cluster at 127.0.0.1:1" in said
