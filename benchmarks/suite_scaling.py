"""How a suite's time shrinks with nodes: local Ray nodes of one core each.

    uv run python -m benchmarks.suite_scaling --suite quick --total-steps 3000 --nodes 2 1 2

Each number of nodes runs the whole suite anew; compiled programs come from the cache, which the
first of them fills. Efficiency is the time on one node over n times the time on n. Each job takes
one core, whatever the machine has.
"""

import argparse
import json
import logging
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import ray
from ray.cluster_utils import Cluster
from rich.console import Console

from mabl.experiments.cluster import RayBackend
from mabl.experiments.jobs import jobs_of
from mabl.experiments.running import run_jobs
from mabl.experiments.suite import load


def seconds(suite: str, nodes: int, total_steps: int | None, logdir: Path) -> dict[str, float]:
    """The whole suite's time on so many nodes."""
    shutil.rmtree(logdir, ignore_errors=True)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    for _ in range(nodes - 1):
        cluster.add_node(num_cpus=1)
    ray.init(cluster.address, log_to_driver=False, logging_level=logging.ERROR)
    try:
        jobs = jobs_of(replace(load(suite), cpus=1), logdir, total_steps)
        began = time.monotonic()
        tally = run_jobs(jobs, RayBackend(cluster.address), Console(stderr=True))
        whole = time.monotonic() - began
        assert len(tally.done) == len(jobs), tally
    finally:
        ray.shutdown()
        cluster.shutdown()
    return {"nodes": nodes, "seconds": whole, "jobs": len(jobs)}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--suite", default="quick")
    parser.add_argument("--total-steps", type=int)
    parser.add_argument("--nodes", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--logdir", type=Path, default=Path("runs/scaling"))
    args = parser.parse_args()
    os.environ["RAY_ENABLE_UV_RUN_RUNTIME_ENV"] = "0"
    for nodes in args.nodes:
        found = seconds(args.suite, nodes, args.total_steps, args.logdir)
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
