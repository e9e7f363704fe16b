"""How the cost of learning grows with agents and with seeds: seconds and memory of MABL's updates.

    uv run python -m benchmarks.scaling --out docs/results/raw/performance/scaling.jsonl
    uv run python -m benchmarks.scaling --draw docs/results/scaling.png \\
        --out docs/results/raw/performance/scaling.jsonl

Learns from random rows of an imagined environment of SMAX's sizes, since no environment has 2 and
32 agents alike. Every part is timed as `mabl bench` does it; memory is what its program needs
beside what goes in and comes out. One JSON object a line.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

from mabl.algorithms.base import Experience
from mabl.algorithms.presets import preset
from mabl.algorithms.registry import make
from mabl.bench import Part, over_seeds, timed
from mabl.envs.base import Discrete, EnvSpec
from mabl.envs.workers import n_cores
from mabl.replay import Replay
from mabl.rows import TimeStep
from mabl.training.programs import as_in_a_run

NUMBERS_OF_AGENTS, NUMBERS_OF_SEEDS = (2, 4, 8, 16, 32), (1, 2, 5, 10)
OBS, STATE, ACTIONS, ROWS = 88, 84, 9, 400


def random_replay(n_agents: int, key: jax.Array) -> Replay:
    """One full lane of rows; every 25th begins an episode."""
    keys = jax.random.split(key, 4)
    each = (1, ROWS, n_agents)
    is_first = jnp.arange(ROWS)[None] % 25 == 0
    rows = TimeStep(
        prev_action=jax.random.randint(keys[0], each, 0, ACTIONS),
        reward=jax.random.normal(keys[1], each),
        terminated=jnp.zeros(each, bool),
        truncated=jnp.roll(is_first, -1, axis=1),
        obs=jax.random.normal(keys[2], (*each, OBS)),
        state=jax.random.normal(keys[3], (1, ROWS, STATE)),
        available=jnp.ones((*each, ACTIONS), bool),
        alive=jnp.ones(each, bool),
        is_first=is_first,
        score=jnp.full((1, ROWS), jnp.nan),
    )
    return Replay(rows, cursor=jnp.zeros(1, jnp.int32), size=jnp.full(1, ROWS))


def point(name: str, precision: Any, n_agents: int, n_seeds: int, repeats: int) -> list[dict]:
    """Both updates at one size."""
    spec = EnvSpec(
        name="random",
        n_agents=n_agents,
        obs_dim=OBS,
        state_dim=STATE,
        action_space=Discrete(ACTIONS),
        episode_limit=24,
        score_name="score",
    )
    config = replace(preset(name, "smax/3s_vs_4z", "mabl"), precision=precision, num_seeds=n_seeds)
    algorithm: Any = make(config, spec)
    keys = jax.random.split(jax.random.key(0), n_seeds)
    learner = jax.jit(jax.vmap(algorithm.init))(keys)
    replay = jax.vmap(lambda key: random_replay(n_agents, key))(keys)

    def update(method: Callable[..., Any]) -> Callable[..., Any]:
        def updated(learner: Any, replay: Replay, key: jax.Array) -> Any:
            experience: Any = Experience(replay, None, None)  # type: ignore[arg-type]
            return method(learner, experience, key)

        return as_in_a_run(over_seeds(updated), config)

    found = []
    for part, method in (
        ("model update", algorithm.update_model),
        ("policy update", algorithm.update_policy),
    ):
        timing = timed(Part(update(method), (learner, replay, keys)), repeats)
        found.append(
            {
                "part": part,
                "preset": name,
                "precision": precision,
                "agents": n_agents,
                "seeds": n_seeds,
                "seconds": timing.seconds,
                "median": timing.median,
                "gflop": timing.flop / 1e9,
                "temporary": timing.temporary,
                "device": jax.devices()[0].device_kind,
                "cores": n_cores(),
            }
        )
    return found


def draw(rows: list[dict], path: Path) -> None:
    """Seconds and memory over agents and over seeds."""
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    grid = figure.subplots(2, 2, sharey="row")
    for column, over in enumerate(("agents", "seeds")):
        for part, marker in (("model update", "o"), ("policy update", "s")):
            of = [r for r in rows if r["part"] == part and r["sweep"] == over]
            size = [r[over] for r in of]
            grid[0, column].plot(size, [r["median"] for r in of], marker=marker, label=part)
            memory = [r["temporary"] / 2**20 for r in of]
            grid[1, column].plot(size, memory, marker=marker, label=part)
        ticks = sorted({r[over] for r in rows if r["sweep"] == over})
        for axes in grid[:, column]:
            axes.set(xscale="log", yscale="log", xlabel=over)
            axes.set_xticks(ticks, [str(tick) for tick in ticks])
            axes.minorticks_off()
            axes.grid(alpha=0.3)
    grid[0, 0].set_ylabel("seconds of an update")
    grid[1, 0].set_ylabel("temporary memory (MiB)")
    grid[0, 0].legend()
    first = rows[0]
    figure.suptitle(
        f"MABL, preset {first['preset']}, {first['precision']}: 3 agents over seeds, 1 seed over "
        f"agents ({first['device']}, {first['cores']} cores)"
    )
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--precision", choices=("float32", "bfloat16"), default="bfloat16")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--draw", type=Path, help="draw what is in --out, measure nothing")
    args = parser.parse_args()
    if args.draw:
        draw([json.loads(line) for line in args.out.read_text().splitlines()], args.draw)
        return
    sizes = [("agents", n, 1) for n in NUMBERS_OF_AGENTS] + [
        ("seeds", 3, n) for n in NUMBERS_OF_SEEDS
    ]
    with args.out.open("w") as file:
        for sweep, n_agents, n_seeds in sizes:
            for row in point(args.preset, args.precision, n_agents, n_seeds, args.repeats):
                print(json.dumps(row | {"sweep": sweep}), file=file, flush=True)
                print({k: row[k] for k in ("part", "agents", "seeds", "median", "temporary")})


if __name__ == "__main__":
    main()
