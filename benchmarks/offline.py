"""What is the limit: the model, the policy or the data? Learning from a finished run's rows alone.

    uv run python -m benchmarks.offline RUN --set world_model.overshooting=0 --model-updates 1000
    uv run python -m benchmarks.offline RUN --model-updates 0 --policy-updates 100

Trains a world model from scratch on the rows of most environments in the run's replay and tells how
well it predicts the others' (`held_out`) and its own (`trained`); with `--model-updates 0` it keeps
the run's own model. Then trains a policy from scratch in its imagination and plays it. One JSON
object a line. RUN is one of a world model and a behaviour in its imagination: not of MAG or MAPPO.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import jax
import yaml

from mabl.algorithms.base import Experience
from mabl.algorithms.config import Config, from_dict
from mabl.algorithms.model_based import Learner, ModelBased
from mabl.devices import use_compilation_cache
from mabl.evaluation import evaluate, summary
from mabl.execution import executor_of
from mabl.replay import Replay
from mabl.runs import folder
from mabl.runs.checkpoint import Checkpoints
from mabl.training.programs import as_in_a_run, build
from mabl.types import PRNGKey

CHUNK = 50
"""Updates in one compiled call."""
HELD_OUT = 3
"""Environments whose rows are for testing."""


def overridden(config: Config, settings: list[str]) -> Config:
    """The config with fields such as `world_model.hidden=256` replaced."""
    data = asdict(config)
    for setting in settings:
        path, value = setting.split("=", 1)
        *groups, name = path.split(".")
        inner = data
        for group in groups:
            inner = inner.setdefault(group, {})
        inner[name] = yaml.safe_load(value)
    return from_dict(Config, data)


def environments(replay: Replay, which: slice) -> Replay:
    """The lanes of some environments."""
    return jax.tree.map(lambda x: x[which], replay)


def replayed(replay: Replay) -> Experience:
    """All that a model-based algorithm learns from: no newest rows."""
    return Experience(replay, before=None, newest=None)  # pyright: ignore[reportArgumentType]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE")
    parser.add_argument("--model-updates", type=int, default=1000, help="in fifties")
    parser.add_argument("--policy-updates", type=int, default=0, help="in fifties")
    parser.add_argument("--every", type=int, default=250, help="model updates between reports")
    parser.add_argument("--episodes", type=int, default=256)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    if args.model_updates % CHUNK or args.policy_updates % CHUNK:
        parser.error(f"give updates in multiples of {CHUNK}")
    use_compilation_cache()

    config = folder.read_config(args.run)
    training = build(config)
    if not isinstance(training.algorithm, ModelBased):
        parser.error(f"{config.algo} is not just a world model and a behaviour in its imagination")
    shape = jax.eval_shape(training.init, jax.random.key(0))
    _, state = Checkpoints(args.run / "checkpoints").restore("state", shape)
    trained = environments(state.replay, slice(HELD_OUT, None))
    held_out = environments(state.replay, slice(HELD_OUT))

    training = build(overridden(config, args.set))
    algorithm, action_space = training.algorithm, training.env.spec.action_space
    key_init, key_model, key_policy, key_play = jax.random.split(jax.random.key(args.seed), 4)
    learner = algorithm.init(key_init)
    if args.model_updates == 0:
        learner = learner._replace(model=state.learner.model)

    def fit(update: Callable) -> Callable:
        def chunk(learner: Learner, rows: Replay, key: PRNGKey) -> Learner:
            keys = jax.random.split(key, CHUNK)
            experience = replayed(rows)
            return jax.lax.scan(lambda carry, key: update(carry, experience, key), learner, keys)[0]

        return jax.jit(as_in_a_run(chunk, algorithm.config))

    fit_model, fit_policy = fit(algorithm.update_model), fit(algorithm.update_policy)
    diagnose = jax.jit(as_in_a_run(algorithm.diagnose, algorithm.config))

    def report(n: int) -> None:
        for name, replay in (("trained", trained), ("held_out", held_out)):
            numbers = jax.device_get(diagnose(learner, replay, jax.random.key(0)))
            row = {k.split("/")[1]: round(float(v), 3) for k, v in numbers.items()}
            print(json.dumps({"model_updates": n, "rows": name, **row}), flush=True)

    for n in range(CHUNK, args.model_updates + 1, CHUNK):
        learner = fit_model(learner, trained, jax.random.fold_in(key_model, n))
        if n % args.every == 0:
            report(n)
    if args.model_updates % args.every or args.model_updates == 0:
        report(args.model_updates)
    for n in range(CHUNK, args.policy_updates + 1, CHUNK):
        learner = fit_policy(learner, trained, jax.random.fold_in(key_policy, n))
        executor = executor_of(algorithm.policy(learner), action_space, greedy=True)
        results = evaluate(training.env, executor, key_play, args.episodes)
        played = {k: round(v, 3) for k, v in summary(results, training.env.spec).items()}
        print(json.dumps({"policy_updates": n, "greedy": True, **played}), flush=True)


if __name__ == "__main__":
    main()
