"""How long each part of a run takes, and how near that comes to what the machine can do.

All parts run one after the other in one process. Work is the multiplications and additions of
matrix products in the program as it is written: what an index saves in place of a one-hot vector is
not in it.
"""

import json
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.compilation_cache.compilation_cache import reset_cache
from jax.extend.core import jaxprs_in_params
from jax.interpreters.partial_eval import dce_jaxpr

from mabl.algorithms.base import Experience
from mabl.algorithms.config import Config
from mabl.algorithms.mag import MAG
from mabl.algorithms.model_based import ModelBased
from mabl.devices import SEEDS
from mabl.envs.workers import n_cores
from mabl.errors import UserError
from mabl.replay import Replay, sample_sequences
from mabl.runs import folder
from mabl.training.loop import Training, TrainState
from mabl.training.programs import as_in_a_run, build, forget_programs, programs
from mabl.training.run import longest_lane
from mabl.types import PRNGKey

PEAK_SIZE = {"cpu": 2048}
"""Rows and columns of the matrices whose product is the peak, by backend."""
PEAK_SIZE_OF_OTHERS = 8192
"""Which a smaller one would not fill."""
COPIED = 2**28
"""Bytes that are copied to measure an accelerator's bandwidth."""
LEARNING = ("replay sampling", "model update", "imagination", "behaviour update")
"""Parts of learning in imagination."""
UPDATES = 5
"""Model updates in one call, as they follow each other in a cycle."""


class Timing(NamedTuple):
    """One part of a run."""

    seconds: list[float]
    """Of every repeat."""
    flop: float
    """Of the matrix products in it; 0 where they are not counted."""
    temporary: int
    """Bytes that its program needs beside inputs and outputs; 0 where it has none of its own."""

    @property
    def median(self) -> float:
        """Seconds."""
        return float(np.median(self.seconds))


class Report(NamedTuple):
    """What was measured in one process."""

    subject: dict[str, Any]
    """What was run."""
    machine: dict[str, Any]
    """Where, and with which versions."""
    timings: dict[str, Timing]
    """By part."""
    peak: dict[str, float]
    """FLOP/s of a product of square matrices, by type; `copy`: an accelerator's bytes/s."""
    compile_seconds: float
    """Until a first cycle has collected: to trace and compile it, without a cache."""
    memory: int
    """Most bytes in use: on the device, or of this process where that is the CPU."""

    def write(self, path: Path) -> None:
        """As JSON."""
        timings = {
            name: timing._asdict() | {"median": timing.median}
            for name, timing in self.timings.items()
        }
        path.write_text(json.dumps(self._asdict() | {"timings": timings}, indent=1) + "\n")


class Part(NamedTuple):
    """A pure function that is timed on its own; `times` what it does is done in one call."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    times: int = 1


def measure(
    config: Config, repeats: int, names: tuple[str, ...], say: Callable[[str], object]
) -> Report:
    """Time the parts in `names`, or all; `say` hears what is going on.

    Raises UserError for a part that the algorithm does not have.
    """
    forget_programs()
    training, run = build(config), programs(config)
    plan = training.algorithm.config.training
    learning = LEARNING if model_based(training) else ()
    known = ("collection", *learning, "cycle")
    for name in names:
        if name not in known:
            raise UserError(f"{config.algo} has no part {name!r}: give {', '.join(known)}")
    wanted = names or known
    timings: dict[str, Timing] = {}
    with run.open_cycle(config) as cycle, without_cache():
        keys = jax.random.split(jax.random.key(config.seed), config.num_seeds)
        states = run.place(run.init(keys))

        def cycles(states: TrainState, *counts: int) -> tuple[TrainState, Timing]:
            """Each consumes the states that it is given."""
            seconds = []
            for _ in range(repeats + 1):
                start = time.perf_counter()
                states, _ = jax.block_until_ready(cycle(states, *counts))
                seconds.append(time.perf_counter() - start)
            return states, Timing(seconds[1:], 0.0, 0)

        say("compiling")
        start = time.perf_counter()
        states, _ = jax.block_until_ready(cycle(states, 0, 0))
        compile_seconds = time.perf_counter() - start
        say("filling the replay")
        while (
            int(states.env_steps.min()) < plan.prefill_steps
            or longest_lane(states) < training.algorithm.rows_needed
        ):
            states, _ = cycle(states, 0, 0)
        if "collection" in wanted:
            say("collection")
            states, timings["collection"] = cycles(states, 0, 0)
        parts = parts_of(training, states) if learning else {}
        for name in (name for name in learning if name in wanted):
            say(name)
            timings[name] = timed(parts[name], repeats)
        if "cycle" in wanted:
            say("cycle")
            flop = {name: flop_of(part) / part.times for name, part in parts.items()}
            states, timing = cycles(states, plan.model_updates, plan.policy_updates)
            work = plan.model_updates * flop.get("model update", 0.0) + plan.policy_updates * (
                flop.get("imagination", 0.0) + flop.get("behaviour update", 0.0)
            )
            timings["cycle"] = timing._replace(flop=work)
    say("peak")
    about = ("preset", "env", "algo", "precision", "num_seeds", "num_devices")
    subject = {name: getattr(config, name) for name in about}
    return Report(
        subject | {"n_agents": training.env.spec.n_agents},
        folder.versions() | {"device": jax.devices()[0].device_kind, "cores": n_cores()},
        timings,
        peaks(repeats),
        compile_seconds,
        peak_memory(),
    )


def model_based(training: Training) -> bool:
    """Whether it learns in imagination."""
    return isinstance(training.algorithm, ModelBased | MAG)


def parts_of(training: Training, states: TrainState) -> dict[str, Part]:
    """`LEARNING`, for all seeds at once."""
    algorithm, learner, replay = training.algorithm, states.learner, states.replay
    assert isinstance(algorithm, ModelBased | MAG)
    sizes, key = algorithm.config.world_model, states.key

    def sample(replay: Replay, key: PRNGKey) -> Any:
        return sample_sequences(replay, key, sizes.batch_size, sizes.batch_length)

    def update_model(learner: Any, replay: Replay, key: PRNGKey) -> Any:
        experience = Experience(replay, None, None)  # pyright: ignore[reportArgumentType]

        def update(learner: Any, key: PRNGKey) -> Any:
            return algorithm.update_model(learner, experience, key)

        return jax.lax.scan(update, learner, jax.random.split(key, UPDATES))

    def update_behaviour(learner: Any, imagined: Any, key: PRNGKey) -> Any:
        trajectory, replayed = imagined
        return algorithm.learn(learner, trajectory, replayed, key)

    def part(function: Callable[..., Any], *arguments: Any, times: int = 1) -> Part:
        return Part(as_in_a_run(over_seeds(function), algorithm.config), arguments, times)

    imagine = part(algorithm.imagine, learner, replay, key)
    imagined = jax.jit(imagine.function)(*imagine.arguments)
    parts = (
        part(sample, replay, key),
        part(update_model, learner, replay, key, times=UPDATES),
        imagine,
        part(update_behaviour, learner, imagined, key),
    )
    return dict(zip(LEARNING, parts, strict=True))


def over_seeds(function: Callable[..., Any]) -> Callable[..., Any]:
    """Of the one seed, or of all; arguments and results have an axis of seeds."""

    def mapped(*arguments: Any) -> Any:
        if len(jax.tree.leaves(arguments[-1])[0]) > 1:
            return jax.vmap(function, spmd_axis_name=SEEDS)(*arguments)
        one = function(*jax.tree.map(lambda x: x[0], arguments))
        return jax.tree.map(lambda x: x[None], one)

    return mapped


def timed(part: Part, repeats: int) -> Timing:
    """Seconds of one time, after a call to warm up."""
    compiled = jax.jit(part.function).lower(*part.arguments).compile()
    memory = compiled.memory_analysis()
    jax.block_until_ready(compiled(*part.arguments))
    seconds = [clock(partial(compiled, *part.arguments)) / part.times for _ in range(repeats)]
    temporary = int(memory.temp_size_in_bytes) if memory else 0
    return Timing(seconds, flop_of(part) / part.times, temporary)


def clock(function: Callable[[], Any]) -> float:
    """Seconds until its result is there."""
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start


def flop_of(part: Part) -> float:
    """Of one call, less what nobody reads."""
    jaxpr = jax.make_jaxpr(part.function)(*part.arguments).jaxpr
    return flop(dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[0])


def flop(jaxpr: Any) -> float:
    """Of all matrix products in a program, the dearest branch of each choice; loops without a known
    length count once."""
    total = 0.0
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        summed: tuple[int, ...] = ()
        if name == "dot_general":
            summed = equation.params["dimension_numbers"][0][0]
        elif name == "product":  # of nets.product
            summed = (-1,)
        if summed:
            shape = equation.invars[0].aval.shape
            total += 2 * prod(equation.outvars[0].aval.shape) * prod(shape[i] for i in summed)
        each = [flop(inner) for inner in jaxprs_in_params(equation.params)]
        inner = max(each) if name == "cond" else sum(each)
        total += inner * equation.params.get("length", 1)
    return total


@contextmanager
def without_cache() -> Iterator[None]:
    """Programs are compiled, not read from where an earlier process left them."""
    was = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_compilation_cache", False)
    reset_cache()  # JAX remembers whether there is one
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", was)
        reset_cache()


def peaks(repeats: int) -> dict[str, float]:
    """What the device does at best, measured here and now."""
    found, size = {}, PEAK_SIZE.get(jax.default_backend(), PEAK_SIZE_OF_OTHERS)
    for kind in (jnp.float32, jnp.bfloat16):
        ones = jnp.ones((size, size), kind)
        product = jax.jit(partial(jnp.matmul, preferred_element_type=jnp.float32))
        clock(partial(product, ones, ones))
        fastest = min(clock(partial(product, ones, ones)) for _ in range(repeats))
        found[jnp.dtype(kind).name] = 2 * size**3 / fastest
    if jax.default_backend() != "cpu":
        block = jnp.zeros(COPIED // 4, jnp.float32)
        copy = jax.jit(lambda x: x + 1)
        clock(partial(copy, block))
        found["copy"] = 2 * COPIED / min(clock(partial(copy, block)) for _ in range(repeats))
    return found


def peak_memory() -> int:
    """The most bytes that were in use so far."""
    import resource  # which not every system has

    stats = jax.devices()[0].memory_stats() or {}
    of_process = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return stats.get("peak_bytes_in_use") or of_process * (
        1 if platform.system() == "Darwin" else 1024
    )
