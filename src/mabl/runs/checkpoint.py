"""Checkpoints: all that decides a run's future, written atomically with Orbax, the last K kept.

Each holds two items: `policy` (what acting needs: filter and actor) and `state` (everything).
Arrays are stored under readable names in flat dictionaries; nothing is pickled.
"""

from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from mabl.errors import UserError

T = TypeVar("T")


class Checkpoints:
    """The checkpoints of one run folder."""

    def __init__(self, folder: Path, keep: int = 2, create: bool = False):
        self.folder = folder.absolute()
        if not create and not self.folder.is_dir():
            raise UserError(f"{folder.parent} has no checkpoints: train it first with mabl train")
        options = ocp.CheckpointManagerOptions(
            max_to_keep=keep, create=create, enable_async_checkpointing=False
        )
        self._manager = ocp.CheckpointManager(
            self.folder, options=options, item_names=("policy", "state")
        )

    @property
    def latest(self) -> int:
        """Environment steps of the newest checkpoint."""
        step = self._manager.latest_step()
        if step is None:
            raise UserError(f"{self.folder.parent} has no finished checkpoint: train it again")
        return step

    @property
    def any(self) -> bool:
        """Whether there is a finished checkpoint."""
        return self._manager.latest_step() is not None

    def save(self, step: int, policy: Any, state: Any) -> None:
        """Write one checkpoint; it exists whole or not at all."""
        self._manager.save(
            step,
            args=ocp.args.Composite(
                policy=ocp.args.StandardSave(to_arrays(policy)),
                state=ocp.args.StandardSave(to_arrays(state)),
            ),
        )

    def restore(self, item: str, like: T) -> T:
        """An item of the newest checkpoint, in the structure of `like` (arrays or their shapes)."""
        here = jax.sharding.SingleDeviceSharding(jax.devices()[0])  # wherever they lay
        wanted = {
            name: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=here)
            for name, x in jax.eval_shape(to_arrays, like).items()
        }
        args = ocp.args.Composite(**{item: ocp.args.StandardRestore(wanted)})
        try:
            arrays = self._manager.restore(self.latest, args=args)[item]
        except (ValueError, KeyError, FileNotFoundError) as error:
            reason = str(error).partition("\n")[0][:200]
            raise UserError(
                f"checkpoint {self.folder}/{self.latest} does not fit this run's config "
                f"({reason}): evaluate it with the mabl that wrote it"
            ) from error
        return from_arrays(like, arrays)


def to_arrays(tree: Any) -> dict[str, jax.Array]:
    """Leaves by readable path; random keys as their data."""
    return {name: jax.random.key_data(leaf) if is_key(leaf) else leaf for name, leaf in named(tree)}


def from_arrays(like: T, arrays: dict[str, Any]) -> T:
    """The inverse of `to_arrays`, for a tree structured like `like`."""
    leaves = []
    for name, leaf in named(like):
        array = jnp.asarray(np.asarray(arrays[name]))
        leaves.append(jax.random.wrap_key_data(array) if is_key(leaf) else array)
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def named(tree: Any) -> list[tuple[str, Any]]:
    """Leaves with their paths, such as `learner.model.filter.encoder.layers.0.weight`."""
    paths = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in paths]


def is_key(leaf: Any) -> bool:
    """True for typed random keys."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
