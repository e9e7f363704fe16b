"""Environments by name: `family/task`, or `adapter:module:factory` for one's own.

Families are imported when asked for, as some are slow.
"""

import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec, module_from_spec
from multiprocessing import current_process
from typing import Any, NamedTuple

from mabl import plain_yaml
from mabl.envs.base import CompiledEnv
from mabl.envs.host import Hosted, made
from mabl.errors import UserError, unknown_name


class Entry(NamedTuple):
    """How to make an environment, and what it is in one line."""

    make: Callable[..., CompiledEnv | Hosted]
    description: str


class EnvRow(NamedTuple):
    """One line of `mabl envs`."""

    name: str
    agents: int | None
    obs: int | None
    state: int | None
    actions: int | None
    episode_limit: int | None
    score: str | None
    description: str
    """What it is; where it cannot be made here, what it needs."""


@contextmanager
def _hollow(*packages: str) -> Iterator[None]:
    """Imports modules of `packages` (outermost first) without what the packages themselves import.

    A later import of a package runs it in full, and finds the modules that are already there.
    """
    hollow = []
    try:
        for name in packages:
            if name not in sys.modules and (spec := find_spec(name)):
                sys.modules[name] = module_from_spec(spec)
                hollow.append(name)
        yield
    finally:
        for name in hollow:
            del sys.modules[name]


def _smax() -> Mapping[str, Entry]:
    # jaxmarl imports all of its environments (four seconds), prints, and with brax installed
    # replaces `sys.stdout` and `sys.stderr`.
    with _hollow("jaxmarl", "jaxmarl.environments"):
        from mabl.envs import smax
    return {
        f"smax/{name}": Entry(partial(smax.make, name), battle.description)
        for name, battle in smax.SCENARIOS.items()
    }


def _test() -> Mapping[str, Entry]:
    from mabl.envs.aiming import AimingEnv
    from mabl.envs.coordination import CoordinationEnv
    from mabl.envs.counting import CountingEnv
    from mabl.envs.counting_host import HostCountingEnv

    counting_host = Hosted(HostCountingEnv.spec, HostCountingEnv)
    return {
        "test/counting": Entry(CountingEnv, "a toy whose rows can be predicted by hand"),
        "test/host-counting": Entry(lambda: counting_host, "the same in Python"),
        "test/coordination": Entry(CoordinationEnv, "a toy that pays for acting together"),
        "test/aiming": Entry(AimingEnv, "a toy with continuous actions"),
    }


def _smac() -> Mapping[str, Entry]:
    from mabl.envs import smac

    return {
        f"smac/{name}": Entry(partial(smac.make_map, f"smac/{name}"), description)
        for name, description in smac.MAPS.items()
    }


def _smacv2() -> Mapping[str, Entry]:
    from mabl.envs import smac

    return {
        (name := f"smacv2/{race}_{n}_vs_{m}"): Entry(
            partial(smac.make_generated, name, race, n, m), "units and places drawn anew each time"
        )
        for race in smac.RACES
        for n, m in smac.SIZES
    }


def _smac_like(name: str, target: str, episode_limit: int | None = None, **kwargs: Any) -> Hosted:
    from mabl.envs import smac

    return smac.make(name, target, kwargs, episode_limit)


def _flatland() -> Mapping[str, Entry]:
    from mabl.envs import flatland

    return {
        (name := f"flatland/{key}"): Entry(
            partial(flatland.make, name), f"{task.n_agents} trains, {task.n_cities} cities"
        )
        for key, task in flatland.TASKS.items()
    }


def _mamujoco() -> Mapping[str, Entry]:
    from mabl.envs import mamujoco

    return {
        (name := f"mamujoco/{key}"): Entry(partial(mamujoco.make, name), robot.description)
        for key, robot in mamujoco.ROBOTS.items()
    }


def _pettingzoo(
    name: str,
    target: str,
    episode_limit: int | None = None,
    symlog: bool = False,
    **kwargs: Any,
) -> Hosted:
    from mabl.envs import pettingzoo

    return pettingzoo.make(name, target, kwargs, episode_limit, symlog)


FAMILIES: dict[str, Callable[[], Mapping[str, Entry]]] = {
    "smax": _smax,
    "smac": _smac,
    "smacv2": _smacv2,
    "flatland": _flatland,
    "mamujoco": _mamujoco,
    "test": _test,
}
"""Family to its entries by full name."""

ADAPTERS: dict[str, Callable[..., Hosted]] = {"pettingzoo": _pettingzoo, "smac": _smac_like}
"""Interfaces of one's own environments, from a full name and `module:factory`."""


def _entries() -> dict[str, Entry]:
    return {name: entry for family in FAMILIES.values() for name, entry in family().items()}


def family_of(name: str) -> str:
    """The family or the adapter that a name begins with."""
    return re.split("[/:]", name, maxsplit=1)[0]


def names_code(name: str) -> bool:
    """Whether making that environment imports a module that the name chooses."""
    return ":" in name


def family(name: str) -> Callable[..., Any]:
    """Where an environment of that name would be found."""
    known = ADAPTERS if names_code(name) else FAMILIES
    return known.get(family_of(name), dict)


def make(name: str, kwargs: Sequence[str] = ()) -> CompiledEnv | Hosted:
    """The environment of that name, made with `kwargs` such as `max_cycles=25`.

    Raises UserError if there is none, and for arguments that it does not take.
    """
    if getattr(current_process(), "_inheriting", False):
        raise UserError('a script that trains must do so under if __name__ == "__main__":')
    given = parse_kwargs(kwargs)
    adapter, _, target = name.partition(":")
    if adapter in ADAPTERS and names_code(name):
        return ADAPTERS[adapter](name, target, **given)
    entries = family(name)()
    if name not in entries:
        raise unknown(name)
    return made(name, entries[name].make, given)


def parse_kwargs(kwargs: Sequence[str]) -> dict[str, Any]:
    """`KEY=VALUE` by key, values in YAML. Raises UserError for anything else."""
    parsed: dict[str, Any] = {}
    for text in kwargs:
        key, equals, value = text.partition("=")
        if not (equals and key.isidentifier()):
            raise UserError(f"--env-kwargs {text!r}: give KEY=VALUE, e.g. max_cycles=25")
        try:
            parsed[key] = plain_yaml.load(value)
        except ValueError as error:
            raise UserError(f"--env-kwargs {text!r}: {value!r} is not YAML") from error
    return parsed


def unknown(name: str) -> UserError:
    """The error for an environment that does not exist."""
    own = (f"{adapter}:module:factory" for adapter in ADAPTERS)
    return unknown_name("environment", name, (*_entries(), *own))


def names() -> list[EnvRow]:
    """Every environment, made once to learn its sizes; imports all families."""
    return [_row(name, entry) for name, entry in _entries().items()]


def _row(name: str, entry: Entry) -> EnvRow:
    try:
        spec = entry.make().spec
    except UserError as error:
        needs = str(error).splitlines()[0].removeprefix(f"{name} ")
        return EnvRow(name, None, None, None, None, None, None, needs)
    return EnvRow(
        name,
        spec.n_agents,
        spec.obs_dim,
        spec.state_dim,
        spec.action_space.size,
        spec.episode_limit,
        spec.score_name,
        entry.description,
    )
