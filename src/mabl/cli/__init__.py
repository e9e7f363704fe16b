"""The command line: `mabl COMMAND`; a command takes its arguments, and returns its exit code."""

import os
import sys
import warnings

from rich.console import Console
from rich.table import Table

from mabl.cli.episodes import check_env, evaluate, play
from mabl.cli.experiments import job, report, suite, sweep, watch
from mabl.cli.lists import list_algos, list_envs
from mabl.cli.runs import bench, resume, train
from mabl.cli.shared import INTERRUPTED
from mabl.errors import UNWRITABLE, UserError, unknown_name


def main() -> None:
    """Run a command. A user's mistake is one line on stderr and exit code 2."""
    warnings.formatwarning = lambda message, *_, **__: f"mabl: {message}\n"
    try:
        sys.exit(run(sys.argv[1:]))
    except UserError as error:
        print(f"mabl: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        if error.filename is None and error.errno not in UNWRITABLE:
            raise
        where = f" ({error.filename})" if error.filename else ""
        what = (
            "give mabl a place to write" if error.errno in UNWRITABLE else "look at what is there"
        )
        print(f"mabl: {error.strerror}{where}: {what}", file=sys.stderr)
        sys.exit(2)


def run(arguments: list[str]) -> int:
    """Dispatch to a command; returns the exit code."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print_help()
        return 0
    name, *rest = arguments
    if name not in COMMANDS:
        raise unknown_name("command", name, COMMANDS)
    return COMMANDS[name](rest) or 0


def print_help() -> None:
    """What commands there are."""
    console = Console()
    console.print("mabl: sample-efficient multi-agent RL with world models\n")
    table = Table(box=None, show_header=False)
    for name, command in COMMANDS.items():
        table.add_row(f"mabl {name}", (command.__doc__ or "").splitlines()[0])
    console.print(table)
    console.print("\nmabl COMMAND --help shows a command's options.")


COMMANDS = {
    "train": train,
    "resume": resume,
    "eval": evaluate,
    "play": play,
    "suite": suite,
    "report": report,
    "sweep": sweep,
    "watch": watch,
    "envs": list_envs,
    "check-env": check_env,
    "bench": bench,
    "algos": list_algos,
    "job": job,
}
