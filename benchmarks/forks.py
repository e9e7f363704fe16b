"""Does a world model tell a train which way is shorter, on maps that it has not seen?

    uv run python -m benchmarks.forks RUN

RUN is one of a world model on Flatland. Its posterior latents are taken where a train can choose
between two ways: in the newest rows of the run's replay, and on new maps, where trains mostly take
the shorter way and else act at random. Asked are the model's own decoder of observations, and a
small network that learns on the replay's rows to tell the shorter way: from the policy's features,
and from the observations themselves. One JSON object.
"""

import json
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mabl.behaviour.base import minibatches
from mabl.envs.flatland import Flatland
from mabl.envs.rails import EDGE_FEATURES, GAINED, ROOT_FEATURES
from mabl.nets.mlp import MLP
from mabl.rows import TimeStep
from mabl.runs import folder
from mabl.runs.checkpoint import Checkpoints
from mabl.training.programs import build
from mabl.world_models.sequences import observe_sequence

ROWS, MAPS, RANDOM = 400, 16, 0.3
"""Rows of a lane, lanes of new maps, and how often trains act at random there."""
FIRST = 10**6
"""Seed of the first new map: no run has it."""
WAYS = [ROOT_FEATURES + edge * EDGE_FEATURES + GAINED for edge in range(2)]


def second_is_shorter(obs: np.ndarray) -> np.ndarray:
    """Of `[..., 205]` observations."""
    return obs[..., WAYS[1]] > obs[..., WAYS[0]]


def share(truth: np.ndarray) -> float:
    """How often something holds."""
    return round(float(truth.mean()), 3)


def played(env: Flatland, seed: int) -> TimeStep:
    """`ROWS` rows of new maps."""
    random = np.random.default_rng(seed)
    rows = [env.reset(seed)]
    while len(rows) < ROWS:
        row = rows[-1]
        if row.terminated.all() or row.truncated:
            rows.append(env.reset(int(random.integers(FIRST, 2**31))))
            continue
        any_way = np.array([random.choice(np.flatnonzero(each)) for each in row.available])
        shorter = row.available[:, 1] & second_is_shorter(row.obs)
        action = np.where(random.random(len(shorter)) < RANDOM, any_way, shorter)
        rows.append(env.step(action.astype(np.int32)))
    return jax.tree.map(lambda *x: np.stack(x), *rows)


def taught(x: np.ndarray, y: np.ndarray) -> Any:
    """A classifier of `y` given `x`."""
    mean, std = x.mean(0), x.std(0) + 1e-3
    net = MLP(x.shape[-1], 1, 128, 1, jax.random.key(0))
    optimiser = optax.adamw(1e-3, weight_decay=1e-2)

    def loss(net: MLP, index: jax.Array) -> jax.Array:
        logit = jax.vmap(net)((x[index] - mean) / std)[:, 0]
        return optax.sigmoid_binary_cross_entropy(logit, y[index].astype(jnp.float32)).mean()

    def step(carry: tuple, index: jax.Array) -> tuple[tuple, None]:
        net, state = carry
        update, state = optimiser.update(jax.grad(loss)(net, index), state, net)
        return (optax.apply_updates(net, update), state), None

    x, y = jnp.asarray(x), jnp.asarray(y)
    batches = minibatches(jax.random.key(1), len(y), 256, 100)
    net = jax.lax.scan(step, (net, optimiser.init(net)), batches)[0][0]  # pyright: ignore
    return lambda x: np.asarray(jax.vmap(net)((x - mean) / std)[:, 0] > 0)


def main() -> None:
    run = Path(sys.argv[1])
    training = build(folder.read_config(run))
    shape = jax.eval_shape(training.init, jax.random.key(0))
    _, state = Checkpoints(run / "checkpoints").restore("state", shape)
    model, newest = state.learner.model, int(state.replay.size.min())
    env = Flatland(training.env.spec.name)
    maps = [played(env, FIRST + i) for i in range(MAPS)]
    rows = {
        "replay": jax.tree.map(
            lambda x: np.asarray(x[:, newest - ROWS : newest]), state.replay.rows
        ),
        "new maps": jax.tree.map(lambda *x: np.stack(x), *maps),
    }
    found: dict[str, dict[str, np.ndarray]] = {}
    for name, lanes in rows.items():
        keys = jax.random.split(jax.random.key(1), len(lanes.is_first))
        latents = jax.vmap(lambda rows, key: observe_sequence(model, rows, key)[0])(lanes, keys)
        at = lanes.available[..., 1] & lanes.alive
        found[name] = {
            "observation": lanes.obs[at],
            "features": np.asarray(jax.vmap(jax.vmap(model.actor_features))(latents))[at],
            "decoded": np.asarray(jax.vmap(jax.vmap(model.predict))(latents).obs)[at],
        }
    out: dict[str, Any] = {"run": str(run), "step": int(state.env_steps)}
    seen = found["replay"]
    classify = {k: taught(seen[k], second_is_shorter(seen["observation"])) for k in list(seen)[:2]}
    for name, each in found.items():
        truth = second_is_shorter(each["observation"])
        out[name] = {
            "forks": len(truth),
            "always the first": share(~truth),
            "decoder": share(second_is_shorter(each["decoded"]) == truth),
            **{f"from {k}": share(classify[k](each[k]) == truth) for k in classify},
        }
    print(json.dumps(out))


if __name__ == "__main__":
    main()
