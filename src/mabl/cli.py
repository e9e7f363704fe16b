"""The command line: train, resume, eval, envs, check-env, algos."""

import errno
import json
import os
import sys
from argparse import ArgumentParser
from dataclasses import dataclass, fields, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from mabl.errors import UserError, unknown_name

if TYPE_CHECKING:
    from mabl.algorithms.config import Config

PIPED_WIDTH = 160
"""Columns of a table that goes to a file or another program."""

UNWRITABLE = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC)
"""A user's to mend: no permission, a file system for reading only, a full disk."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells expect."""


def main() -> None:
    """Run a command. A user's mistake is one line on stderr and exit code 2."""
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
        if error.errno not in UNWRITABLE:
            raise
        where = f" ({error.filename})" if error.filename else ""
        print(f"mabl: {error.strerror}{where}: give mabl a place to write", file=sys.stderr)
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


def train(arguments: list[str]) -> int:
    """Train an algorithm in an environment."""
    from mabl.algorithms.presets import preset

    base = ArgumentParser(add_help=False, allow_abbrev=False)
    for flag, default in (("--env", "smax/3m"), ("--algo", "mabl"), ("--preset", "quick")):
        base.add_argument(flag, default=default)
    chosen, rest = base.parse_known_args(arguments)
    default = preset(chosen.preset, chosen.env, chosen.algo)
    config = parse_config(rest, default)
    from mabl.training.run import train as train_run

    use_compilation_cache()
    return INTERRUPTED if train_run(config).interrupted else 0


def parse_config(arguments: list[str], default: "Config") -> "Config":
    """`default` with flags applied; sections that the algorithm does not read have no flags."""
    from mabl.algorithms.config import Config
    from mabl.algorithms.registry import unread

    hidden = [
        (section, Annotated[Any, tyro.conf.Fixed, tyro.conf.Suppress], getattr(default, section))
        for section in unread(default.algo)
    ]
    flags = make_dataclass("Config", hidden, bases=(Config,), frozen=True)
    given = tyro.cli(
        flags,
        args=arguments,
        default=flags(**shallow(default)),
        prog="mabl train",
        description=train.__doc__,
    )
    return Config(**shallow(given))


@dataclass(frozen=True)
class ResumeArguments:
    """Continue a run from its newest checkpoint."""

    run: tyro.conf.Positional[Path]
    """Run folder, as printed by `mabl train`."""
    total_steps: int | None = None
    """New number of environment steps; default: as configured."""


def resume(arguments: list[str]) -> int:
    """Continue a run from its newest checkpoint."""
    given = tyro.cli(ResumeArguments, args=arguments, prog="mabl resume")
    from mabl.training.run import resume as resume_run

    use_compilation_cache()
    return INTERRUPTED if resume_run(given.run, given.total_steps).interrupted else 0


@dataclass(frozen=True)
class EvalArguments:
    """Play episodes with a trained policy, or with a baseline, and print what came of it."""

    run: tyro.conf.Positional[Path | None] = None
    """Run folder of a trained policy."""
    policy: Literal["random", "heuristic"] | None = None
    """Evaluate a baseline instead of a run; needs --env."""
    env: str | None = None
    """Environment; default: the run's own."""
    env_kwargs: tuple[str, ...] = ()
    """Arguments that it is made with: KEY=VALUE, values in YAML."""
    episodes: int = 32
    """Episodes to play."""
    greedy: Annotated[bool, tyro.conf.arg(help_behavior_hint="")] = True
    """Take the likeliest action; --no-greedy or --sample draws it from the policy."""
    seed: int = 0
    """Decides the episodes."""
    num_workers: int | None = None
    """Processes for environments that run in Python; 0: this one; None: one a core."""
    json: bool = False
    """Print one JSON object."""


def evaluate(arguments: list[str]) -> int:
    """Play episodes with a trained policy or a baseline."""
    arguments = ["--no-greedy" if a == "--sample" else a for a in arguments]
    given = tyro.cli(EvalArguments, args=arguments, prog="mabl eval")
    if (given.run is None) == (given.policy is None):
        raise UserError("give either a run folder or --policy random|heuristic with --env")
    if given.episodes < 1:
        raise UserError(f"--episodes is {given.episodes}: give a number above 0")
    if not 0 <= given.seed < 2**32:
        raise UserError(f"--seed is {given.seed}: give a number from 0 to {2**32 - 1}")
    import jax

    from mabl.evaluation import baseline, summary
    from mabl.evaluation import evaluate as play

    use_compilation_cache()
    if given.run is not None:
        from mabl.policy import load_run

        loaded = load_run(given.run, given.env, given.env_kwargs, given.greedy)
        env, executor = loaded.env, loaded.executor
        subject = {"run": str(given.run), "step": loaded.step, "greedy": given.greedy}
    else:
        if given.env is None:
            raise UserError(f"--policy {given.policy} needs --env: mabl envs lists them")
        from mabl.envs import registry

        env = registry.make(given.env, given.env_kwargs)
        executor = baseline(given.policy or "", env)
        subject = {"policy": given.policy}
    results = play(env, executor, jax.random.key(given.seed), given.episodes, given.num_workers)
    numbers = {"env": env.spec.name, **subject, **summary(results, env.spec)}
    if given.json:
        print(json.dumps(numbers))
    else:
        table = Table(show_header=False, box=None)
        for key, value in numbers.items():
            table.add_row(key, f"{value:.3f}" if isinstance(value, float) else str(value))
        print_table(table)
    return 0


@dataclass(frozen=True)
class CheckArguments:
    """Play random episodes in an environment, and say whether one can learn there."""

    env: tyro.conf.Positional[str]
    """Environment, e.g. pettingzoo:module:factory."""
    env_kwargs: tuple[str, ...] = ()
    """Arguments that it is made with: KEY=VALUE, values in YAML."""
    episodes: int = 5
    """Episodes to play."""
    seed: int = 0
    """Of the first episode."""


def check_env(arguments: list[str]) -> int:
    """Check an environment with a random policy."""
    given = tyro.cli(CheckArguments, args=arguments, prog="mabl check-env")
    if given.episodes < 1:
        raise UserError(f"--episodes is {given.episodes}: give a number above 0")
    from mabl.checking import check
    from mabl.envs import registry

    findings = check(registry.make(given.env, given.env_kwargs), given.episodes, given.seed)
    table = Table(show_header=False, box=None)
    for verdict, what, message in findings:
        table.add_row({"good": "ok", "look": "look", "bad": "BAD"}[verdict], what, message)
    print_table(table)
    return int(any(finding.verdict == "bad" for finding in findings))


def list_envs(arguments: list[str]) -> None:
    """List environments."""
    tyro.cli(lambda: None, args=arguments, prog="mabl envs", description=list_envs.__doc__)
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
    tyro.cli(lambda: None, args=arguments, prog="mabl algos", description=list_algos.__doc__)
    from mabl.algorithms.registry import ALGORITHMS, COLUMNS

    table = Table(box=None, padding=(0, 1))
    for heading in ("name", *(column.heading for column in COLUMNS), "description"):
        table.add_column(heading, no_wrap=heading == "name")
    for name, entry in ALGORITHMS.items():
        marks = ("yes" if getattr(entry, column.field) else "no" for column in COLUMNS)
        table.add_row(name, *marks, entry.description)
    print_table(table)


def shallow(config: Any) -> dict[str, Any]:
    """A dataclass's fields, one level deep."""
    return {f.name: getattr(config, f.name) for f in fields(config)}


def print_table(table: Table) -> None:
    """As wide as the terminal, or wide enough for a file."""
    Console(width=None if sys.stdout.isatty() else PIPED_WIDTH).print(table)


def print_help() -> None:
    """What commands there are."""
    console = Console()
    console.print("mabl: sample-efficient multi-agent RL with world models\n")
    table = Table(box=None, show_header=False)
    for name, command in COMMANDS.items():
        table.add_row(f"mabl {name}", (command.__doc__ or "").splitlines()[0])
    console.print(table)
    console.print("\nmabl COMMAND --help shows a command's options.")


def use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache folder, unless JAX was told of another place."""
    import jax

    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(cache / "mabl" / "jax"))


COMMANDS = {
    "train": train,
    "resume": resume,
    "eval": evaluate,
    "envs": list_envs,
    "check-env": check_env,
    "algos": list_algos,
}
