"""Opening a pool of the kind that a run asks for."""

import os
from typing import Any, Literal

from mabl.envs.host import Hosted
from mabl.envs.pool import LocalPool, Pool, WorkerPool
from mabl.envs.process_workers import ProcessCrew


def open_pool(
    hosted: Hosted,
    num_envs: int,
    num_workers: int | None = None,
    timeout: float = 60.0,
    workers: Literal["processes", "ray"] = "processes",
) -> Pool:
    """`num_envs` environments; 0 workers: in this process; None: as many as there are cores.

    Raises UserError if a cluster is asked for and cannot be had.
    """
    if num_workers == 0:
        return LocalPool(hosted, num_envs)
    if workers == "ray":
        from mabl.envs.ray_workers import RayCrew, join_cluster

        cores = join_cluster()
        crew: Any = RayCrew(hosted, num_envs)
    else:
        cores = n_cores()
        crew = ProcessCrew(hosted, num_envs)
    return WorkerPool(hosted, crew, min(num_workers or cores, num_envs), timeout)


def n_cores() -> int:
    """Cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # which not every system has
    return len(affinity(0)) if affinity else os.cpu_count() or 1
