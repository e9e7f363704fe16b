"""The one exception whose text is shown to a user instead of a traceback."""

import errno
from collections.abc import Iterable
from difflib import get_close_matches
from math import inf

UNWRITABLE = (
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
)
"""A user's to mend: no permission, a file system for reading only, a full disk, a limit reached."""


PREEMPTED = 75
"""Exit code of a run or a job that was told to stop, all being saved: `EX_TEMPFAIL`."""


class UserError(Exception):
    """A mistake the user can mend, said in one line: what came, what was expected, what to do."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UserError:
    """The error for a name that a registry lacks, with the nearest names and all that exist."""
    names, name = sorted(known), name[:100]
    task = name.rpartition("/")[2]
    near = get_close_matches(name, names, n=3, cutoff=0.5) or [
        other for other in names if other.endswith(f"/{task}")
    ]
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    return UserError(f"unknown {kind} {name!r}: {hint}choose from {', '.join(names)}")


def require_positive(config: object, *names: str) -> None:
    """Raise UserError unless each named field of a config is None or above 0."""
    for name in names:
        value = getattr(config, name)
        if value is not None and not 0 < value < inf:
            raise _out_of_range(config, name, value, "a number above 0")


def require_between(config: object, low: float, high: float, *names: str) -> None:
    """Raise UserError unless each named field of a config is None or lies in [low, high]."""
    for name in names:
        value = getattr(config, name)
        if value is not None and not low <= value <= high:
            raise _out_of_range(config, name, value, f"a number from {low:g} to {high:g}")


def _out_of_range(config: object, name: str, value: object, expected: str) -> UserError:
    flag = f"{getattr(config, 'FLAG_PREFIX', '')}{name}".replace("_", "-")
    return UserError(f"--{flag} is {value!r}: give {expected}")
