"""Flags by tyro, and what it has to say about them in one line."""

import io
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from typing import Any, TypeVar

import tyro

from mabl.errors import UserError

T = TypeVar("T")


def parse(fields: Callable[..., T], arguments: Sequence[str], prog: str, **options: Any) -> T:
    """A dataclass of flags. Raises UserError for those that it does not have, or cannot read."""
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            return tyro.cli(fields, args=arguments, prog=prog, **options)
    except SystemExit as exit_:
        if not exit_.code:
            raise
        raise UserError(f"{in_one_line(said.getvalue())}: {prog} --help lists them") from None


def in_one_line(box: str) -> str:
    """What a message of tyro's says, without its frame, and the flag that it has in mind."""
    rows = [row.strip(" │╭╮╰╯") for row in box.splitlines()[1:]]  # after the title
    rules = [i for i, row in enumerate(rows) if not row.strip("─-")]
    first = next(i for i in range(len(rows) + 1) if i not in rules)
    end = next((i for i in rules if i > first), len(rows))
    message = " ".join(" ".join(rows[first:end]).split())
    meant = next((row for row in rows[end:] if row.startswith("--") and row.strip("-")), "")
    return f"{message}; there is {meant}" if meant else message
