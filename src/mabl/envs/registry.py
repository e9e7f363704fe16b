"""Environments by name, `family/task`; families are imported when asked for, as some are slow."""

import io
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from functools import partial
from typing import NamedTuple

from mabl.envs.base import CompiledEnv
from mabl.errors import UserError, unknown_name


class Entry(NamedTuple):
    """How to make an environment, and what it is in one line."""

    make: Callable[[], CompiledEnv]
    description: str


class EnvRow(NamedTuple):
    """One line of `mabl envs`."""

    name: str
    agents: int
    obs: int
    state: int
    actions: int
    episode_limit: int
    score: str
    description: str


@contextmanager
def _quiet_jaxmarl() -> Iterator[None]:
    """Imports jaxmarl without its greeting on stdout, and without its brax environments.

    Their module replaces `sys.stdout` and `sys.stderr` by the process's own, to the dismay of
    whoever had redirected them. jaxmarl copes with its absence.
    """
    if "jaxmarl" in sys.modules:
        yield
        return
    sys.modules["jaxmarl.environments.mabrax"] = None  # type: ignore[assignment]
    try:
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        del sys.modules["jaxmarl.environments.mabrax"]


def _smax() -> Mapping[str, Entry]:
    with _quiet_jaxmarl():
        from mabl.envs import smax
    return {
        f"smax/{name}": Entry(partial(smax.make, name), battle.description)
        for name, battle in smax.SCENARIOS.items()
    }


def _test() -> Mapping[str, Entry]:
    from mabl.envs.coordination import CoordinationEnv
    from mabl.envs.counting import CountingEnv

    return {
        "test/counting": Entry(CountingEnv, "a toy whose rows can be predicted by hand"),
        "test/coordination": Entry(CoordinationEnv, "a toy that pays for acting together"),
    }


FAMILIES: dict[str, Callable[[], Mapping[str, Entry]]] = {"smax": _smax, "test": _test}
"""Family to its entries by full name."""


def _entries() -> dict[str, Entry]:
    return {name: entry for family in FAMILIES.values() for name, entry in family().items()}


def family(name: str) -> Callable[[], Mapping[str, Entry]]:
    """Where an environment of that name would be found."""
    return FAMILIES.get(name.partition("/")[0], dict)


def make(name: str) -> CompiledEnv:
    """The environment of that name, e.g. `smax/3s_vs_4z`; `UserError` if there is none."""
    entries = family(name)()
    if name not in entries:
        raise unknown(name)
    return entries[name].make()


def unknown(name: str) -> UserError:
    """The error for an environment that does not exist."""
    return unknown_name("environment", name, _entries())


def names() -> list[EnvRow]:
    """Every environment, made once to learn its sizes; imports all families."""
    rows = []
    for name, entry in _entries().items():
        spec = entry.make().spec
        rows.append(
            EnvRow(
                name,
                spec.n_agents,
                spec.obs_dim,
                spec.state_dim,
                spec.action_space.size,
                spec.episode_limit,
                spec.score_name,
                entry.description,
            )
        )
    return rows
