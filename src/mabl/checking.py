"""Does an environment keep its promises? A random policy plays, and every row is looked at."""

import time
import traceback
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple, Protocol

import jax
import numpy as np

from mabl.envs.base import CompiledEnv, Discrete, EnvSpec
from mabl.envs.host import Hosted, empty_rows, write_row
from mabl.errors import UserError
from mabl.rows import TimeStep, is_last

Verdict = Literal["good", "look", "bad"]


class Finding(NamedTuple):
    """What a check has to say."""

    verdict: Verdict
    what: str
    message: str


class Simulator(Protocol):
    """What is checked: an environment in numpy."""

    def reset(self, seed: int) -> TimeStep:
        """Start an episode."""
        ...

    def step(self, action: np.ndarray) -> TimeStep:
        """Take one joint step."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class _Compiled:
    """A compiled environment, one step at a time."""

    def __init__(self, env: CompiledEnv):
        self._reset, self._step = jax.jit(env.reset), jax.jit(env.step)

    def reset(self, seed: int) -> TimeStep:
        self._key = jax.random.key(seed)
        self._state, row = self._reset(self._key)
        return jax.device_get(row)

    def step(self, action: np.ndarray) -> TimeStep:
        self._key, key = jax.random.split(self._key)
        self._state, row = self._step(key, self._state, action)
        return jax.device_get(row)

    def close(self) -> None:
        """Nothing to let go of."""


class Episode(NamedTuple):
    """Rows `[T, ...]` of one episode, actions and seconds of what led to each."""

    rows: TimeStep
    actions: np.ndarray
    seconds: np.ndarray
    over: bool
    """It ended; otherwise it was given up."""


def check(env: CompiledEnv | Hosted, episodes: int, seed: int) -> list[Finding]:
    """Play episodes with random actions that are available; a finding for each promise."""
    spec = env.spec
    make: Callable[[], Simulator] = env.make if isinstance(env, Hosted) else lambda: _Compiled(env)
    simulator = make()
    try:
        played = [play(simulator, spec, seed + i) for i in range(episodes)]
        again = [play(simulator, spec, seed)]
    except UserError as error:
        return [Finding("bad", "rows", str(error))]
    except Exception:
        return [Finding("bad", "raises", traceback.format_exc())]
    finally:
        simulator.close()
    fresh = make()
    again.append(play(fresh, spec, seed))
    fresh.close()
    checks = (
        lambda: sizes(spec),
        lambda: first_rows(played),
        lambda: time_alignment(played),
        lambda: ends(played, spec),
        lambda: lives(played),
        lambda: masks(played, spec),
        lambda: observations(played),
        lambda: rewards(played),
        lambda: scores(played, spec),
        lambda: determinism(played, again),
        lambda: speed(played),
    )
    return [one() for one in checks]


def play(simulator: Simulator, spec: EnvSpec, seed: int) -> Episode:
    """One episode; given up two steps after its limit.

    Raises UserError for rows of other shapes than the spec's, or that are not finite.
    """
    rng = np.random.default_rng(seed)
    rows = empty_rows(spec, spec.episode_limit + 3)
    space, t = spec.action_space, 0
    actions = np.zeros((spec.episode_limit + 3, spec.n_agents, *space.shape), space.dtype)
    seconds = np.zeros(spec.episode_limit + 3)

    def keep(take: Callable[[], TimeStep]) -> TimeStep:
        began = time.perf_counter()
        row = take()
        seconds[t] = time.perf_counter() - began
        write_row(rows, t, row, spec)
        return row

    row = keep(partial(simulator.reset, seed))
    while not is_last(row) and t < spec.episode_limit + 2:
        t += 1
        actions[t] = random_action(row, spec, rng)
        row = keep(partial(simulator.step, actions[t]))
    cut = jax.tree.map(lambda x: x[: t + 1], rows)
    return Episode(cut, actions[: t + 1], seconds[: t + 1], bool(is_last(row)))


def random_action(row: TimeStep, spec: EnvSpec, rng: np.random.Generator) -> np.ndarray:
    """Uniform over what is available."""
    available = np.asarray(row.available)
    if isinstance(spec.action_space, Discrete):
        return (rng.random(available.shape) * available).argmax(-1).astype(np.int32)
    return (rng.uniform(-1, 1, available.shape) * available).astype(np.float32)


def sizes(spec: EnvSpec) -> Finding:
    """What there is."""
    kind = "actions" if isinstance(spec.action_space, Discrete) else "dimensions of actions"
    own = f" (of their own: {spec.obs_dims})" if len({*spec.obs_dims}) > 1 else ""
    return Finding(
        "good",
        "sizes",
        f"{spec.n_agents} agents see {spec.obs_dim} numbers{own} and have {spec.action_space.size} "
        f"{kind}; the state has {spec.state_dim}",
    )


def first_rows(played: list[Episode]) -> Finding:
    """Nothing has happened before a reset."""
    for episode in played:
        rows = episode.rows
        if not rows.is_first[0] or rows.is_first[1:].any():
            return Finding("bad", "resets", "rows are marked as resets where there was none")
        if rows.prev_action[0].any() or rows.reward[0].any():
            return Finding("bad", "resets", "a reset row holds an action or a reward")
    return Finding("good", "resets", "episodes begin with a row of their own")


def time_alignment(played: list[Episode]) -> Finding:
    """The action of row t is the one that led to it, and the last row is not the next reset's."""
    for i, episode in enumerate(played):
        rows = episode.rows
        acted = rows.alive[:-1] & rows.alive[1:]
        same = rows.prev_action[1:] == episode.actions[1:]
        same = same.reshape(*acted.shape, -1).all(-1)
        if not same[acted].all():
            t, agent = (int(x[0]) for x in np.nonzero(acted & ~same))
            return Finding(
                "bad",
                "time",
                f"row {t + 1} of episode {i} does not hold the action that agent {agent} took",
            )
        after = played[i + 1].rows.obs[0] if i + 1 < len(played) else None
        if after is not None and rows.obs[-1].any() and np.array_equal(rows.obs[-1], after):
            return Finding(
                "look",
                "time",
                f"the last observation of episode {i} is the first of the next: does the "
                "environment reset itself?",
            )
    return Finding("good", "time", "each row holds the action that led to it")


def ends(played: list[Episode], spec: EnvSpec) -> Finding:
    """Episodes end by themselves, or at their limit."""
    longest = max(len(episode.seconds) - 1 for episode in played)
    if not all(episode.over for episode in played):
        return Finding(
            "bad",
            "ends",
            f"an episode went on past its limit of {spec.episode_limit} steps: give the real one "
            "as --env-kwargs episode_limit=N",
        )
    cut = sum(bool(episode.rows.truncated[-1]) for episode in played)
    lengths = [len(episode.seconds) - 1 for episode in played]
    message = (
        f"{len(played) - cut} of {len(played)} episodes ended by themselves, {cut} were cut by a "
        f"limit; {min(lengths)} to {longest} steps"
    )
    if cut and any(
        episode.rows.truncated[-1] and len(episode.seconds) - 1 < spec.episode_limit
        for episode in played
    ):
        message += f", though the limit is {spec.episode_limit}: memory is set aside for that many"
        return Finding("look", "ends", message)
    return Finding("good", "ends", message)


def lives(played: list[Episode]) -> Finding:
    """Nobody comes back, and nothing is seen of those that are gone."""
    left = 0
    for episode in played:
        rows = episode.rows
        if (rows.alive[1:] & ~rows.alive[:-1]).any():
            return Finding("bad", "agents", "an agent that was gone came back")
        if (~rows.terminated[1:] & rows.terminated[:-1]).any():
            return Finding("bad", "agents", "an agent whose episode had ended went on")
        if rows.obs[~rows.alive].any():
            return Finding("bad", "agents", "an agent that is gone observes something")
        left += int((~rows.alive[-1]).sum())
    everyone = sum(episode.rows.alive.shape[1] for episode in played)
    return Finding("good", "agents", f"{left} of {everyone} were gone when their episode ended")


def masks(played: list[Episode], spec: EnvSpec) -> Finding:
    """There is always something to do, and never something that an agent lacks."""
    for episode in played:
        available = episode.rows.available
        if isinstance(spec.action_space, Discrete) and not available.any(-1).all():
            return Finding("bad", "masks", "an agent has no action that it may take")
        for agent, n in enumerate(spec.action_dims):
            if available[:, agent, n:].any():
                return Finding("bad", "masks", f"agent {agent} may take actions that it lacks")
    share = np.mean(np.concatenate([episode.rows.available.ravel() for episode in played]))
    return Finding("good", "masks", f"{share:.0%} of actions are available")


def observations(played: list[Episode]) -> Finding:
    """Finite, and of a size that networks can take."""
    obs = np.concatenate([episode.rows.obs[episode.rows.alive] for episode in played])
    low, high, still = obs.min(), obs.max(), int((obs.std(0) == 0).sum())
    message = f"from {low:.3g} to {high:.3g}; {still} of {obs.shape[1]} numbers never change"
    if max(-low, high) > 100:
        return Finding(
            "look", "observations", f"{message}: scale them, or give --env-kwargs symlog=true"
        )
    return Finding("good", "observations", message)


def rewards(played: list[Episode]) -> Finding:
    """Finite, not all zero, and of a size that losses can take."""
    reward = np.concatenate([episode.rows.reward[1:].ravel() for episode in played])
    returns = [float(episode.rows.reward.mean(-1).sum()) for episode in played]
    message = (
        f"from {reward.min():.3g} to {reward.max():.3g} a step, "
        f"{min(returns):.3g} to {max(returns):.3g} an episode"
    )
    if not reward.any():
        return Finding("look", "rewards", "a random policy never earned anything")
    if np.abs(reward).max() > 100:
        return Finding("look", "rewards", f"{message}: give --training.reward-scale below 1")
    return Finding("good", "rewards", message)


def scores(played: list[Episode], spec: EnvSpec) -> Finding:
    """Told at the end, and not before."""
    for episode in played:
        if np.isfinite(episode.rows.score[:-1]).any() or not np.isfinite(episode.rows.score[-1]):
            return Finding("bad", spec.score_name, "is not told on the last row alone")
    told = [float(episode.rows.score[-1]) for episode in played]
    return Finding("good", spec.score_name, f"{np.mean(told):.3g} with random actions")


def determinism(played: list[Episode], again: list[Episode]) -> Finding:
    """A seed decides an episode, and different seeds decide differently."""

    def same(one: Episode, other: Episode) -> bool:
        pairs: Any = zip(one.rows, other.rows, strict=True)
        return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)

    if not same(played[0], again[0]):
        message = "the same seed and actions gave another episode: pass `seed` on in reset"
        return Finding("look", "seeds", message)
    if not same(played[0], again[1]):
        return Finding("look", "seeds", "a new environment gave another episode for the same seed")
    if len(played) > 1 and np.array_equal(played[0].rows.obs[0], played[1].rows.obs[0]):
        return Finding("good", "seeds", "they decide the episode; all begin alike")
    return Finding("good", "seeds", "they decide the episode")


def speed(played: list[Episode]) -> Finding:
    """Of one environment, in the middle."""
    resets = [episode.seconds[0] for episode in played]
    steps = np.concatenate([episode.seconds[1:] for episode in played])
    return Finding(
        "good",
        "speed",
        f"{1 / np.median(steps):,.0f} steps a second, {1e3 * np.median(resets):.3g} ms a reset",
    )
