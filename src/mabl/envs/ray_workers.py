"""Workers as actors of a Ray cluster; rows pass through Ray. Needs the extra `ray`."""

import logging
import os
import socket
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from mabl.envs.host import Hosted
from mabl.envs.pool import Answer, Bench, Lost, Slots, WorkerDied, empty_slots, map_slots
from mabl.errors import UserError
from mabl.rows import TimeStep

PROBED_FOR = 10.0
"""Seconds in which a cluster must answer."""


def join_cluster(address: str | None = None) -> int:
    """Join the cluster at an address, at `RAY_ADDRESS`, or one that runs here, or start one.

    Returns its cores. `auto` is a cluster that is there already.

    Raises UserError without the extra, and if there is no such cluster.
    """
    # Ray would have every worker install the project anew where the learner was started by uv.
    os.environ.setdefault("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    try:
        import ray
    except ImportError as error:
        raise UserError("Ray needs an extra: pip install 'mabl[ray]'") from error
    if not ray.is_initialized():
        try:
            probe(address or os.environ.get("RAY_ADDRESS", ""))
            ray.init(address, log_to_driver=False, logging_level=logging.WARNING)
        except (OSError, RuntimeError, ValueError) as error:
            where = address or os.environ.get("RAY_ADDRESS", "this machine")
            raise UserError(
                f"no Ray cluster at {where} ({error}): start it, give its address as HOST:PORT, or "
                "none to use this machine"
            ) from error
    return max(1, int(ray.cluster_resources().get("CPU", 1)))


def probe(address: str) -> None:
    """Raise OSError if nobody listens at HOST:PORT: Ray would wait for minutes."""
    host, _, port = address.rpartition(":")
    if host and "/" not in host and port.isdigit():
        with socket.create_connection((host.strip("[]"), int(port)), timeout=PROBED_FOR):
            pass


class RayWorker:
    """An actor, and its answer to come."""

    def __init__(self, actor: Any, slots: Slots, envs: range):
        self.actor, self.envs = actor, envs
        self._slots = map_slots(lambda x: x[envs.start : envs.stop], slots)
        self.coming = actor.make.remote()

    def ask(self) -> None:
        """Send its slots' commands."""
        slots = self._slots
        self.coming = self.actor.obey.remote(slots.command, slots.seed, slots.action)

    def answer(self) -> Answer:
        """What it said. Raises WorkerDied."""
        import ray
        from ray.exceptions import RayError

        try:
            answer = ray.get(self.coming)
        except RayError as error:
            raise WorkerDied(f"{error}".strip().partition("\n")[0]) from error
        if not isinstance(answer, tuple):
            return answer
        lost, rows = answer
        for mine, new in zip(self._slots.rows, rows, strict=True):
            mine[:] = new
        return [Lost(self.envs[index], reason) for index, reason in lost]


class RayCrew:
    """Actors of one core each, wherever the cluster has room."""

    slow = ": the cluster may have too few free cores, give fewer --num-workers"

    def __init__(self, hosted: Hosted, num_envs: int):
        import ray

        self.slots = empty_slots(hosted.spec, num_envs)
        self._ray: Any = ray
        self._hosted = ray.put(hosted)

    def start(self, envs: range) -> RayWorker:
        """Ask the cluster for one."""
        actor = self._ray.remote(num_cpus=1)(_Actor).remote(self._hosted, len(envs))
        return RayWorker(actor, self.slots, envs)

    def wait(self, workers: Sequence[RayWorker], timeout: float) -> list[RayWorker]:
        """Those whose answers have come; all of them, if all come in time."""
        by_answer = {worker.coming: worker for worker in workers}
        ready, _ = self._ray.wait(list(by_answer), num_returns=len(by_answer), timeout=timeout)
        return [by_answer[coming] for coming in ready]

    def kill(self, worker: RayWorker) -> None:
        """Without leave to close."""
        self._ray.kill(worker.actor)

    def dismiss(self, workers: Sequence[RayWorker]) -> None:
        """Actors end when they have closed and nobody holds them."""
        closing = [worker.actor.close.remote() for worker in workers]
        with suppress(self._ray.exceptions.RayError):
            self._ray.wait(closing, num_returns=len(closing), timeout=5)
        for worker in workers:
            self.kill(worker)


class _Actor:
    """A bench of environments, somewhere in the cluster."""

    def __init__(self, hosted: Hosted, num_envs: int):
        self._hosted = hosted
        self._slots = empty_slots(hosted.spec, num_envs)

    def make(self) -> UserError | None:
        try:
            self._bench = Bench(self._hosted, self._slots)
        except UserError as error:
            return error

    def obey(self, *asked: Any) -> tuple[list[Lost], TimeStep] | UserError:
        slots = self._slots
        for mine, new in zip((slots.command, slots.seed, slots.action), asked, strict=True):
            mine[:] = new
        try:
            return self._bench.obey(), self._slots.rows
        except UserError as error:
            return error

    def close(self) -> None:
        self._bench.close()
