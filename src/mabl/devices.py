"""Several accelerators: seeds are spread over them, and batches where there are fewer seeds.

Programs are written as for one device; XLA cuts them up by where their arrays are said to lie.
"""

import os
from contextlib import AbstractContextManager
from functools import lru_cache
from math import gcd
from pathlib import Path
from typing import TypeVar

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from mabl.errors import UserError

Tree = TypeVar("Tree")
SEEDS, BATCH = "seeds", "batch"
"""Axes of the grid of devices."""


@lru_cache
def grid(n_devices: int, n_seeds: int) -> Mesh:
    """As many of the devices as possible along seeds, the rest along batches.

    Raises UserError if there are not so many devices.
    """
    devices = jax.devices()
    if n_devices > len(devices):
        raise UserError(
            f"--num-devices is {n_devices}: give a number up to {len(devices)}, as many as "
            f"{jax.default_backend()} has"
        )
    over_seeds = gcd(n_devices, n_seeds)
    shape = over_seeds, n_devices // over_seeds
    return jax.make_mesh(
        shape, (SEEDS, BATCH), axis_types=(AxisType.Auto,) * 2, devices=devices[:n_devices]
    )


def by_seed(mesh: Mesh) -> NamedSharding:
    """Where arrays lie whose first axis is that of seeds."""
    return NamedSharding(mesh, PartitionSpec(SEEDS))


def traced_for(mesh: Mesh) -> AbstractContextManager[object]:
    """What is traced in it runs on these devices: `spread` knows them."""
    return jax.sharding.use_abstract_mesh(mesh.abstract_mesh)


def spread(rows: Tree) -> Tree:
    """Rows of a batch, each device with its share of them."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty or mesh.shape[BATCH] == 1:
        return rows
    share = PartitionSpec(BATCH)
    return jax.tree.map(lambda x: jax.lax.with_sharding_constraint(x, share), rows)


def use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache folder, unless JAX was told of another place."""
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(cache / "mabl" / "jax"))
