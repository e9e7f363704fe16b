"""Commands of many runs: suites and their jobs, reports, searches, and a page to watch them."""

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from mabl.cli.runs import chosen_preset, parse_with_config
from mabl.cli.shared import EXIT_CODES, print_table
from mabl.errors import UserError
from mabl.parsing import parse


@dataclass(frozen=True)
class Part:
    """What of a suite is asked for."""

    suite: tyro.conf.Positional[str]
    """A name of `mabl suite list`, or a file of your own: suite.yaml."""
    logdir: Path = Path("runs")
    """Run folders go to LOGDIR/SUITE."""
    num_seeds: int | None = None
    """Seeds of each algorithm on each task; default: the suite's."""
    total_steps: int | None = None
    """Environment steps of every run; default: the suite's."""
    tasks: tuple[str, ...] = ()
    """Only these environments of the suite."""
    algorithms: tuple[str, ...] = ()
    """Only these algorithms of the suite, by name or label."""


@dataclass(frozen=True)
class JobsArguments:
    """Write the jobs of a suite that are left to do, for other schedulers: paths, one in a line."""

    part: tyro.conf.OmitArgPrefixes[Part]


@dataclass(frozen=True)
class SuiteArguments:
    """Run a suite: its algorithms on its tasks, with all its seeds. What is done is kept."""

    part: tyro.conf.OmitArgPrefixes[Part]
    backend: Literal["local", "ray"] = "local"
    """Where jobs run: on this machine's cores, or on a Ray cluster."""
    address: str | None = None
    """The Ray cluster: HOST:PORT, or auto; default: RAY_ADDRESS, or this machine."""
    cpus: float | None = None
    """Cores of one job; default: the suite's."""
    gpus: float | None = None
    """GPUs of one job, with Ray; a fraction lets jobs share one; default: the suite's."""
    parallel: int | None = None
    """Jobs at once on this machine; default: as many as it has cores for."""
    retry: bool = False
    """Try again what failed before."""


SUITE_VERBS = """usage: mabl suite run SUITE [--help]
       mabl suite jobs SUITE [--help]
       mabl suite list"""


def suite(arguments: list[str]) -> int:
    """Compare algorithms on tasks: suite run SUITE, suite jobs SUITE, suite list."""
    match arguments:
        case ["run", *rest]:
            return run_suite(parse(SuiteArguments, rest, "mabl suite run"))
        case ["jobs", *rest]:
            return write_jobs(parse(JobsArguments, rest, "mabl suite jobs"))
        case ["list", *rest]:
            parse(lambda: None, rest, "mabl suite list", description="List suites.")
            return list_suites()
        case ["-h" | "--help", *_]:
            print(SUITE_VERBS)
            return 0
    raise UserError(
        "mabl suite needs a verb: give mabl suite run SUITE, suite jobs SUITE or suite list"
    )


def run_suite(given: SuiteArguments) -> int:
    """Run what is not done of a suite."""
    from mabl.experiments.running import run_jobs

    chosen, jobs = chosen_jobs(given.part, cpus=given.cpus, gpus=given.gpus)
    console = Console(stderr=True)
    tally = run_jobs(jobs, backend_of(given, chosen.cpus, chosen.gpus), console, given.retry)
    console.print(tally.says(), highlight=False)
    logdir = given.part.logdir / chosen.name
    console.print(f"next: mabl report {logdir}", highlight=False, soft_wrap=True)
    if tally.stopped_by:
        return EXIT_CODES[tally.stopped_by]
    return int(bool(tally.failed or tally.broken))


def write_jobs(given: JobsArguments) -> int:
    """Write the files of what is not done of a suite, and print their paths."""
    for job in chosen_jobs(given.part)[1]:
        if not job.is_done():
            print(job.write())
    return 0


def chosen_jobs(part: Part, **told: float | None) -> tuple[Any, list[Any]]:
    """A part of a suite, with fields as they are told, and its jobs.

    Raises UserError if there is none.
    """
    from mabl.experiments.jobs import jobs_of
    from mabl.experiments.suite import load, narrowed

    for name in ("num_seeds", "total_steps"):
        check_above_0(part, name)
    chosen = narrowed(load(part.suite), part.tasks, part.algorithms)
    told["seeds"] = part.num_seeds
    chosen = replace(chosen, **{name: new for name, new in told.items() if new is not None})
    return chosen, jobs_of(chosen, part.logdir / chosen.name, part.total_steps)


def backend_of(given: Any, cpus: float, gpus: float) -> Any:
    """Where jobs are to run. Raises UserError if they cannot."""
    check_above_0(given, "parallel")
    if given.backend == "ray":
        if given.parallel:
            raise UserError("--parallel is of this machine: with --backend ray give --cpus")
        from mabl.experiments.cluster import RayBackend

        return RayBackend(given.address, cpus, gpus)
    if given.address:
        raise UserError("--address is of a Ray cluster: add --backend ray")
    from mabl.experiments.processes import LocalBackend

    return LocalBackend(cpus, given.parallel)


def check_above_0(given: Any, name: str) -> None:
    """Raise UserError unless a number is None or above 0."""
    value = getattr(given, name)
    if value is not None and value <= 0:
        raise UserError(f"--{name.replace('_', '-')} is {value}: give a number above 0")


def list_suites() -> int:
    """Those that come with mabl."""
    from mabl.experiments.suite import shipped

    table = Table(box=None, padding=(0, 1))
    for heading in ("name", "tasks", "algorithms", "seeds", "preset", "description"):
        table.add_column(heading, no_wrap=heading == "name")
    for name, one in shipped().items():
        algorithms = ", ".join(contender.name for contender in one.algorithms)
        table.add_row(
            name, str(len(one.tasks)), algorithms, str(one.seeds), one.preset, one.description
        )
    print_table(table)
    return 0


@dataclass(frozen=True)
class JobArguments:
    """Do what is left of one job of a suite."""

    job: tyro.conf.Positional[Path]
    """Its file: LOGDIR/jobs/NAME.yaml."""
    attached: bool = False
    """Save and end once standard input is closed."""


def job(arguments: list[str]) -> int:
    """Run one job of a suite, as its processes do."""
    given = parse(JobArguments, arguments, "mabl job")
    from mabl.devices import use_compilation_cache
    from mabl.experiments.jobs import read_job
    from mabl.experiments.worker import preemptible, stop_with_parent, work

    with preemptible():
        if given.attached:
            stop_with_parent()
        use_compilation_cache()
        return EXIT_CODES[work(read_job(given.job), Console(stderr=True))]


@dataclass(frozen=True)
class ReportArguments:
    """Compare finished runs: a page with curves, tables and statistics, that needs no network."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders with runs in them, such as those of mabl suite run."""
    out: Path | None = None
    """Where the report goes; default: a folder `report` in the first of them."""
    title: str | None = None
    """Its title; default: the folders' names."""


def report(arguments: list[str]) -> int:
    """Compare finished runs on one page."""
    given = parse(ReportArguments, arguments, "mabl report")
    if not given.runs:
        raise UserError("mabl report needs folders with runs: give runs/quick, for one")
    from mabl.experiments.report import write_report

    console = Console(stderr=True)
    title = given.title or " and ".join(path.resolve().name for path in given.runs)
    with console.status("comparing"):
        written = write_report(
            given.runs,
            given.out or given.runs[0] / "report",
            title,
            shlex.join(["mabl", "report", *arguments]),
        )
    for gap in written.comparison.missing:
        console.print(
            f"missing: {gap.algorithm} on {gap.task}, seed {gap.seed}: {gap.reason}",
            highlight=False,
            soft_wrap=True,
            markup=False,
        )
    for one in written.comparison.unread:
        console.print(f"not read: {one}", highlight=False, soft_wrap=True, markup=False)
    if written.without_marl_eval:
        console.print(f"no marl_eval.json: {written.without_marl_eval}", highlight=False)
    print(written.page)
    return 0


def field(name: str, kind: Any, default: Any, words: str) -> tuple[str, Any, Any]:
    """A field of a command's own beside a config."""
    return name, Annotated[kind, tyro.conf.arg(help=words)], default


SWEEP = (
    field("space", tuple[str, ...], (), "What to search: FIELD=LOW..HIGH[:log], FIELD=A,B,C."),
    field("trials", int, 20, "How many settings to try; more go on from those that were tried."),
    field("name", str, "sweep", "Runs and the study go to LOGDIR/NAME."),
    field("eval_episodes", int, 32, "Greedy episodes of each trained policy."),
    field("storage", str | None, None, "A database for Optuna; default: SQLite in LOGDIR/NAME."),
    field("backend", Literal["local", "ray"], "local", "This machine's cores, or a Ray cluster."),
    field("address", str | None, None, "The Ray cluster: HOST:PORT, or auto."),
    field("cpus", float, 1.0, "Cores of one trial."),
    field("gpus", float, 0.0, "GPUs of one trial, with Ray; a fraction shares one."),
    field("parallel", int | None, None, "Trials at once on this machine."),
)
"""What `mabl sweep` reads beside a config."""


def sweep(arguments: list[str]) -> int:
    """Search for settings that win more, with Optuna."""
    default, rest = chosen_preset(arguments, "mabl sweep")
    config, given = parse_with_config(rest, default, "mabl sweep", sweep.__doc__, *SWEEP)
    for name in ("trials", "cpus", "eval_episodes"):
        check_above_0(given, name)
    from mabl.experiments.sweep import Search, flags_of, run_search

    search = Search(
        replace(config, logdir=str(Path(config.logdir) / given.name), num_seeds=1),
        space=given.space,
        trials=given.trials,
        seeds=config.num_seeds,
        eval_episodes=given.eval_episodes,
        cpus=given.cpus,
        gpus=given.gpus,
        storage=given.storage,
    )
    console = Console(stderr=True)
    study, running = run_search(search, backend_of(given, given.cpus, given.gpus), console)
    done = [trial for trial in study.get_trials() if trial.value is not None]
    done.sort(key=lambda trial: -(trial.value or 0))
    table = Table(box=None, padding=(0, 1))
    for heading in ("trial", "score", *(done[0].params if done else ())):
        table.add_column(heading)
    for trial in done[:10]:
        table.add_row(str(trial.number), f"{trial.value:.3f}", *map(shown, trial.params.values()))
    print_table(table)
    if done:
        console.print(
            f"best: mabl train {flags_of(config, done[0].params)}", highlight=False, soft_wrap=True
        )
    if running.tally.stopped_by:
        return EXIT_CODES[running.tally.stopped_by]
    return int(not done)


def shown(value: Any) -> str:
    """A setting, in few digits."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class WatchArguments:
    """Show runs while they go on, on a page of this machine, until Ctrl-C."""

    logdir: tyro.conf.Positional[Path] = Path("runs")
    """A folder with runs in it; new ones show up by themselves."""
    port: int = 8642
    """Of the page, on this machine alone."""
    show: bool = True
    """Open it in a browser."""


def watch(arguments: list[str]) -> int:
    """Show runs live on a local page."""
    given = parse(WatchArguments, arguments, "mabl watch")
    from mabl.experiments.watch import serve

    serve(given.logdir, given.port, given.show)
    return 0
