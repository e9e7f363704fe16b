"""Jobs as tasks of a Ray cluster. Needs the extra `ray`, and a folder that all nodes see.

Ray finds the room, and starts a job again where its node was lost: a job goes on from what it left
in its run folders.
"""

import os
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from mabl.envs.ray_workers import join_cluster
from mabl.errors import UserError
from mabl.experiments.jobs import Job
from mabl.experiments.processes import start

RETRIES = 20
"""Times that a job is started again after its node was lost."""

POLL_EVERY = 0.2
"""Seconds between looks whether a process has ended."""


class RayBackend:
    """Every job one task, with the cores and GPUs that it asks for."""

    def __init__(self, address: str | None = None, cpus: float = 1, gpus: float = 0):
        """`cpus` and `gpus` of one job.

        Raises UserError without the extra, or without such a cluster.
        """
        rooms = [join_cluster(address) // cpus]
        import ray

        if gpus:
            rooms.append(ray.cluster_resources().get("GPU", 0) // gpus)
        self.slots = max(1, int(min(rooms)))
        self._ray: Any = ray
        self._tasks: dict[str, Any] = {}
        self._jobs: dict[str, Job] = {}
        self._stopped = False

    def submit(self, job: Job) -> None:
        """Have a job run where there is room; not after `stop`.

        Raises UserError if no node has so much.
        """
        if self._stopped:
            return
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        if not any(n.get("CPU", 0) >= job.cpus and n.get("GPU", 0) >= job.gpus for n in nodes):
            raise UserError(
                f"a job takes {job.cpus:g} cores and {job.gpus:g} GPUs, no node of the cluster has "
                "them: give smaller --cpus and --gpus"
            )
        task = self._ray.remote(_run).options(
            num_cpus=job.cpus, num_gpus=job.gpus, max_retries=RETRIES, name=job.name
        )
        self._jobs[job.name] = job
        place_of(job).unlink(missing_ok=True)
        stop_file_of(job).unlink(missing_ok=True)
        self._tasks[job.name] = task.remote(Path.cwd(), job)
        if self._stopped:  # while it was being submitted
            self._cancel(job.name)

    def running(self) -> set[str]:
        """Names of jobs that have begun."""
        return {name for name in self._tasks if place_of(self._jobs[name]).exists()}

    def ended(self) -> dict[str, int]:
        """Exit codes of jobs whose tasks ended, by name."""
        if not self._tasks:
            return {}
        tasks = list(self._tasks.values())
        ready, _ = self._ray.wait(tasks, num_returns=len(tasks), timeout=0)
        codes = {}
        for name in [name for name, task in self._tasks.items() if task in ready]:
            try:
                codes[name] = self._ray.get(self._tasks.pop(name))
            except self._ray.exceptions.TaskCancelledError:
                codes[name] = -signal.SIGTERM
            except self._ray.exceptions.RayError as error:
                with self._jobs[name].log.open("a") as file:
                    file.write(f"{error}".strip().splitlines()[-1] + "\n")
                codes[name] = 1
        return codes

    def stop(self) -> None:
        """Cancel all tasks: those that run have their processes save and end."""
        self._stopped = True
        for name in list(self._tasks):
            self._cancel(name)

    def _cancel(self, name: str) -> None:
        """Cancel a task, and leave a stop file in case Ray loses the cancellation."""
        stop_file_of(self._jobs[name]).touch()
        self._ray.cancel(self._tasks[name])

    def close(self) -> None:
        """Leave the cluster."""
        with suppress(Exception):
            self._ray.shutdown()


def place_of(job: Job) -> Path:
    """A file that is there while a job runs: its machine, and what Ray calls that node."""
    return job.folder / f"{job.name}.node"


def stop_file_of(job: Job) -> Path:
    """File whose existence tells a job to save and end."""
    return job.folder / f"{job.name}.stop"


def _run(cwd: Path, job: Job) -> int:
    """A job on whatever node this is."""
    import ray

    os.chdir(cwd)
    place_of(job).write_text(f"{os.uname().nodename} {ray.get_runtime_context().get_node_id()}\n")
    process = start(job)
    try:
        while process.poll() is None and not stop_file_of(job).exists():
            time.sleep(POLL_EVERY)
        if process.poll() is None:  # it saves at the end of its cycle
            process.terminate()
        return process.wait()
    except BaseException:  # cancelled: it saves at the end of its cycle
        process.terminate()
        process.wait()
        raise
    finally:
        place_of(job).unlink(missing_ok=True)
        stop_file_of(job).unlink(missing_ok=True)
