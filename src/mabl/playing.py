"""Playing episodes to look at, one picture after the other.

Compiled environments play what `evaluation` counts with the same key; others play other episodes.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from mabl.envs.base import CompiledEnv, Drawing
from mabl.envs.host import Hosted, HostEnv
from mabl.errors import UserError
from mabl.execution import Executor
from mabl.rollout import advance, start
from mabl.rows import TimeStep, is_last
from mabl.types import PRNGKey

FRAMES_PER_SECOND = 10.0
"""Of environments in Python that do not say."""
PAUSE = 1.0
"""Seconds for which an episode's end is shown."""


class Outcome(NamedTuple):
    """How an episode went."""

    episode_return: float
    """Mean over agents of the summed rewards, in the environment's units."""
    length: int
    """Joint steps."""
    score: float


class Show(NamedTuple):
    """An environment that can be seen."""

    frames_per_second: float
    episode: Callable[[Executor, PRNGKey], Iterator[tuple[TimeStep, Iterable[np.ndarray]]]]
    """Its rows, and what is to be seen on the way to each."""


@contextmanager
def show_of(env: CompiledEnv | Hosted) -> Iterator[Show]:
    """Raises UserError for an environment that cannot draw."""
    cannot = UserError(f"{env.spec.name} cannot be seen: it draws nothing")
    if not isinstance(env, Hosted):
        drawing = getattr(env, "drawing", None)
        if drawing is None:
            raise cannot
        yield _compiled(env, drawing())
        return
    with _said(env.spec.name):
        host = (env.draw or env.make)()
    try:
        if not hasattr(host, "render"):
            raise cannot
        fps = getattr(host, "frames_per_second", None) or FRAMES_PER_SECOND
        yield Show(fps, partial(_hosted, host))
    finally:
        host.close()


def film(
    show: Show,
    executor: Executor,
    key: PRNGKey,
    episodes: int,
    ended: Callable[[Outcome], None] = lambda _: None,
) -> Iterator[np.ndarray]:
    """The frames of `episodes` episodes; each end stands still for a second."""
    for key_episode in jax.random.split(key, episodes):
        rows, frame = [], None
        for row, frames in show.episode(executor, key_episode):
            rows.append(row)
            for frame in frames:
                yield frame
        if frame is not None:
            yield from [frame] * round(PAUSE * show.frames_per_second)
        paid = sum(float(np.mean(row.reward)) for row in rows)
        ended(Outcome(paid, len(rows) - 1, float(rows[-1].score)))


def _compiled(env: CompiledEnv, drawing: Drawing) -> Show:
    forward = eqx.filter_jit(partial(advance, env))

    def episode(executor: Executor, key: PRNGKey) -> Iterator[tuple[TimeStep, Any]]:
        """The same that `evaluate` plays with this key."""
        key_start, key_play = jax.random.split(key)
        before, last = start(env, executor, key_start), None
        for count in range(env.spec.episode_limit + 1):
            after, _ = forward(executor, before, jax.random.fold_in(key_play, count))
            row = jax.device_get(after.row)
            yield row, drawing.frames(last, after.env_state)
            if is_last(row):
                return
            before, last = after, after.env_state

    return Show(drawing.frames_per_second, episode)


def _hosted(env: HostEnv, executor: Executor, key: PRNGKey) -> Iterator[tuple[TimeStep, Any]]:
    act = eqx.filter_jit(lambda executor, *at: executor.act(*at))
    with _said(env.spec.name):
        row = env.reset(int(jax.random.bits(key)))
    memory, count = executor.initial(row), 0
    while True:
        yield row, [_render(env)]
        if is_last(row):
            return
        memory, action = act(executor, memory, row, jax.random.fold_in(key, count))
        with _said(env.spec.name):
            row, count = env.step(np.asarray(action)), count + 1


def _render(env: Any) -> np.ndarray:
    """Raises UserError if what comes is no picture."""
    with _said(env.spec.name):
        frame = np.asarray(env.render())
    if frame.ndim != 3 or frame.shape[-1] not in (3, 4):
        raise UserError(
            f"{env.spec.name} drew something of shape {frame.shape}: its render() should give an "
            "array [height, width, 3]"
        )
    return frame[..., :3].astype(np.uint8)


@contextmanager
def _said(name: str) -> Iterator[None]:
    """What an environment raises, in one line."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"{name} failed while it was filmed: {error!r}") from error
