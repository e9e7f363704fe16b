"""Host environments in workers: many at once, and none can take the learner down."""

import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from mabl.envs.base import EnvSpec
from mabl.envs.host import Hosted, HostEnv, empty_rows, write_row
from mabl.errors import UserError
from mabl.rows import TimeStep, is_last

IDLE, STEP, RESET = range(3)
"""Commands to an environment."""

ATTEMPTS = 3
"""Times that a worker may be lost in a row, no episode finished between."""

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


def empty_slots(spec: EnvSpec, num_envs: int) -> Slots:
    """Nothing asked, nothing answered."""
    space = spec.action_space
    return Slots(
        np.zeros(num_envs, np.int8),
        np.zeros(num_envs, np.uint32),
        np.zeros((num_envs, spec.n_agents, *space.shape), space.dtype),
        empty_rows(spec, num_envs),
    )


def map_slots(function: Callable[[np.ndarray], np.ndarray], slots: Slots) -> Slots:
    """`function` of every array."""
    command, seed, action, rows = slots
    asked = function(command), function(seed), function(action)
    return Slots(*asked, TimeStep(*map(function, rows)))


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
            try:
                write_row(self._slots.rows, index, row, self._hosted.spec)
            except UserError as error:
                seed = self._slots.seed[index]
                raise UserError(f"{error}, in the episode of seed {seed}") from error
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


Answer = list[Lost] | UserError | None
"""Of a worker: first, that its environments are made (None) or cannot be; then, what was lost."""


class WorkerDied(Exception):
    """There will be no answer."""

    def __init__(self, why: str = "", before_ready: str = ""):
        super().__init__(why)
        self.why = f": {why}" if why else ""
        self.before_ready = f"; {before_ready}" if before_ready else self.why


class Worker(Protocol):
    """Holds some of the environments, in a process somewhere."""

    envs: range

    def ask(self) -> None:
        """Have the commands of its slots carried out."""
        ...

    def answer(self) -> Answer:
        """What it said, its rows being in the slots. Raises WorkerDied."""
        ...


W = TypeVar("W", bound=Worker)


class Crew(Protocol[W]):
    """How workers are had and spoken to."""

    slots: Slots
    slow: str
    """What may be the matter where a worker is not ready in time."""

    def start(self, envs: range) -> W:
        """A worker that makes its environments at once."""
        ...

    def wait(self, workers: Sequence[W], timeout: float) -> list[W]:
        """Those of `workers` that have answered or died, or none after `timeout` seconds."""
        ...

    def kill(self, worker: W) -> None:
        """End a worker that is of no more use, and whatever it has started."""
        ...

    def dismiss(self, workers: Sequence[W]) -> None:
        """Let workers close their environments, and end."""
        ...


class WorkerPool(Generic[W]):
    """Environments in workers.

    A worker that dies, or does not answer within `timeout` seconds, is replaced; the episodes of
    its environments are lost.
    """

    def __init__(self, hosted: Hosted, crew: Crew[W], num_workers: int, timeout: float):
        self.slots = crew.slots
        self._spec, self._crew, self._timeout = hosted.spec, crew, timeout
        num_envs = len(self.slots.command)
        self._patience = Patience(hosted.spec, num_envs)
        bounds = [round(i * num_envs / num_workers) for i in range(num_workers + 1)]
        self._workers = [crew.start(range(*b)) for b in pairwise(bounds)]
        self._ready = [False] * num_workers
        self._waiting: list[int] = []

    def send(self) -> None:
        """Wake the workers that have something to do."""
        for k, worker in enumerate(self._workers):
            if self._busy(k):
                self._await_ready(k)
                self._waiting.append(k)
                worker.ask()

    def receive(self) -> list[Lost]:
        """Wait for the workers that `send` woke."""
        lost: list[Lost] = []
        patience = self._timeout * max((self._busy(k) for k in self._waiting), default=0)
        deadline = time.monotonic() + patience
        while self._waiting:
            workers = [self._workers[k] for k in self._waiting]
            ready = self._crew.wait(workers, max(0.0, deadline - time.monotonic()))
            for worker in ready:
                k = self._workers.index(worker)
                self._waiting.remove(k)
                try:
                    answer = worker.answer()
                except WorkerDied as death:
                    lost += self._replace(k, f"its worker process died{death.why}")
                    continue
                if isinstance(answer, UserError):
                    raise answer
                lost += answer or ()
            if not ready:
                for k in self._waiting:
                    lost += self._replace(k, f"no answer within {patience:g} seconds")
                self._waiting.clear()
        self._patience.watch(self.slots, lost)
        return lost

    def close(self) -> None:
        """Ask workers to end, and end those that do not."""
        self._crew.dismiss(self._workers)

    def _busy(self, k: int) -> int:
        """How many environments of a worker have something to do, one after the other."""
        envs = self._workers[k].envs
        return int(np.count_nonzero(self.slots.command[envs.start : envs.stop]))

    def _await_ready(self, k: int) -> None:
        """Raises UserError if the environments cannot be made."""
        if self._ready[k]:
            return
        worker, name = self._workers[k], self._spec.name
        if not self._crew.wait([worker], START_TIMEOUT):
            raise UserError(
                f"a worker of {name} was not ready after {START_TIMEOUT:g} seconds{self._crew.slow}"
            )
        try:
            answer = worker.answer()
        except WorkerDied as error:
            raise UserError(
                f"a worker of {name} died before it was ready{error.before_ready}"
            ) from error
        if isinstance(answer, UserError):
            raise answer
        self._ready[k] = True

    def _replace(self, k: int, reason: str) -> list[Lost]:
        worker = self._workers[k]
        self._crew.kill(worker)
        self._ready[k] = False
        self._workers[k] = self._crew.start(worker.envs)
        return [Lost(index, reason) for index in worker.envs]
