"""Executor x worker pool -> rows: what `rollout` does, for environments that run in Python."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, UInt32

from mabl.envs.base import EnvSpec
from mabl.envs.host import empty_rows
from mabl.envs.pool import IDLE, RESET, STEP, Lost, Pool
from mabl.execution import Executor, Memory
from mabl.rollout import Collector, Episodes, Rollout, row_keys
from mabl.rows import TimeStep, is_last
from mabl.types import PRNGKey


class Begun(NamedTuple):
    """What decides a host environment's next episode."""

    root: UInt32[Array, ""]
    count: Int[Array, ""]
    """Episodes begun so far."""

    def seed(self, index: Any) -> int:
        """Of the next reset of environment `index`."""
        words = np.random.SeedSequence((int(self.root[index]), int(self.count[index])))
        return int(words.generate_state(1)[0])


def start_hosted(spec: EnvSpec, executor: Executor, key: PRNGKey) -> Collector:
    """A collector whose next row is a reset."""
    row = jax.tree.map(jnp.asarray, empty_rows(spec))
    return Collector(
        env_state=Begun(jax.random.bits(key, dtype=jnp.uint32), jnp.int32(0)),
        row=row._replace(
            is_first=jnp.bool_(True),
            truncated=jnp.bool_(True),
            available=jnp.ones_like(row.available),
        ),
        memory=executor.initial(row),
        episode_return=jnp.float32(0),
        episode_length=jnp.int32(0),
    )


def act_where(
    executor: Executor, memory: Memory, row: TimeStep, key: PRNGKey, count: Array, go: Array
) -> tuple[Memory, Array]:
    """The joint action at the newest row of one environment, as `advance` draws it."""
    key_act, _, _ = row_keys(jax.random.fold_in(key, count))
    after, action = executor.act(memory, row, key_act)
    return jax.tree.map(lambda new, old: jnp.where(go, new, old), after, memory), action


Act = Callable[[Memory, TimeStep, np.ndarray, np.ndarray], tuple[Memory, Array]]
"""`act_where` over all environments, with an executor and keys: memories and rows `[F, ...]`,
counts and who is to go `[F]`."""


class Collected(NamedTuple):
    """A rollout in F environments, and the collectors on either side of it."""

    before: Collector
    """Newest rows may have been truncated since: where a worker was lost, or is new."""
    after: Collector
    rollout: Rollout


class HostRollouts:
    """Goes on, call after call, with the F environments of a pool.

    While the learner learns, environments whose episode is over are reset already.
    """

    def __init__(self, pool: Pool, spec: EnvSpec, n_rows: int, one_episode: bool = False):
        self._pool, self._spec = pool, spec
        self._n_rows, self._one_episode = n_rows, one_episode
        n_envs = len(pool.slots.command)
        self._running = np.zeros(n_envs, bool)
        self._ahead = np.zeros(n_envs, bool)

    def collect(self, act: Act, collectors: Collector) -> Collected:
        """`n_rows` rows of every environment, or fewer if `one_episode` ends before.

        An episode whose worker is lost is truncated at its last row, and is not counted.
        """
        flight = _Flight(collectors, self._spec, self._n_rows)
        slots, memory = self._pool.slots, collectors.memory
        ahead = self._finish_ahead(flight)
        for index in np.flatnonzero(~self._running).tolist():
            flight.cut(index)
        while (go := flight.unfinished(self._one_episode)).any():
            over = is_last(flight.row)
            memory, action = act(memory, flight.row, flight.count, go)
            slots.action[:] = action
            arrived = self._command(flight, go & ~ahead, over) & go
            flight.take(slots.rows, arrived | (go & ahead & self._running), over)
            ahead[:] = False
        self._begin_ahead(flight)
        return flight.land(memory)

    def _command(self, flight: "_Flight", go: np.ndarray, over: np.ndarray) -> np.ndarray:
        """Step or reset those that go; who did."""
        self._send(flight, go, over)
        return self._receive(flight, go, over)

    def _send(self, flight: "_Flight", go: np.ndarray, over: np.ndarray) -> None:
        slots = self._pool.slots
        slots.command[:] = np.where(go, np.where(over, RESET, STEP), IDLE)
        for index in np.flatnonzero(go & over):
            slots.seed[index] = flight.begun.seed(index)
        self._pool.send()

    def _receive(self, flight: "_Flight", go: np.ndarray, over: np.ndarray) -> np.ndarray:
        lost = self._pool.receive()
        flight.begun.count[go & over] += 1
        self._running |= go
        arrived = go.copy()
        for index, _ in lost:
            arrived[index] = self._running[index] = False
            flight.cut(index)
        warn_of(lost, self._spec)
        return arrived

    def _begin_ahead(self, flight: "_Flight") -> None:
        self._ahead = is_last(flight.row)
        self._send(flight, self._ahead, self._ahead)

    def _finish_ahead(self, flight: "_Flight") -> np.ndarray:
        """Whose reset row lies in the slots already."""
        return self._receive(flight, self._ahead, self._ahead)


class _Flight:
    """A rollout as it grows: numpy copies of the collectors, and what has come in."""

    def __init__(self, collectors: Collector, spec: EnvSpec, n_rows: int):
        self._before = jax.tree.map(np.array, collectors._replace(memory=None))
        self._memory = collectors.memory
        now = jax.tree.map(np.array, self._before)
        self.begun, self.row = now.env_state, now.row
        self._return, self._length = now.episode_return, now.episode_length
        n_envs = len(self._return)
        self.count: Any = np.zeros(n_envs, np.int32)
        self._rows = empty_rows(spec, n_envs, n_rows)
        shape = (n_envs, n_rows)
        dtypes: tuple[Any, ...] = (bool, np.float32, np.int32, np.float32)
        columns: list[Any] = [np.zeros(shape, dtype) for dtype in dtypes]
        self._episodes = Episodes(*columns)

    def unfinished(self, one_episode: bool) -> np.ndarray:
        """Who has rows to add."""
        more = self.count < self._rows.reward.shape[1]
        return more & ((self.count == 0) | ~is_last(self.row)) if one_episode else more

    def take(self, rows: TimeStep, arrived: np.ndarray, over: np.ndarray) -> None:
        """Add a row of each environment that has one; `over`: it is a reset."""
        at = np.flatnonzero(arrived)
        where = at, self.count[at]
        for mine, kept, new in zip(self.row, self._rows, rows, strict=True):
            mine[at] = new[at]
            kept[where] = new[at]
        began = over[at]
        self._return[at] = np.where(began, 0, self._return[at] + rows.reward[at].mean(-1))
        self._length[at] = np.where(began, 0, self._length[at] + 1)
        ended = is_last(self.row)[at]
        values = ended, self._return[at], self._length[at], rows.score[at]
        for kept, new in zip(self._episodes, values, strict=True):
            kept[where] = np.where(ended, new, 0)
        self.count[at] += 1

    def cut(self, index: int) -> None:
        """The episode of an environment goes on nowhere: its last row truncates it."""
        if is_last(self.row)[index]:
            return
        self.row.truncated[index] = True
        if self.count[index]:
            self._rows.truncated[index, self.count[index] - 1] = True
        else:
            self._before.row.truncated[index] = True

    def land(self, memory: Memory) -> Collected:
        """All that came in."""
        after = Collector(self.begun, self.row, memory, self._return, self._length)
        rollout = Rollout(self._rows, self._episodes, self.count)
        return Collected(self._before._replace(memory=self._memory), after, rollout)


def warn_of(lost: list[Lost], spec: EnvSpec) -> None:
    """Say whose episodes were dropped, and why."""
    for index, reason in lost:
        last = reason.strip().splitlines()[-1]
        warnings.warn(
            f"{spec.name}: the unfinished episode of environment {index} is dropped: {last}",
            stacklevel=3,
        )
