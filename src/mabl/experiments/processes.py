"""Jobs as processes: how one is started, what became of it; and as many of this machine as fit."""

import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Protocol

from mabl.envs.workers import n_cores
from mabl.errors import UserError
from mabl.experiments.jobs import Job


class Backend(Protocol):
    """Where jobs run."""

    @property
    def slots(self) -> int:
        """How many jobs run at once, at most."""
        ...

    def submit(self, job: Job) -> None:
        """Have a job run when there is room; not after `stop`."""
        ...

    def running(self) -> set[str]:
        """Names of jobs that have begun, and have not ended."""
        ...

    def ended(self) -> dict[str, int]:
        """Exit codes of jobs that ended since the last call, by name; negative: by a signal."""
        ...

    def stop(self) -> None:
        """Have all jobs save and end; those that wait never begin."""
        ...

    def close(self) -> None:
        """Let go of everything."""
        ...


def start(job: Job, cores: Sequence[int] = ()) -> subprocess.Popen[bytes]:
    """The process of a job. It ends when this process does; Ctrl-C does not reach it.

    With `cores`, it takes no others.
    """
    environment = dict(os.environ)
    environment["NPROC"] = str(max(1, int(job.cpus)))  # how many threads XLA starts
    environment.setdefault("JAX_TRACEBACK_FILTERING", "off")  # whose note is no reason
    if 0 < job.gpus < 1:  # XLA takes most of a GPU's memory otherwise
        environment.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", f"{0.9 * job.gpus:.3f}")

    with job.log.open("ab") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "mabl", "job", str(job.file), "--attached"],
            stdin=subprocess.PIPE,
            stdout=out,
            stderr=out,
            env=environment,
            start_new_session=True,
        )
    if cores and hasattr(os, "sched_setaffinity"):
        with suppress(ProcessLookupError):
            os.sched_setaffinity(process.pid, cores)
    return process


class LocalBackend:
    """As many jobs at once as this machine has cores for, each on cores of its own."""

    def __init__(self, cpus: float, parallel: int | None = None):
        """`cpus` of one job. Raises UserError if the machine has not so many."""
        if cpus > n_cores() and parallel is None:
            raise UserError(
                f"a job takes {cpus:g} cores, this machine has {n_cores()}: give --cpus {n_cores()}"
            )
        self._waiting: deque[Job] = deque()
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._cores: dict[str, list[int]] = {}
        available = getattr(os, "sched_getaffinity", lambda _: range(n_cores()))(0)
        self._free = sorted(available)
        self._stopped = False
        self._each = max(1, int(cpus))
        self.slots = parallel or len(self._free) // self._each

    def submit(self, job: Job) -> None:
        """Have a job run when there is room; not after `stop`."""
        if not self._stopped:
            self._waiting.append(job)
            self._fill()

    def running(self) -> set[str]:
        """Names of jobs whose processes live."""
        return set(self._processes)

    def ended(self) -> dict[str, int]:
        """Exit codes of processes that ended, by name."""
        codes = {}
        for name, process in list(self._processes.items()):
            if (code := process.poll()) is not None:
                codes[name] = code
                if process.stdin:
                    process.stdin.close()
                self._free = sorted([*self._free, *self._cores.pop(name)])
                del self._processes[name]
        self._fill()
        return codes

    def stop(self) -> None:
        """SIGTERM to all."""
        self._stopped = True
        self._waiting.clear()
        for process in self._processes.values():
            with suppress(ProcessLookupError):
                process.send_signal(signal.SIGTERM)

    def close(self) -> None:
        """Kill what did not end."""
        for process in self._processes.values():
            process.kill()
            process.wait()

    def _fill(self) -> None:
        while self._waiting and len(self._processes) < self.slots:
            job = self._waiting.popleft()
            # More jobs than cores share all of them.
            cores, self._free = self._free[: self._each], self._free[self._each :]
            self._cores[job.name] = cores
            process = self._processes[job.name] = start(job, cores)
            if self._stopped:  # while it was being started
                process.terminate()
