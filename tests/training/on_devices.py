"""What `test_devices.py` runs in a process of its own, which has eight devices.

    python -m tests.training.on_devices ALGO NUM_SEEDS NUM_DEVICES FOLDER

`numbers.npz` is written to the folder, and a checkpoint of the first seed.
"""

import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from tests.tiny import tiny

from mabl.runs.checkpoint import Checkpoints, named
from mabl.training.programs import programs
from mabl.training.run import save


def main(algo, n_seeds, n_devices, folder):
    jax.config.update("jax_disable_most_optimizations", True)
    config = replace(tiny(algo), num_seeds=n_seeds, num_devices=n_devices)
    run = programs(config)
    keys = jax.vmap(jax.random.key)(np.arange(n_seeds))
    states = run.place(run.init(keys))
    compiled = []
    with run.open_cycle(config) as cycle:
        states, _ = cycle(states, 0, 0)
        jax.monitoring.register_event_duration_secs_listener(
            lambda name, *_, **__: compiled.append(name) if "compile" in name else None
        )
        for _ in range(5):
            states, _ = cycle(states, 0, 0)
        for _ in range(2):
            states, metrics = cycle(states, 2, 1)
        jax.monitoring.clear_event_listeners()
    found = dict(metrics) | run.diagnose(states) | dict(named(states.learner))
    lies_on = {d.id for leaf in jax.tree.leaves(states) for d in leaf.sharding.device_set}
    about = {"devices": len(lies_on), "compiled": len(compiled)}
    save(run.training, states, [Checkpoints.to_write(folder / "checkpoints", 1)])
    np.savez(
        folder / "numbers.npz",
        **{k.replace("/", "|"): np.asarray(v) for k, v in found.items()},
        **about,
    )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
