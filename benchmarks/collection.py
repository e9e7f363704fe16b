"""What collecting costs beside a compiled simulator: joint steps per second, in turns in a process.

    uv run python -m benchmarks.collection --env smax/3m

`bare` is jaxmarl's own environment with its own resets and random available actions; `random` the
same actions through our rows and resets; `policy` what training does: a world model's filter and an
actor besides. Medians over rounds, one JSON object.
"""

import argparse
import json
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxmarl import make as make_jaxmarl

from mabl.algorithms.presets import preset
from mabl.bench import clock
from mabl.envs import registry
from mabl.envs.smax import SCENARIOS
from mabl.envs.workers import n_cores
from mabl.execution import RandomExecutor
from mabl.rollout import rollout, start
from mabl.training.programs import as_in_a_run, build

STEPS = 256


def bare(name: str, n_envs: int) -> tuple[Any, Any]:
    """The simulator alone: a compiled function of states and key, and first states."""
    game = make_jaxmarl("HeuristicEnemySMAX", scenario=SCENARIOS[name].scenario)

    def step(carry: tuple[Any, Any], key: jax.Array) -> tuple[tuple[Any, Any], Any]:
        state, _ = carry
        key_act, key_step = jax.random.split(key)
        keys = jax.random.split(key_act, game.num_agents)
        available = game.get_avail_actions(state)
        action = {
            agent: jax.random.categorical(k, jnp.where(available[agent], 0.0, -jnp.inf))
            for agent, k in zip(game.agents, keys, strict=True)
        }
        obs, state, reward, _, _ = game.step(key_step, state, action)
        return (state, obs), reward

    def steps(carry: Any, key: jax.Array) -> Any:
        return jax.lax.scan(step, carry, jax.random.split(key, STEPS))[0]

    obs, states = jax.vmap(game.reset)(jax.random.split(jax.random.key(0), n_envs))
    run = jax.jit(lambda c, key: jax.vmap(steps)(c, jax.random.split(key, n_envs)))
    return run, (states, obs)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--env", default="smax/3m")
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=7)
    args = parser.parse_args()
    key, n_envs = jax.random.key(1), args.num_envs
    env = registry.make(args.env)
    config = preset("quick", args.env, "mabl")
    training = build(config)
    learner = jax.jit(training.algorithm.init)(key)

    def ours(executor_of: Any) -> tuple[Any, Any]:
        def run(learner: Any, collectors: Any, key: jax.Array) -> Any:
            one = partial(rollout, env, executor_of(learner), n_rows=STEPS)
            return jax.vmap(lambda c, k: one(c, k))(collectors, jax.random.split(key, n_envs))

        begin = partial(start, env, executor_of(learner))
        collectors = jax.jit(jax.vmap(begin))(jax.random.split(key, n_envs))
        compiled = jax.jit(as_in_a_run(run, config))
        return lambda c, key: compiled(learner, c, key), collectors

    with jax.numpy_rank_promotion("allow"):
        contenders = {
            "bare": bare(args.env.split("/")[1], n_envs),
            "random": ours(lambda _: RandomExecutor(env.spec.action_space)),
            "policy": ours(training.executor),
        }
        for function, states in contenders.values():
            clock(partial(function, states, key))
        seconds = {name: [] for name in contenders}
        for _ in range(args.rounds):
            for name, (function, states) in contenders.items():
                seconds[name].append(clock(partial(function, states, key)))
    rates = {name: round(n_envs * STEPS / float(np.median(s))) for name, s in seconds.items()}
    share = {
        name: round(float(np.median(np.divide(seconds["bare"], seconds[name]))), 2)
        for name in ("random", "policy")
    }
    about = {"env": args.env, "envs": n_envs, "cores": n_cores(), "precision": config.precision}
    print(json.dumps(about | {"steps per second": rates, "share of bare": share}))


if __name__ == "__main__":
    main()
