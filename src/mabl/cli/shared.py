"""What commands have in common: exit codes, tables, bars."""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from mabl.errors import PREEMPTED

PIPED_WIDTH = 160
"""Columns of a table that goes to a file or another program."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells expect."""

EXIT_CODES = {None: 0, signal.SIGINT: INTERRUPTED, signal.SIGTERM: PREEMPTED}
"""Of a run, by what ended it early."""


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar on the terminal while something goes on; tell it how much is done."""
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)


def shallow(config: Any) -> dict[str, Any]:
    """A dataclass's fields, one level deep."""
    return {f.name: getattr(config, f.name) for f in fields(config)}


def print_table(table: Table) -> None:
    """As wide as the terminal, or wide enough for a file."""
    Console(width=None if sys.stdout.isatty() else PIPED_WIDTH).print(table)
