"""The command line: train, resume, eval, play, envs, check-env, bench, algos."""

import json
import os
import signal
import sys
import warnings
from argparse import ArgumentError, ArgumentParser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from mabl.errors import UNWRITABLE, UserError, unknown_name
from mabl.parsing import parse

if TYPE_CHECKING:
    from mabl.algorithms.config import Config

T = TypeVar("T")

PIPED_WIDTH = 160
"""Columns of a table that goes to a file or another program."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells expect."""

PREEMPTED = 75
"""Exit code after SIGTERM, all being saved: `EX_TEMPFAIL`, go on with `mabl resume`."""

EXIT_CODES = {None: 0, signal.SIGINT: INTERRUPTED, signal.SIGTERM: PREEMPTED}
"""Of a run, by what ended it early."""


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


def train(arguments: list[str]) -> int:
    """Train an algorithm in an environment."""
    default, rest = chosen_preset(arguments)
    config = parse_config(rest, default)
    from mabl.training.run import train as train_run

    use_compilation_cache()
    return EXIT_CODES[train_run(config).stopped_by]


def chosen_preset(arguments: list[str]) -> tuple["Config", list[str]]:
    """The preset of an environment and an algorithm, and the flags that are left."""
    from mabl.algorithms.presets import preset

    base = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for flag, default in (("--env", "smax/3m"), ("--algo", "mabl"), ("--preset", "quick")):
        base.add_argument(flag, default=default)
    try:
        chosen, rest = base.parse_known_args(arguments)
    except ArgumentError as error:
        raise UserError(f"{error}: mabl train --help lists them") from error
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
    from mabl.training.run import resume as resume_run

    use_compilation_cache()
    outcome = resume_run(given.runs, given.total_steps, given.num_devices, given.trust)
    return EXIT_CODES[outcome.stopped_by]


@dataclass(frozen=True)
class PlayerArguments:
    """Who plays, and where."""

    run: tyro.conf.Positional[Path | None] = None
    """Run folder of a trained policy."""
    policy: Literal["random", "heuristic"] | None = None
    """Play a baseline instead of a run; needs --env."""
    env: str | None = None
    """Environment; default: the run's own."""
    env_kwargs: tuple[str, ...] = ()
    """Arguments that it is made with: KEY=VALUE, values in YAML."""
    greedy: Annotated[bool, tyro.conf.arg(help_behavior_hint="")] = True
    """Take the likeliest action; --no-greedy or --sample draws it from the policy."""
    seed: int = 0
    """Decides the episodes."""
    trust: bool = False
    """Let a run that somebody else wrote name its environment's code."""


@dataclass(frozen=True)
class EvalArguments(PlayerArguments):
    """Play episodes with a trained policy, or with a baseline, and print what came of it."""

    episodes: int = 32
    """Episodes to play."""
    num_workers: int | None = None
    """Processes for environments that run in Python; 0: this one; None: one a core."""
    json: bool = False
    """Print one JSON object."""


@dataclass(frozen=True)
class PlayArguments(PlayerArguments):
    """Film episodes of a trained policy, or of a baseline."""

    video: Path | None = None
    """Where to: a .mp4 or .gif; default: the run's own folder."""
    episodes: int = 1
    """Episodes to film."""


def parse_player(arguments: type[T], given: list[str], prog: str) -> T:
    """Arguments of those that play episodes. Raises UserError for what cannot be meant."""
    given = ["--no-greedy" if a == "--sample" else a for a in given]
    parsed: Any = parse(arguments, given, prog)
    if (parsed.run is None) == (parsed.policy is None):
        raise UserError("give either a run folder or --policy random|heuristic with --env")
    if parsed.policy is not None and parsed.env is None:
        raise UserError(f"--policy {parsed.policy} needs --env: mabl envs lists them")
    if parsed.episodes < 1:
        raise UserError(f"--episodes is {parsed.episodes}: give a number above 0")
    if not 0 <= parsed.seed < 2**32:
        raise UserError(f"--seed is {parsed.seed}: give a number from 0 to {2**32 - 1}")
    return parsed


def player(given: PlayerArguments) -> tuple[Any, Any, dict[str, Any]]:
    """Environment, executor, and what to say of them."""
    if given.run is not None:
        from mabl.policy import load_run

        loaded = load_run(given.run, given.env, given.env_kwargs, given.greedy, given.trust)
        subject = {"run": str(given.run), "step": loaded.step, "greedy": given.greedy}
        return loaded.env, loaded.executor, subject
    from mabl.envs import registry
    from mabl.evaluation import baseline

    env = registry.make(given.env or "", given.env_kwargs)
    return env, baseline(given.policy or "", env), {"policy": given.policy}


def evaluate(arguments: list[str]) -> int:
    """Play episodes with a trained policy or a baseline."""
    given = parse_player(EvalArguments, arguments, "mabl eval")
    import jax

    from mabl.evaluation import evaluate as run_episodes
    from mabl.evaluation import summary

    use_compilation_cache()
    env, executor, subject = player(given)
    key = jax.random.key(given.seed)
    with progress_bar("playing", given.episodes) as say:
        results = run_episodes(env, executor, key, given.episodes, given.num_workers, say=say)
    numbers = {"env": env.spec.name, **subject, **summary(results, env.spec)}
    if given.json:
        print(json.dumps(numbers))
    else:
        table = Table(show_header=False, box=None)
        for key, value in numbers.items():
            table.add_row(key, f"{value:.3f}" if isinstance(value, float) else str(value))
        print_table(table)
    return 0


def play(arguments: list[str]) -> int:
    """Film episodes of a trained policy or a baseline."""
    given = parse_player(PlayArguments, arguments, "mabl play")
    if given.run is None and given.video is None:
        raise UserError("a baseline has no run folder: give --video out.gif")
    import jax

    from mabl import videos
    from mabl.playing import Outcome, film, show_of

    if given.video is not None:
        videos.writer_for(given.video)
    use_compilation_cache()
    env, executor, subject = player(given)
    ending = "mp4" if videos.can_write_mp4() else "gif"
    path = given.video or Path(str(given.run)) / "videos" / f"step_{subject['step']}.{ending}"
    console = Console(stderr=True)

    def say(outcome: Outcome) -> None:
        console.print(
            f"{env.spec.score_name} {outcome.score:.2f}, return {outcome.episode_return:.2f}, "
            f"{outcome.length} steps",
            highlight=False,
        )

    with show_of(env) as show, console.status("playing ..."):
        frames = film(show, executor, jax.random.key(given.seed), given.episodes, say)
        videos.write(path, frames, show.frames_per_second)
    print(path)
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
    given = parse(CheckArguments, arguments, "mabl check-env")
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

    baseline = benchmark.read(given.against) if given.against else None
    console = Console(stderr=True)
    with console.status("starting") as status:
        report = benchmark.measure(config, given.repeats, given.parts, status.update)
    print_table(benchmark.table(report, baseline))
    if given.json:
        report.write(given.json)
    return 0


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
    "play": play,
    "envs": list_envs,
    "check-env": check_env,
    "bench": bench,
    "algos": list_algos,
}
