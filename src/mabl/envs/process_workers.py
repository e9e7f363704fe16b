"""Workers as processes of this machine, started by spawn; rows pass through shared memory."""

import multiprocessing
import os
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np

from mabl.envs.host import Hosted
from mabl.envs.pool import Answer, Bench, Lost, Slots, WorkerDied, empty_slots, map_slots
from mabl.errors import UserError

CLOSE_TIMEOUT = 5.0
"""Seconds that workers may take to close their environments."""


class ProcessWorker:
    """A process, and the pipe to it."""

    def __init__(self, process: Any, connection: Connection, envs: range):
        self.process, self.connection, self.envs = process, connection, envs

    def ask(self) -> None:
        """Wake it; if it is dead, `answer` will say so."""
        with suppress(OSError):
            self.connection.send_bytes(b"go")

    def answer(self) -> Answer:
        """What it said. Raises WorkerDied."""
        try:
            return self.connection.recv()
        except (EOFError, OSError) as error:
            hint = 'a script that trains must do so under if __name__ == "__main__":'
            raise WorkerDied(before_ready=hint) from error


class ProcessCrew:
    """Processes of this machine; each can be killed with all that it has started."""

    slow = ""

    def __init__(self, hosted: Hosted, num_envs: int):
        self._hosted, self._num_envs = hosted, num_envs
        self._context = multiprocessing.get_context("spawn")
        plan = empty_slots(hosted.spec, num_envs)
        self._memory = self._context.RawArray("b", sum(map(_room, (*plan[:-1], *plan.rows))))
        self.slots = _over(self._memory, plan)

    def start(self, envs: range) -> ProcessWorker:
        """Spawn one."""
        ours, theirs = self._context.Pipe()
        process = self._context.Process(
            target=_work,
            args=(theirs, self._hosted, self._memory, self._num_envs, envs),
            name=f"mabl-worker-{envs.start}",
            daemon=True,
        )
        process.start()
        theirs.close()
        return ProcessWorker(process, ours, envs)

    def wait(self, workers: Sequence[ProcessWorker], timeout: float) -> list[ProcessWorker]:
        """Those whose pipes have something to say."""
        ready = wait([worker.connection for worker in workers], timeout)
        return [worker for worker in workers if worker.connection in ready]

    def kill(self, worker: ProcessWorker) -> None:
        """And whatever it has left behind."""
        worker.connection.close()
        if worker.process.is_alive():
            worker.process.kill()
        with suppress(ProcessLookupError, PermissionError, AttributeError):
            os.killpg(worker.process.pid, signal.SIGKILL)
        worker.process.join()

    def dismiss(self, workers: Sequence[ProcessWorker]) -> None:
        """Those that take longer than others would wait are killed."""
        for worker in workers:
            worker.connection.close()
        deadline = time.monotonic() + CLOSE_TIMEOUT
        for worker in workers:
            worker.process.join(max(0.0, deadline - time.monotonic()))
            self.kill(worker)


def _work(connection: Connection, hosted: Hosted, memory: Any, num_envs: int, envs: range) -> None:
    """What a worker process does until its connection closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the learner's to answer
    if hasattr(os, "setsid"):
        os.setsid()  # so that what the simulator starts can be ended with it
    everything = _over(memory, empty_slots(hosted.spec, num_envs))
    try:
        bench = Bench(hosted, map_slots(lambda x: x[envs.start : envs.stop], everything))
    except UserError as error:
        connection.send(error)
        return
    try:
        connection.send(None)
        while True:
            connection.recv_bytes()
            try:
                answer = [Lost(envs[i], reason) for i, reason in bench.obey()]
            except UserError as error:
                answer = error
            connection.send(answer)
    except (EOFError, OSError):
        bench.close()


def _room(array: np.ndarray) -> int:
    """Bytes, up to the next cache line."""
    return -(-array.nbytes // 64) * 64


def _over(memory: Any, plan: Slots) -> Slots:
    """Slots like `plan` in shared memory, field after field."""
    raw, offset = np.frombuffer(memory, np.uint8), 0

    def place(like: np.ndarray) -> np.ndarray:
        nonlocal offset
        piece = raw[offset : offset + like.nbytes].view(like.dtype).reshape(like.shape)
        offset += _room(like)
        return piece

    return map_slots(place, plan)
