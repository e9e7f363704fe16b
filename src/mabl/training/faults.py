"""What stops a run before its end: numbers that are not finite, and disks that take no more."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from mabl.envs.base import EnvSpec
from mabl.envs.host import first_not_finite
from mabl.errors import UNWRITABLE, UserError
from mabl.nets.optimiser import guards
from mabl.replay import Replay
from mabl.runs.checkpoint import Checkpoints, named
from mabl.training.loop import Training, TrainState
from mabl.types import Metrics


def check_finite(
    states: TrainState, metrics: Metrics, training: Training, checkpoints: Sequence[Checkpoints]
) -> None:
    """Look at what a cycle of every seed left. Raises UserError if its rows are not finite, if too
    many steps of an optimiser in a row were left out, or if the learner is not finite all the same.
    """
    limit = training.algorithm.config.training.max_skipped_updates
    fine, stuck = finite(states.learner), guards(states.learner)
    for k, mine in enumerate(checkpoints):
        by = f"by step {int(states.env_steps[k])}"
        if metrics["rows/not_finite"][k]:
            replay = jax.tree.map(lambda x, k=k: x[k], states.replay)
            raise UserError(
                f"{training.env.spec.name} gave {first_odd_row(replay, training.env.spec)} {by}; "
                f"{kept(mine)}: mabl check-env looks at it"
            )
        names = [name for name, guard in stuck.items() if guard.in_a_row[k] >= limit]
        said = sorted(name for name, value in metrics.items() if not np.isfinite(value[k]))
        if names:
            raise UserError(
                f"training diverged {by}: {limit} gradients in a row were not finite for "
                f"{names[0]} ({', '.join(said[:3])}); {kept(mine)}: lower the learning rates"
            )
        if not fine[k]:
            name = next(n for n, x in named(states.learner) if not np.isfinite(x[k]).all())
            raise UserError(
                f"training diverged {by}: {name} is not finite; {kept(mine)}: lower the learning "
                "rates"
            )


@jax.jit
@jax.vmap
def finite(tree: Any) -> Bool[Array, ""]:
    """Whether every number of a pytree is finite, for each seed."""
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()


def first_odd_row(replay: Replay, spec: EnvSpec) -> str:
    """Where one seed's replay has a number that is not finite."""
    for name in ("obs", "state", "reward"):
        rows = np.asarray(getattr(replay.rows, name))
        odd = np.argwhere(~np.isfinite(rows).all(axis=tuple(range(2, rows.ndim))))
        if odd.size:
            env, at = odd[0].tolist()
            return f"{first_not_finite(name, rows[env, at], spec)} in environment {env}"
    return "numbers that are not finite"


@contextmanager
def disks_explained(checkpoints: Sequence[Checkpoints]) -> Iterator[None]:
    """Turns what a disk refuses into a UserError that says what is kept."""
    try:
        yield
    except OSError as error:
        if error.errno not in UNWRITABLE:
            raise
        where = f" {error.filename}" if error.filename else ""
        raise UserError(
            f"cannot write{where} ({error.strerror}); {kept(checkpoints[0])}: make room, then "
            "mabl resume"
        ) from error


def kept(checkpoints: Checkpoints) -> str:
    """What there is to go back to."""
    newest: Any = next(iter(checkpoints.steps), None)
    return "no checkpoint was written" if newest is None else f"its checkpoint at {newest} is kept"
