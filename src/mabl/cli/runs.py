"""Commands that make runs: train, resume, and bench, which times one."""

from argparse import ArgumentError, ArgumentParser
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from mabl.cli.shared import EXIT_CODES, print_table, shallow
from mabl.errors import UserError
from mabl.parsing import parse

if TYPE_CHECKING:
    from mabl.algorithms.config import Config


def train(arguments: list[str]) -> int:
    """Train an algorithm in an environment."""
    default, rest = chosen_preset(arguments)
    config = parse_config(rest, default)
    from mabl.devices import use_compilation_cache
    from mabl.training.run import train as train_run

    use_compilation_cache()
    return EXIT_CODES[train_run(config).stopped_by]


def chosen_preset(arguments: list[str], prog: str = "mabl train") -> tuple["Config", list[str]]:
    """The preset of an environment and an algorithm, and the flags that are left."""
    from mabl.algorithms.presets import preset

    base = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for flag, default in (("--env", "smax/3m"), ("--algo", "mabl"), ("--preset", "quick")):
        base.add_argument(flag, default=default)
    try:
        chosen, rest = base.parse_known_args(arguments)
    except ArgumentError as error:
        raise UserError(f"{error}: {prog} --help lists them") from error
    return preset(chosen.preset, chosen.env, chosen.algo), rest


def parse_config(arguments: list[str], default: "Config") -> "Config":
    """`default` with flags applied; sections that the algorithm does not read have no flags."""
    return parse_with_config(arguments, default, "mabl train", train.__doc__)[0]


def parse_with_config(
    arguments: list[str], default: "Config", prog: str, description: str | None, *own: Any
) -> tuple["Config", Any]:
    """A config, and all that was parsed: with it the fields that a command has of its `own`."""
    from mabl.algorithms.config import Config
    from mabl.algorithms.registry import unread

    hidden = [
        (section, Annotated[Any, tyro.conf.Fixed, tyro.conf.Suppress], getattr(default, section))
        for section in unread(default.algo)
    ]
    flags = make_dataclass("Config", [*own, *hidden], bases=(Config,), frozen=True)
    base = flags(**shallow(default))
    given = parse(flags, arguments, prog, default=base, description=description)
    return Config(**{name: getattr(given, name) for name in shallow(default)}), given


@dataclass(frozen=True)
class ResumeArguments:
    """Continue a run from its newest checkpoint."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folder, as printed by `mabl train`; several seeds of one program go on in one."""
    total_steps: int | None = None
    """New number of environment steps; default: as configured."""
    num_devices: int | None = None
    """Accelerators to go on with; default: as configured."""
    trust: bool = False
    """Let a run that somebody else wrote name its environment's code."""


def resume(arguments: list[str]) -> int:
    """Continue a run from its newest checkpoint."""
    given = parse(ResumeArguments, arguments, "mabl resume")
    if not given.runs:
        raise UserError("mabl resume needs a run folder: give one of mabl train's")
    from mabl.devices import use_compilation_cache
    from mabl.training.run import resume as resume_run

    use_compilation_cache()
    outcome = resume_run(given.runs, given.total_steps, given.num_devices, given.trust)
    return EXIT_CODES[outcome.stopped_by]


BENCH = (
    ("repeats", Annotated[int, tyro.conf.arg(help="Times that each part is run.")], 5),
    ("parts", Annotated[tuple[str, ...], tyro.conf.arg(help="Parts to time; all, if none.")], ()),
    ("json", Annotated[Path | None, tyro.conf.arg(help="File for all numbers.")], None),
    ("against", Annotated[Path | None, tyro.conf.arg(help="Such a file, to compare with.")], None),
)
"""What `mabl bench` reads beside a config."""


def bench(arguments: list[str]) -> int:
    """Time the parts of a run."""
    default, rest = chosen_preset(arguments)
    config, given = parse_with_config(rest, default, "mabl bench", bench.__doc__, *BENCH)
    if given.repeats < 1:
        raise UserError(f"--repeats is {given.repeats}: give a number above 0")
    if given.json and not given.json.parent.is_dir():
        raise UserError(f"--json {given.json}: there is no folder {given.json.parent}")
    if given.json and given.json.is_dir():
        raise UserError(f"--json {given.json} is a folder: give a file")
    from mabl import bench as benchmark
    from mabl import bench_table

    baseline = bench_table.read(given.against) if given.against else None
    console = Console(stderr=True)
    with console.status("starting") as status:
        report = benchmark.measure(config, given.repeats, given.parts, status.update)
    print_table(bench_table.table(report, baseline))
    if given.json:
        report.write(given.json)
    return 0
