"""Commands that play episodes: eval, play, check-env."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro
from rich.console import Console
from rich.table import Table

from mabl.cli.shared import print_table, progress_bar
from mabl.errors import UserError
from mabl.parsing import parse

T = TypeVar("T")


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

    from mabl.devices import use_compilation_cache
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
    from mabl.devices import use_compilation_cache
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
