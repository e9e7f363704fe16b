"""Every algorithm at a size at which a test can afford it."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from mabl.algorithms.config import Config
from mabl.algorithms.presets import preset
from mabl.algorithms.registry import entry
from mabl.training.loop import TrainState
from mabl.training.programs import programs

SIZES = {
    "training": {
        "num_envs": 2,
        "collect_steps": 20,
        "model_updates": 2,
        "policy_updates": 1,
        "replay_capacity": 400,
        "diagnose_every": 300,
    },
    "world_model": {
        "hidden": 16,
        "n_hidden": 1,
        "n_categoricals": 2,
        "n_classes": 4,
        "batch_size": 4,
        "batch_length": 5,
    },
    "communication": {"n_layers": 1, "n_heads": 2},
    "imagination": {"horizon": 4, "n_starts": 8},
    "lookahead": {"candidates": 2, "steps": 2, "hidden": 8, "n_hidden": 1},
    "mappo": {"hidden": 16, "n_hidden": 1, "n_heads": 2, "n_epochs": 2},
    "qmix": {"hidden": 16, "n_hidden": 1, "mixer_hidden": 4, "hypernet_hidden": 4, "n_epochs": 2},
    "recurrent_mappo": {"hidden": 16, "n_heads": 2, "n_epochs": 2, "chunk_length": 10},
    "recurrent_qmix": {
        "hidden": 16,
        "mixer_hidden": 4,
        "hypernet_hidden": 4,
        "batch_size": 4,
        "batch_length": 8,
        "burn_in": 2,
        "epsilon_end": 0.5,
    },
}
LEARNING_STARTS = {"prefill_steps": 100, "pretrain_updates": 3}
ROWS = {"policy_input": "observation", "recurrent_sees": "row", "decoded_share": 0.5}
"""As `quick` has them on SMAX."""
WITH_ROWS = ("mabl-sg", "mabl-qmix")
"""Algorithms that are tried with them; the others are tried without."""


def sizes_of(algo: str) -> dict[str, dict[str, Any]]:
    """Fields that are changed in the sections that `algo` reads."""
    sizes = {name: dict(SIZES[name]) for name in entry(algo).sections}
    if "world_model" in sizes:
        sizes["training"] |= LEARNING_STARTS
    else:
        sizes["training"] |= {"model_updates": 0, "prefill_steps": 0}
    if algo in WITH_ROWS:
        sizes["world_model"] |= ROWS
    return sizes


def tiny(algo: str, env: str = "test/coordination") -> Config:
    """The `quick` preset of a test environment, made tiny in the sections that `algo` reads."""
    config = preset("quick", env, algo)
    return replace(
        config,
        **{name: replace(getattr(config, name), **new) for name, new in sizes_of(algo).items()},
    )


def flags(algo: str, env: str) -> list[str]:
    """The same as flags of `mabl train`."""
    config, given = tiny(algo, env), [f"--algo={algo}", f"--env={env}"]
    for name, changed in sizes_of(algo).items():
        section = getattr(config, name)
        given += [
            f"--{section.FLAG_PREFIX}{field.replace('_', '-')}={value}"
            for field, value in changed.items()
        ]
    return given


def learn_a_cycle(config: Config, replay_capacity: int) -> TrainState:
    """Collect an episode, then collect another and learn: the schedule of a config with small
    networks and batches."""
    small = {name: SIZES[name] for name in ("world_model", "imagination", "mappo")}
    small["training"] = {"replay_capacity": replay_capacity}
    config = replace(
        config,
        num_workers=0,
        **{name: replace(getattr(config, name), **new) for name, new in small.items()},
    )
    run = programs(config)
    states = run.init(jax.random.key(0)[None])
    with run.open_cycle(config) as cycle:
        states, _ = cycle(states, 0, 0)
        states, metrics = cycle(states, 2, 1)
    assert metrics["episodes/count"] == 1
    assert all(np.isfinite(value).all() for value in jax.device_get(metrics).values())
    return states
