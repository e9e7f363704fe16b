"""A training run from start to finish: folders, progress, metrics, checkpoints, interruption."""

import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
from rich.console import Console

from mabl.algorithms.base import Algorithm
from mabl.algorithms.config import Config
from mabl.algorithms.diagnostics import DIAGNOSED_ROWS
from mabl.devices import SEEDS
from mabl.envs.base import EnvSpec
from mabl.errors import UserError
from mabl.runs import folder
from mabl.runs.checkpoint import Checkpoints, restore, shared_steps, tree_bytes
from mabl.runs.lock import writing
from mabl.runs.metrics import MetricsLog, Row, read
from mabl.training import curves
from mabl.training.faults import check_finite, disks_explained
from mabl.training.interruption import Interruption
from mabl.training.loop import Training, TrainState
from mabl.training.memory import check_memory, free_memory
from mabl.training.programs import grid_of, programs
from mabl.training.progress import Progress, duration
from mabl.training.watching import Watch

CURVES_EVERY = 30.0
"""Seconds between refreshes of curves.png."""

PLACEMENT = ("logdir", "num_devices", "workers", "num_workers", "worker_timeout")
"""Fields that say where a run is computed, and nothing of what."""

SUMS = ("episodes/", "rows/")
"""What a cycle tells of itself, and no row of metrics repeats."""


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    folders: list[Path]
    told: signal.Signals | None
    """What asked it to end, if anything did."""
    finished: bool
    """Whether it did all its steps all the same."""

    @property
    def stopped_by(self) -> signal.Signals | None:
        """What ended it early, if anything did."""
        return None if self.finished else self.told


def train(config: Config, console: Console | None = None) -> Outcome:
    """Train from scratch, one run folder for each seed. Raises UserError for a user's mistake."""
    console = console or Console(stderr=True)
    seeds = range(config.seed, config.seed + config.num_seeds)
    check_memory_of(config, console)
    folders = [folder.create(config, seed) for seed in seeds]
    for path in folders:
        console.print(f"run folder {path}", highlight=False, soft_wrap=True)
    keys = jnp.stack([jax.random.key(seed) for seed in seeds])
    with writing(folders):
        return _run(config, programs(config).init(keys), folders, console)


def resume(
    run: Path | str | Sequence[Path | str],
    total_steps: int | None = None,
    num_devices: int | None = None,
    trust: bool = False,
    console: Console | None = None,
) -> Outcome:
    """Continue one run from its newest whole checkpoint, as configured or as told.

    Several that were trained in one program go on in one, from the newest that all of them have.
    Where there is none yet, they begin. With `trust`, a run may name code of this machine as its
    environment, whoever wrote it. Raises UserError for a user's mistake.
    """
    console = console or Console(stderr=True)
    folders = [Path(run)] if isinstance(run, str | Path) else [Path(one) for one in run]
    told = {"total_steps": total_steps, "num_devices": num_devices}
    told = {name: new for name, new in told.items() if new is not None}
    configs = [replace(folder.read_config(path, trust), **told) for path in folders]
    check_alike(folders, configs)
    config = replace(configs[0], num_seeds=len(folders))
    shape = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), check_memory_of(config, console)
    )
    with writing(folders):
        checkpoints = [checkpoints_of(path, config) for path in folders]
        if shared_steps(checkpoints):
            step, restored = restore(checkpoints, "state", shape)
            states = jax.tree.map(lambda *x: jnp.stack(x), *restored)
        elif any(kept.steps for kept in checkpoints) and len(folders) > 1:
            raise UserError(
                "these runs have no checkpoint of the same step in common: resume them one by one"
            )
        else:
            step, keys = -1, jnp.stack([jax.random.key(config.seed) for config in configs])
            states = programs(config).init(keys)
        if step >= config.total_steps:
            raise UserError(
                f"{folders[0]} has already done {step} of {config.total_steps} steps: "
                "give a larger --total-steps"
            )
        for path, own, kept in zip(folders, configs, checkpoints, strict=True):
            kept.forget_after(step)
            folder.write_config(path, own)
        return _run(config, states, folders, console, resumed=True)


def check_alike(folders: Sequence[Path], configs: Sequence[Config]) -> None:
    """Raise UserError unless runs differ alone in their seeds, and where they are computed."""
    for path, config in zip(folders[1:], configs[1:], strict=True):
        same = {name: getattr(configs[0], name) for name in ("seed", *PLACEMENT)}
        if replace(config, **same) != configs[0]:
            raise UserError(f"{path} has another config than {folders[0]}: resume it on its own")
    if len({config.seed for config in configs}) < len(configs):
        raise UserError("two of the runs have the same seed: resume them one by one")


def checkpoints_of(path: Path, config: Config) -> Checkpoints:
    """Those of a run folder, to be written."""
    return Checkpoints.to_write(path / "checkpoints", config.training.keep_checkpoints)


def check_memory_of(config: Config, console: Console) -> TrainState:
    """Say how much memory a run takes; shapes of its states, with a leading axis of seeds.

    Raises UserError if the replay does not fit.
    """
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), config.num_seeds))
    shape = programs(config).init.eval_shape(keys)
    replay, learner = tree_bytes(shape.replay), tree_bytes(shape.learner)
    console.print(
        f"{config.algo} on {config.env}: replay {replay / 2**20:,.0f} MiB, parameters and "
        f"optimisers {learner / 2**20:,.0f} MiB",
        highlight=False,
    )
    # Each device holds the replay of its seeds; virtual ones of a CPU share its memory.
    devices = config.num_devices if jax.default_backend() == "cpu" else 1
    check_memory(devices * replay // grid_of(config).shape[SEEDS], free_memory())
    return shape


def _run(
    config: Config,
    states: TrainState,
    folders: list[Path],
    console: Console,
    resumed: bool = False,
) -> Outcome:
    """Cycle until every seed is done. `states` has a leading axis of seeds."""
    run = programs(config)
    training, total_steps = run.training, config.total_steps
    states = run.place(states)
    checkpoints = [checkpoints_of(path, config) for path in folders]
    step = int(states.env_steps.min())
    own_steps = jax.device_get(states.env_steps).tolist()
    logs = [
        MetricsLog(path, resume_at=own if resumed else None)
        for path, own in zip(folders, own_steps, strict=True)
    ]
    warned, watch = False, Watch(total_steps)
    saved, drawn, began = step, time.monotonic(), time.monotonic()
    console.print("compiling (cached for the next run) ...", highlight=False)
    with (
        disks_explained(checkpoints),
        run.open_cycle(config) as cycle,
        Interruption(console, "stopping after this cycle") as interruption,
        Progress(console, total_steps, training.env.spec.score_name) as progress,
    ):
        while step < total_steps and not interruption.received:
            before, cycle_began = step, time.monotonic()
            n_model, n_policy = updates_due(states, training)
            if n_model and int(states.model_updates[0]) < config.training.pretrain_updates:
                console.print(f"pretraining the model: {n_model} updates ...", highlight=False)
            states, metrics = cycle(states, n_model, n_policy, total_steps)
            step = int(states.env_steps.min())
            if longest_lane(states) >= DIAGNOSED_ROWS and crossed(
                before, step, config.training.diagnose_every
            ):
                metrics |= run.diagnose(states)
            metrics = jax.device_get(metrics)
            check_finite(states, metrics, training, checkpoints)
            if metrics["train/skipped_updates"].any() and not warned:
                warned = True
                console.print(f"a gradient was not finite by step {step:,}, and was left out")
            seconds = time.monotonic() - cycle_began
            for k, log in enumerate(logs):
                row = describe(
                    {name: float(v[k]) for name, v in metrics.items()}, training.env.spec
                )
                row |= learned_per_step(training.algorithm, n_model, n_policy, step - before)
                row["time/seconds"] = seconds
                row["time/steps_per_second"] = (step - before) / seconds
                log.write(int(states.env_steps[k]), row)
                if k == 0:
                    progress.update({"step": step, **row})
                    for warning in watch.warnings(step, row):
                        console.print(warning, highlight=False, soft_wrap=True)
            if crossed(saved, step, config.training.checkpoint_every):
                saved = step
                save(training, states, checkpoints, logs)
            if time.monotonic() - drawn > CURVES_EVERY:
                drawn = time.monotonic()
                draw_curves(folders, config)
        save(training, states, checkpoints, logs)
        draw_curves(folders, config)
        for log in logs:
            log.close()
    finished = step >= total_steps
    console.print(
        f"{'finished' if finished else 'interrupted'} at {step:,} steps after "
        f"{duration(time.monotonic() - began)}",
        highlight=False,
    )
    for path in folders:
        hint = f"mabl eval {path}" if finished else f"mabl resume {path}"
        console.print(f"next: {hint}", highlight=False, soft_wrap=True)
    return Outcome(folders, interruption.received, finished)


def learned_per_step(algorithm: Algorithm, n_model: int, n_policy: int, steps: int) -> Row:
    """Metrics of how much a cycle of `steps` environment steps learns from."""
    return {
        "train/imagined_steps": n_policy * algorithm.imagined_steps,
        "train/replayed_rows_per_env_step": n_model * algorithm.model_rows / steps,
        "train/policy_gradient_steps_per_env_step": (
            n_policy * algorithm.policy_gradient_steps / steps
        ),
    }


def updates_due(states: TrainState, training: Training) -> tuple[int, int]:
    """Model and policy updates of the next cycle: none in prefill, pretraining, then M and R."""
    plan = training.algorithm.config.training
    prefilled = int(states.env_steps.min()) >= plan.prefill_steps
    known = longest_lane(states) + (plan.collect_steps or 0)
    if not prefilled or known < training.algorithm.rows_needed:
        return 0, 0
    if int(states.model_updates[0]) < plan.pretrain_updates:
        return plan.pretrain_updates, 0
    return plan.model_updates, plan.policy_updates


def longest_lane(states: TrainState) -> int:
    """Rows in the longest lane of the replay of the seed that has the shortest such."""
    return int(states.replay.size.max(-1).min())


def crossed(before: int, now: int, every: int) -> bool:
    """True if a multiple of `every` lies in (before, now]."""
    return now // every > before // every


def describe(metrics: Row, spec: EnvSpec) -> Row:
    """Sums over a cycle's episodes as means under the field's names."""
    row = {name: value for name, value in metrics.items() if not name.startswith(SUMS)}
    episodes = metrics["episodes/count"]
    row["train/episodes"] = episodes
    if episodes:
        row["train/episode_return"] = metrics["episodes/return"] / episodes
        row["train/episode_length"] = metrics["episodes/length"] / episodes
        row[f"train/{spec.score_name}"] = metrics["episodes/score"] / episodes
    return row


def save(
    training: Training,
    states: TrainState,
    checkpoints: list[Checkpoints],
    logs: Sequence[MetricsLog] = (),
) -> None:
    """Checkpoint every seed in its own folder, its metrics being on the disk.

    Checkpoints are named by the steps that all seeds have done, so that all can go on from one.
    """
    for log in logs:
        log.flush_to_disk()
    step = int(states.env_steps.min())
    for k, manager in enumerate(checkpoints):
        state = jax.tree.map(lambda x, k=k: x[k], states)
        policy = training.algorithm.policy(state.learner)
        manager.save(step, policy, state)


def draw_curves(folders: list[Path], config: Config) -> None:
    """Refresh curves.png of every seed."""
    for path in folders:
        curves.draw(read(path), f"{config.name} on {config.env}", path / "curves.png")
