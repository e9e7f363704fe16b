"""Host environments in worker processes: many at once, and none can take the learner down."""

import multiprocessing
import os
import signal
import time
import traceback
import warnings
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, Protocol

import numpy as np

from mabl.envs.base import EnvSpec
from mabl.envs.host import Hosted, HostEnv, empty_rows, write_row
from mabl.errors import UserError
from mabl.rows import TimeStep, is_last

IDLE, STEP, RESET = range(3)
"""Commands to an environment."""

ATTEMPTS = 3
"""Times that a worker may be lost in a row, no episode finished between."""

CLOSE_TIMEOUT = 5.0
"""Seconds that workers may take to close their environments."""

START_TIMEOUT = 120.0
"""Seconds that a worker may take to import and make its environments."""


class Slots(NamedTuple):
    """What is asked of E environments, and what they answer; seen by learner and workers alike."""

    command: np.ndarray
    """int8 `[E]`."""
    seed: np.ndarray
    """uint32 `[E]`, of a reset."""
    action: np.ndarray
    """`[E, N, ...]`, of a step."""
    rows: TimeStep
    """`[E, ...]`."""


class Lost(NamedTuple):
    """An environment whose episode is over without an end, and why."""

    index: int
    reason: str


class Pool(Protocol):
    """E environments that do as they are told, all at once."""

    slots: Slots

    def send(self) -> None:
        """Have the commands of the slots carried out; returns at once."""
        ...

    def receive(self) -> list[Lost]:
        """Wait for all; rows of the lost mean nothing, and they need a reset."""
        ...

    def close(self) -> None:
        """Let go of environments and workers."""
        ...


def open_pool(hosted: Hosted, num_envs: int, num_workers: int | None, timeout: float) -> Pool:
    """`num_envs` environments; 0 workers: in this process; None: as many as there are cores."""
    if num_workers is None:
        num_workers = n_cores()
    if num_workers == 0:
        return LocalPool(hosted, num_envs)
    return ProcessPool(hosted, num_envs, min(num_workers, num_envs), timeout)


def n_cores() -> int:
    """Cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # which not every system has
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def empty_slots(spec: EnvSpec, num_envs: int) -> Slots:
    """Nothing asked, nothing answered."""
    space = spec.action_space
    return Slots(
        np.zeros(num_envs, np.int8),
        np.zeros(num_envs, np.uint32),
        np.zeros((num_envs, spec.n_agents, *space.shape), space.dtype),
        empty_rows(spec, num_envs),
    )


class Bench:
    """Environments side by side in one process; one that raises is made anew.

    Raises UserError if they cannot be made.
    """

    def __init__(self, hosted: Hosted, slots: Slots):
        self._hosted, self._slots = hosted, slots
        try:
            self._envs: list[HostEnv | None] = [hosted.make() for _ in slots.command]
        except UserError:
            raise
        except Exception as error:
            reason = traceback.format_exc()
            raise UserError(f"{hosted.spec.name} could not be made: {reason}") from error

    def obey(self) -> list[Lost]:
        """Carry out the commands, one environment after the other."""
        commands = self._slots.command.tolist()
        return [lost for i, command in enumerate(commands) if (lost := self._one(i, command))]

    def _one(self, index: int, command: int) -> Lost | None:
        if command == IDLE:
            return None
        try:
            env = self._envs[index]
            if env is None:
                env = self._envs[index] = self._hosted.make()
            if command == RESET:
                row = env.reset(int(self._slots.seed[index]))
            else:
                row = env.step(self._slots.action[index])
            write_row(self._slots.rows, index, row, self._hosted.spec)
        except UserError:
            raise
        except Exception:
            self._drop(index)
            return Lost(index, traceback.format_exc())

    def _drop(self, index: int) -> None:
        env, self._envs[index] = self._envs[index], None
        if env is not None:
            try:
                env.close()
            except Exception as error:
                warnings.warn(f"{self._hosted.spec.name} failed to close: {error}", stacklevel=2)

    def close(self) -> None:
        """Close all."""
        for index in range(len(self._envs)):
            self._drop(index)


class Patience:
    """Gives up on environments that are lost again and again without finishing an episode."""

    def __init__(self, spec: EnvSpec, num_envs: int):
        self._spec, self._losses = spec, np.zeros(num_envs, int)

    def watch(self, slots: Slots, lost: Sequence[Lost]) -> None:
        """Look at what came back. Raises UserError for an environment lost too often."""
        finished = (slots.command != IDLE) & is_last(slots.rows)
        for index, _ in lost:
            finished[index] = False
            self._losses[index] += 1
        self._losses[finished] = 0
        for index, reason in lost:
            if self._losses[index] >= ATTEMPTS:
                raise UserError(
                    f"{self._spec.name} failed {ATTEMPTS} times without finishing an episode; "
                    f"the last time: {reason}"
                )


class LocalPool:
    """Environments in the learner's own process: nothing to wait for, nothing to shield from."""

    def __init__(self, hosted: Hosted, num_envs: int):
        self.slots = empty_slots(hosted.spec, num_envs)
        self._bench = Bench(hosted, self.slots)
        self._patience = Patience(hosted.spec, num_envs)

    def send(self) -> None:
        """All is done in `receive`."""

    def receive(self) -> list[Lost]:
        """Carry out the commands."""
        lost = self._bench.obey()
        self._patience.watch(self.slots, lost)
        return lost

    def close(self) -> None:
        """Close the environments."""
        self._bench.close()


class _Worker(NamedTuple):
    process: Any
    connection: Connection
    envs: range


class ProcessPool:
    """Environments in processes of their own, started by spawn; rows pass through shared memory.

    A worker that dies, or does not answer within `timeout` seconds, is replaced; the episodes of
    its environments are lost.
    """

    def __init__(self, hosted: Hosted, num_envs: int, num_workers: int, timeout: float):
        self._hosted, self._timeout = hosted, timeout
        self._context = multiprocessing.get_context("spawn")
        self._plan = empty_slots(hosted.spec, num_envs)
        self._memory = self._context.RawArray("b", sum(_room(x) for x in _leaves(self._plan)))
        self.slots = _over(self._memory, self._plan)
        self._patience = Patience(hosted.spec, num_envs)
        bounds = [round(i * num_envs / num_workers) for i in range(num_workers + 1)]
        self._workers = [self._start(range(*b)) for b in pairwise(bounds)]
        self._ready = [False] * num_workers
        self._waiting: list[int] = []

    def send(self) -> None:
        """Wake the workers that have something to do."""
        for k, worker in enumerate(self._workers):
            if self._busy(k):
                self._await_ready(k)
                self._waiting.append(k)
                with suppress(OSError):  # it is dead, and `receive` will see it
                    worker.connection.send_bytes(b"go")

    def receive(self) -> list[Lost]:
        """Wait for the workers that `send` woke."""
        lost: list[Lost] = []
        patience = self._timeout * max((self._busy(k) for k in self._waiting), default=0)
        deadline = time.monotonic() + patience
        while self._waiting:
            by_connection = {self._workers[k].connection: k for k in self._waiting}
            ready = wait(list(by_connection), max(0.0, deadline - time.monotonic()))
            for connection in ready:
                k = by_connection[connection]  # pyright: ignore[reportArgumentType]
                self._waiting.remove(k)
                try:
                    answer = self._workers[k].connection.recv()
                except (EOFError, OSError):
                    lost += self._replace(k, "its worker process died")
                    continue
                if isinstance(answer, UserError):
                    raise answer
                lost += answer
            if not ready:
                for k in self._waiting:
                    lost += self._replace(k, f"no answer within {patience:g} seconds")
                self._waiting.clear()
        self._patience.watch(self.slots, lost)
        return lost

    def close(self) -> None:
        """Ask workers to end, and end those that do not."""
        for worker in self._workers:
            worker.connection.close()
        deadline = time.monotonic() + CLOSE_TIMEOUT
        for worker in self._workers:
            worker.process.join(max(0.0, deadline - time.monotonic()))
            _end(worker)

    def _busy(self, k: int) -> int:
        """How many environments of a worker have something to do, one after the other."""
        envs = self._workers[k].envs
        return int(np.count_nonzero(self.slots.command[envs.start : envs.stop]))

    def _start(self, envs: range) -> _Worker:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(
            target=_work,
            args=(theirs, self._hosted, self._memory, self._plan.command.size, envs),
            name=f"mabl-worker-{envs.start}",
            daemon=True,
        )
        process.start()
        theirs.close()
        return _Worker(process, ours, envs)

    def _await_ready(self, k: int) -> None:
        """Raises UserError if the environments cannot be made."""
        if self._ready[k]:
            return
        worker, name = self._workers[k], self._hosted.spec.name
        if not worker.connection.poll(START_TIMEOUT):
            raise UserError(f"a worker of {name} was not ready after {START_TIMEOUT:g} seconds")
        try:
            answer = worker.connection.recv()
        except (EOFError, OSError) as error:
            raise UserError(
                f"a worker of {name} died before it was ready; a script that trains must do so "
                'under if __name__ == "__main__":'
            ) from error
        if answer is not None:
            raise answer
        self._ready[k] = True

    def _replace(self, k: int, reason: str) -> list[Lost]:
        worker = self._workers[k]
        worker.connection.close()
        _end(worker)
        self._ready[k] = False
        self._workers[k] = self._start(worker.envs)
        return [Lost(index, reason) for index in worker.envs]


def _work(connection: Connection, hosted: Hosted, memory: Any, num_envs: int, envs: range) -> None:
    """What a worker process does until its connection closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the learner's to answer
    if hasattr(os, "setsid"):
        os.setsid()  # so that what the simulator starts can be ended with it
    everything = _over(memory, empty_slots(hosted.spec, num_envs))
    try:
        bench = Bench(hosted, _map(lambda x: x[envs.start : envs.stop], everything))
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


def _end(worker: _Worker) -> None:
    """Kill a worker that is still there, and whatever it has left behind."""
    if worker.process.is_alive():
        worker.process.kill()
    with suppress(ProcessLookupError, PermissionError, AttributeError):
        os.killpg(worker.process.pid, signal.SIGKILL)
    worker.process.join()


def _leaves(slots: Slots) -> list[np.ndarray]:
    return [slots.command, slots.seed, slots.action, *slots.rows]


def _room(array: np.ndarray) -> int:
    """Bytes, up to the next cache line."""
    return -(-array.nbytes // 64) * 64


def _map(function: Any, slots: Slots) -> Slots:
    command, seed, action, *rows = map(function, _leaves(slots))
    return Slots(command, seed, action, TimeStep(*rows))


def _over(memory: Any, plan: Slots) -> Slots:
    """Slots like `plan` in shared memory, field after field."""
    raw, offset = np.frombuffer(memory, np.uint8), 0

    def place(like: np.ndarray) -> np.ndarray:
        nonlocal offset
        piece = raw[offset : offset + like.nbytes].view(like.dtype).reshape(like.shape)
        offset += _room(like)
        return piece

    return _map(place, plan)
