"""How much an adapter costs: steps per second of environments bare, adapted, and in a worker.

    uv run python -m benchmarks.adapters

Each kind takes its turn for a second or so, again and again; ratios to the bare environment are of
turns of one round, and their medians are printed, with the least and the greatest. Actions are
drawn beforehand, resets are seeded and counted. `adapted` is rows in this process; `worker` is rows
in shared memory, from one worker process that holds four environments. Flatland's bare environment
observes nothing; beside it stands the bundled tree of depth 2.
"""

import argparse
import json
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from mabl.envs import registry
from mabl.envs.base import Discrete
from mabl.envs.host import Hosted
from mabl.envs.pool import RESET, STEP
from mabl.envs.workers import open_pool
from mabl.rows import is_last

Steps = Callable[[int], None]
"""Takes so many joint steps."""


class Case(NamedTuple):
    """An environment by name, and what makes its bare ones."""

    env: str
    bare: dict[str, Callable[[Hosted], Steps]]


def actions_of(hosted: Hosted, n: int) -> np.ndarray:
    """Random joint actions `[n, N, ...]` that every agent has."""
    space, spec = hosted.spec.action_space, hosted.spec
    rng, shape = np.random.default_rng(0), (n, spec.n_agents)
    if isinstance(space, Discrete):
        return rng.integers(0, min(spec.action_dims or (space.n,)), shape).astype(np.int32)
    return rng.uniform(-1, 1, (*shape, space.size)).astype(np.float32)


def parallel(make: Callable[[], Any], scale: float, hosted: Hosted) -> Steps:
    """A bare Parallel environment; `scale` is the bound of continuous actions."""
    env, dims = make(), hosted.spec.action_dims
    names = env.possible_agents
    discrete = isinstance(hosted.spec.action_space, Discrete)
    drawn = [
        {name: int(a[i]) if discrete else scale * a[i, : dims[i]] for i, name in enumerate(names)}
        for a in actions_of(hosted, 1_000)
    ]

    def steps(n: int) -> None:
        env.reset(seed=0)
        for k in range(n):
            env.step(drawn[k % 1_000])
            if not env.agents:
                env.reset(seed=k)

    return steps


def flatland(tree: bool, hosted: Hosted) -> Steps:
    """A bare RailEnv."""
    from flatland.core.env_observation_builder import DummyObservationBuilder
    from flatland.envs.observations import TreeObsForRailEnv
    from flatland.envs.predictions import ShortestPathPredictorForRailEnv

    host: Any = hosted.make()
    env = host._env
    env.obs_builder = (
        TreeObsForRailEnv(2, ShortestPathPredictorForRailEnv(30))
        if tree
        else DummyObservationBuilder()
    )
    env.obs_builder.set_env(env)
    # 0 goes nowhere: here, and in our three actions, trains mostly go forward.
    drawn = [dict(enumerate(map(int, 2 - a % 2))) for a in actions_of(hosted, 1_000)]

    def steps(n: int) -> None:
        env.reset(random_seed=1)
        for k in range(n):
            _, _, done, _ = env.step(drawn[k % 1_000])
            if done["__all__"]:
                env.reset(random_seed=k + 1)

    return steps


def adapted(hosted: Hosted) -> Steps:
    """Rows in this process."""
    env, drawn = hosted.make(), actions_of(hosted, 1_000)

    def steps(n: int) -> None:
        env.reset(0)
        for k in range(n):
            row = env.step(drawn[k % 1_000])
            if row.truncated or row.terminated.all():
                env.reset(k)

    return steps


def in_worker(hosted: Hosted, n_envs: int) -> Steps:
    """Rows of a worker process with several environments."""
    pool = open_pool(hosted, n_envs, 1)
    drawn = actions_of(hosted, 1_000)

    def tell(command: Any) -> None:
        pool.slots.command[:] = command
        pool.send()
        assert not pool.receive()

    def steps(n: int) -> None:
        tell(RESET)
        for k in range(n // n_envs):
            over = is_last(pool.slots.rows)
            pool.slots.seed[:] = k
            pool.slots.action[:] = drawn[k % 1_000]
            tell(np.where(over, RESET, STEP))

    return steps


def cases() -> list[Case]:
    """What is measured."""
    import mpe2.simple_speaker_listener_v4 as listener
    import mpe2.simple_spread_v3 as spread
    from gymnasium_robotics import mamujoco_v1

    humanoid = partial(mamujoco_v1.parallel_env, "Humanoid", "9|8", agent_obsk=0)
    return [
        Case(
            "pettingzoo:mpe2.simple_spread_v3:parallel_env",
            {"bare": partial(parallel, spread.parallel_env, 1.0)},
        ),
        Case(
            "pettingzoo:mpe2.simple_speaker_listener_v4:parallel_env",
            {"bare": partial(parallel, listener.parallel_env, 1.0)},
        ),
        Case("mamujoco/Humanoid", {"bare": partial(parallel, humanoid, 0.4)}),
        Case(
            "flatland/5_agents",
            {"bare": partial(flatland, False), "bundled tree": partial(flatland, True)},
        ),
    ]


def rate(steps: Steps, n: int) -> float:
    """Steps per second."""
    began = time.perf_counter()
    steps(n)
    return n / (time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--steps", type=int, default=2_000)
    parser.add_argument("--envs", type=int, default=8, help="of the worker")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    for case in cases():
        hosted = registry.make(case.env)
        assert isinstance(hosted, Hosted)
        kinds = {name: make(hosted) for name, make in case.bare.items()}
        kinds |= {"adapted": adapted(hosted), "worker": in_worker(hosted, args.envs)}
        for steps in kinds.values():
            steps(args.envs)
        rounds = [
            {name: rate(steps, args.steps) for name, steps in kinds.items()}
            for _ in range(args.rounds)
        ]
        for name in kinds:
            ratios = [each[name] / each["bare"] for each in rounds]
            figures = {
                "steps_per_second": round(float(np.median([each[name] for each in rounds]))),
                "to_bare": round(float(np.median(ratios)), 3),
                "least": round(min(ratios), 3),
                "greatest": round(max(ratios), 3),
            }
            print(json.dumps({"env": case.env, "kind": name, **figures}), flush=True)


if __name__ == "__main__":
    main()
