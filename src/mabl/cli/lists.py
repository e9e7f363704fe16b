"""Commands that list what there is: envs, algos."""

from rich.table import Table

from mabl.cli.shared import print_table
from mabl.parsing import parse


def list_envs(arguments: list[str]) -> None:
    """List environments."""
    parse(lambda: None, arguments, "mabl envs", description=list_envs.__doc__)
    from mabl.envs import registry

    rows = registry.names()
    table = Table(box=None, padding=(0, 1))
    for name in rows[0]._fields:
        table.add_column(name.replace("_", " "), no_wrap=name == "name")
    for row in rows:
        table.add_row(*("-" if value is None else str(value) for value in row))
    print_table(table)


def list_algos(arguments: list[str]) -> None:
    """List algorithms."""
    parse(lambda: None, arguments, "mabl algos", description=list_algos.__doc__)
    from mabl.algorithms.registry import ALGORITHMS, COLUMNS

    table = Table(box=None, padding=(0, 1))
    for heading in ("name", *(column.heading for column in COLUMNS), "description"):
        table.add_column(heading, no_wrap=heading == "name")
    for name, entry in ALGORITHMS.items():
        marks = ("yes" if getattr(entry, column.field) else "no" for column in COLUMNS)
        table.add_row(name, *marks, entry.description)
    print_table(table)
