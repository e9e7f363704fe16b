"""How much faster is mabl than the same learning written the obvious way in eager PyTorch?

    uv run --extra bench python -m benchmarks.against_torch --rounds 5 --precision bfloat16
    uv run --extra bench python -m benchmarks.against_torch --env smax/3s5z_vs_3s6z

Both learn with the paper's preset, in one process, in turns; ours in the precision that is asked
for, PyTorch in float32. Before that the world models are checked to be the same in float32: with
equal weights, rows and samples the loss and all its gradients agree.
One JSON object a line; `ratio` is the median over rounds of PyTorch's seconds over ours, of a cycle
that of its parts' medians.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch

from benchmarks.torch_reference import Learner, Sizes, WorldModel
from mabl.algorithms.base import Experience
from mabl.algorithms.presets import preset
from mabl.devices import use_compilation_cache
from mabl.nets.mlp import Linear
from mabl.replay import Replay, sample_sequences
from mabl.rows import TimeStep
from mabl.training.programs import as_in_a_run, build
from mabl.world_models.loss import model_loss
from mabl.world_models.mabl import MABL
from mabl.world_models.sequences import observe_batch

UPDATES = 3
"""Of the model in one call, as they follow each other in a cycle."""
CHECKED = 4
"""Sequences on which losses and gradients are compared."""


def paired(ours: MABL, theirs: WorldModel) -> list[tuple[str, np.ndarray, torch.nn.Parameter]]:
    """Parameters by name: ours in PyTorch's layout, and PyTorch's own."""
    pairs: list[tuple[str, np.ndarray, torch.nn.Parameter]] = []

    def linear(name: str, layer: Linear, twin: torch.nn.Linear, columns: slice = np.s_[:]) -> None:
        blocks = layer.weight if isinstance(layer.weight, tuple) else (layer.weight,)
        weight = np.concatenate([np.asarray(x).reshape(-1, x.shape[-1]) for x in blocks])
        pairs.append((f"{name}.weight", weight[:, columns].T, twin.weight))
        pairs.append((f"{name}.bias", np.asarray(layer.bias)[columns], twin.bias))

    def mlp(name: str, layers: list[Linear], twin: torch.nn.Sequential) -> None:
        twins = [each for each in twin if isinstance(each, torch.nn.Linear)]
        for i, (layer, of) in enumerate(zip(layers, twins[-len(layers) :], strict=True)):
            linear(f"{name}.{i}", layer, of)

    def recurrent(name: str, part: Any, twin: Any) -> None:
        linear(f"{name}.inputs", part.inputs, twin.inputs)
        cell, of = part.cell, twin.cell
        pairs.append((f"{name}.ih", np.asarray(cell.weight_in).T, of.weight_ih))
        pairs.append((f"{name}.hh", np.asarray(cell.weight_hidden).T, of.weight_hh))
        pairs.append((f"{name}.bias", np.asarray(cell.bias), of.bias_ih))
        bias_hh = np.concatenate([np.zeros(2 * len(cell.bias_new)), cell.bias_new])
        pairs.append((f"{name}.bias_n", bias_hh.astype(np.float32), of.bias_hh))

    nets, heads = ours.nets, ours.nets.heads
    mlp("encoder", nets.filter.encoder.layers, theirs.encoder)
    mlp("state_encoder", nets.state_encoder.layers, theirs.state_encoder)
    recurrent("recurrent", nets.filter.recurrent, theirs.recurrent)
    recurrent("global_recurrent", nets.global_recurrent, theirs.global_recurrent)
    mlp("posterior", nets.filter.posterior.mlp.layers, theirs.posterior)
    mlp("global_prior", nets.global_prior.mlp.layers, theirs.global_prior)
    mlp("agent_prior", nets.agent_prior.mlp.layers, theirs.agent_prior)
    # Ours sees (state, z, h).
    mlp("global_posterior", nets.global_posterior.mlp.layers, theirs.global_posterior)
    for first, seen, names in (
        ("agent_in", heads.agent_in, {"obs": heads.obs, "reward": heads.agent_reward}),
        (
            "full_in",
            heads.full_in,
            {name: getattr(heads, name) for name in ("terminated", "available", "action")},
        ),
    ):
        width = len(seen.bias) // len(names)
        for i, (name, rest) in enumerate(names.items()):
            twin = getattr(theirs, name)
            linear(f"{first}.{name}", seen, twin[0], np.s_[i * width : (i + 1) * width])
            mlp(name, rest.layers, twin)
    return pairs


def as_torch(rows: TimeStep, spec: Any) -> dict[str, torch.Tensor]:
    """Rows `[B, T, ...]` as the reference reads them."""
    rows = jax.tree.map(np.asarray, rows)
    action = np.asarray(spec.action_space.encode(jnp.asarray(rows.prev_action)))
    arrays = {
        "obs": rows.obs,
        "state": rows.state,
        "prev_action": action,
        "reward": rows.reward,
        "terminated": rows.terminated.astype(np.float32),
        "available": rows.available.astype(np.float32),
        "alive": rows.alive.astype(np.float32),
        "is_first": rows.is_first,
    }
    return {name: torch.from_numpy(np.array(x)) for name, x in arrays.items()}


def check(model: MABL, theirs: WorldModel, rows: TimeStep, algorithm: Any) -> dict[str, float]:
    """Largest relative differences of the loss and of a parameter's gradient."""
    config, space = algorithm.config.world_model, algorithm.spec.action_space
    key = jax.random.key(1)
    with torch.no_grad():
        for _, value, twin in paired(model, theirs):
            twin.copy_(torch.from_numpy(np.array(value)))
    swapped = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), rows)
    seen = observe_batch(model, swapped, key, train=True)
    samples = {
        "agent": seen.latents.agent.z.index,
        "global": seen.latents.global_.z.index,
        "global_prior": seen.prior_latents.global_.z.index,
    }
    forced = {
        name: torch.from_numpy(np.array(x).swapaxes(0, 1)).long() for name, x in samples.items()
    }
    (ours, _), gradient = jax.value_and_grad(model_loss, has_aux=True)(
        model, rows, key, config, space
    )
    theirs.zero_grad()
    loss = theirs.loss(as_torch(rows, algorithm.spec), forced)
    loss.backward()
    worst = 0.0
    for name, ours_grad, twin in paired(gradient, theirs):
        assert twin.grad is not None, name
        expected = twin.grad.numpy().copy()
        if name.endswith("bias_n"):  # two of PyTorch's three are one with its other bias
            expected[: 2 * len(expected) // 3] = 0
        scale = np.abs(expected).max() + 1e-12
        worst = max(worst, float(np.abs(ours_grad - expected).max() / scale))
    return {
        "loss": abs(float(ours) - loss.item()) / abs(loss.item()),
        "gradient": worst,
    }


def clock(function: Callable[[], Any]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--env", default="smax/3s_vs_4z")
    parser.add_argument("--precision", choices=("float32", "bfloat16"), default="float32")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--policy-rounds", type=int, default=2)
    args = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    use_compilation_cache()

    config = replace(preset("paper", args.env, "mabl"), precision=args.precision)
    training = build(config)
    algorithm, spec, sizes = training.algorithm, training.env.spec, config.world_model
    state = jax.jit(training.init)(jax.random.key(0))
    for _ in range(8):
        state, _ = jax.jit(training.cycle)(state, 0, 0)
    replay: Replay = state.replay
    rows = sample_sequences(replay, jax.random.key(2), sizes.batch_size, sizes.batch_length)

    theirs = Learner(
        Sizes(
            spec.n_agents,
            spec.obs_dim,
            spec.state_dim,
            spec.action_space.size,
            sizes.hidden,
            sizes.n_categoricals,
            sizes.n_classes,
            sizes.n_hidden,
            config.mappo.n_heads,
        ),
        config.imagination.horizon,
    )
    few = jax.tree.map(lambda x: x[:CHECKED], rows)
    differences = check(state.learner.model, theirs.model, few, algorithm)
    print(json.dumps({"check": differences}), flush=True)
    assert differences["loss"] < 1e-5 and differences["gradient"] < 1e-3, "they are not the same"

    keys = jax.random.split(jax.random.key(3), UPDATES)

    def ours_model(learner: Any, replay: Replay, keys: jax.Array) -> Any:
        experience: Any = Experience(replay, None, None)  # type: ignore[arg-type]
        return jax.lax.scan(
            lambda learner, key: algorithm.update_model(learner, experience, key), learner, keys
        )

    def ours_policy(learner: Any, replay: Replay, key: jax.Array) -> Any:
        experience: Any = Experience(replay, None, None)  # type: ignore[arg-type]
        return algorithm.update_policy(learner, experience, key)

    ours_model, ours_policy = (jax.jit(as_in_a_run(f, config)) for f in (ours_model, ours_policy))
    tensors = as_torch(rows, spec)
    contenders = {
        "model update": (
            lambda: ours_model(state.learner, replay, keys),
            lambda: [theirs.update_model(tensors) for _ in range(UPDATES)],
            UPDATES,
            args.rounds,
        ),
        "policy update": (
            lambda: ours_policy(state.learner, replay, keys[0]),
            lambda: theirs.update_policy(tensors),
            1,
            args.policy_rounds,
        ),
    }
    medians: dict[str, tuple[float, float]] = {}
    for name, (ours, reference, times, rounds) in contenders.items():
        clock(ours), clock(reference)
        seconds = [(clock(ours) / times, clock(reference) / times) for _ in range(rounds)]
        a, b = (float(np.median(column)) for column in zip(*seconds, strict=True))
        medians[name] = a, b
        ratios = [theirs_ / ours_ for ours_, theirs_ in seconds]
        print(
            json.dumps(
                {
                    "part": name,
                    "ours": round(a, 4),
                    "torch": round(b, 4),
                    "ratio": round(float(np.median(ratios)), 2),
                    "least": round(min(ratios), 2),
                    "greatest": round(max(ratios), 2),
                }
            ),
            flush=True,
        )
    plan = config.training
    a, b = (
        plan.model_updates * medians["model update"][i]
        + plan.policy_updates * medians["policy update"][i]
        for i in range(2)
    )
    print(json.dumps({"part": "learning of a cycle", "ours": a, "torch": b, "ratio": b / a}))
    print(
        json.dumps(
            {
                "env": args.env,
                "precision": args.precision,
                "threads": torch.get_num_threads(),
                "torch": torch.__version__,
                "jax": jax.__version__,
                "parameters": sum(x.size for x in jax.tree.leaves(state.learner.model)),
            }
        )
    )


if __name__ == "__main__":
    main()
