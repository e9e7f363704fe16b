"""Environments that run in Python, beside jax. Their worker processes import this, and no jax."""

import importlib
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from inspect import signature
from math import isfinite
from typing import Any, Protocol

import numpy as np

from mabl.envs.base import EnvSpec
from mabl.errors import UserError
from mabl.rows import TimeStep


class HostEnv(Protocol):
    """One simulator. It never resets itself; its rows hold numpy arrays.

    It may draw itself: `render() -> uint8 [height, width, 3]`, and `frames_per_second`.
    """

    spec: EnvSpec

    def reset(self, seed: int) -> TimeStep:
        """Start an episode that `seed` decides; the row has `is_first` set."""
        ...

    def step(self, action: np.ndarray) -> TimeStep:
        """Take one joint step `[N, ...]`. Undefined after a row for which `is_last` holds."""
        ...

    def close(self) -> None:
        """Let go of the simulator."""
        ...


@dataclass(frozen=True)
class Hosted:
    """An environment of workers: its sizes and names, and how a worker makes one."""

    spec: EnvSpec
    make: Callable[[], HostEnv]
    """It travels to other processes: a class, a function of a module, or a `partial` of such."""
    draw: Callable[[], HostEnv] | None = None
    """Makes one that can be seen, where that differs."""
    heuristic: Callable[[], Any] | None = None
    """Makes an executor that is a baseline, if there is one."""


def hosted_of(make: Callable[[], HostEnv], draw: Callable[[], HostEnv] | None = None) -> Hosted:
    """Make one to learn its sizes and names."""
    env = make()
    try:
        return Hosted(env.spec, make, draw)
    finally:
        env.close()


def load_factory(name: str, target: str, default: str) -> Callable[..., Any]:
    """What is at `module:attribute`; for names of one's own, modules in the current folder, too.

    Raises UserError for what cannot be imported.
    """
    module, _, attribute = target.partition(":")
    attribute = attribute or default
    if not module:
        raise UserError(f"{name} names no module: give module:factory")
    if ":" in name and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        found: Any = importlib.import_module(module)
    except ImportError as error:
        raise UserError(
            f"{name} cannot be imported ({error}): install it, or run mabl where it lies"
        ) from error
    for part in attribute.split("."):
        if not hasattr(found, part):
            raise UserError(f"{name}: {module} has no {attribute}: give module:factory")
        found = getattr(found, part)
    if not callable(found):
        raise UserError(f"{name}: {attribute} of {module} is no factory: give module:factory")
    return found


def made(name: str, factory: Callable[..., Any], kwargs: Mapping[str, Any]) -> Any:
    """What a factory makes. Raises UserError for arguments that it does not take, or lacks."""
    try:
        with suppress(ValueError):  # what is built in may not say what it takes
            signature(factory).bind(**kwargs)
    except TypeError as error:
        raise _cannot_be_made(name, kwargs, error) from error
    try:
        return factory(**kwargs)
    except TypeError as error:
        if not kwargs:
            raise
        raise _cannot_be_made(name, kwargs, error) from error


def _cannot_be_made(name: str, kwargs: Mapping[str, Any], error: TypeError) -> UserError:
    given = " ".join(f"{key}={value}" for key, value in kwargs.items()) or "no arguments"
    return UserError(f"{name} cannot be made with {given} ({error}): give --env-kwargs KEY=VALUE")


def empty_rows(spec: EnvSpec, *leading: int) -> TimeStep:
    """Rows of zeros `[*leading, ...]`, to be written."""

    def zeros(dtype: Any, *shape: int) -> Any:
        return np.zeros((*leading, *shape), dtype)

    n, space = spec.n_agents, spec.action_space
    return TimeStep(
        prev_action=zeros(space.dtype, n, *space.shape),
        reward=zeros(np.float32, n),
        terminated=zeros(bool, n),
        truncated=zeros(bool),
        obs=zeros(np.float32, n, spec.obs_dim),
        state=zeros(np.float32, spec.state_dim),
        available=zeros(bool, n, space.size),
        alive=zeros(bool, n),
        is_first=zeros(bool),
        score=zeros(np.float32),
    )


def write_row(rows: TimeStep, index: Any, row: TimeStep, spec: EnvSpec) -> None:
    """Put `row` where `rows[index]` is.

    Raises UserError for a field of another shape, and for observations, states and rewards that
    are not finite.
    """
    for name, slots, value in zip(TimeStep._fields, rows, row, strict=True):
        slot, value = slots[index], np.asarray(value)
        if value.shape != slot.shape:
            raise UserError(
                f"{spec.name} gave {name} of shape {value.shape}, its spec says {slot.shape}"
            )
        if name in ("obs", "state", "reward") and not all_finite(value):
            raise UserError(f"{spec.name} gave {first_not_finite(name, value, spec)}")
        slots[index] = value


def first_not_finite(name: str, value: np.ndarray, spec: EnvSpec) -> str:
    """Where a field of a row has a number that is not one, e.g. `obs[3] = nan for agent 1`."""
    where = np.argwhere(~np.isfinite(value))[0].tolist()
    number = value[tuple(where)]
    if name == "state":
        return f"{name}{where} = {number}"
    agent, *rest = where
    named = f" ({spec.agent_ids[agent]})" if spec.agent_ids else ""
    return f"{name}{rest or ''} = {number} for agent {agent}{named}"


def all_finite(values: np.ndarray) -> bool:
    """Whether they are numbers all; their sum of squares tells it fast unless they are huge."""
    return isfinite(np.vdot(values, values)) or bool(np.isfinite(values).all())
