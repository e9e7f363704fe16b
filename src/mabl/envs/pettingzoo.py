"""Any environment with PettingZoo's Parallel interface. Parameters are shared, so sizes are padded.

An agent is alive up to the row on which its own episode ends, that row included.
"""

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from mabl.envs.base import Continuous, Discrete, EnvSpec
from mabl.envs.host import Hosted, hosted_of, load_factory, made
from mabl.errors import UserError
from mabl.rows import TimeStep

FACTORY = "parallel_env"
"""What makes the environment in modules of PettingZoo's own kind."""
DEFAULT_LIMIT = 1_000
"""Joint steps of an environment that does not say how long it lasts."""
LIMITS = ("episode_limit", "max_cycles", "max_episode_steps", "max_steps")
"""Attributes that say it."""


def make(
    name: str,
    target: str,
    kwargs: Mapping[str, Any],
    episode_limit: int | None = None,
    symlog: bool = False,
) -> Hosted:
    """`module:factory`, called with `kwargs`; without a factory, `parallel_env`.

    Episodes are truncated after `episode_limit` joint steps, if not before; `symlog` squashes
    observations and states. Raises UserError for what cannot be imported, made, or learned in.
    """
    seen = dict(kwargs)
    if takes(load_factory(name, target, FACTORY), "render_mode"):
        seen["render_mode"] = "rgb_array"
    make, draw = (
        partial(ParallelEnv, name, target, options, episode_limit, symlog)
        for options in (dict(kwargs), seen)
    )
    return hosted_of(make, draw)


class ParallelEnv:
    """Rows of a Parallel environment. Agents whose spaces differ are told which one they are."""

    def __init__(
        self,
        name: str,
        target: str,
        kwargs: dict[str, Any],
        episode_limit: int | None = None,
        symlog: bool = False,
    ):
        self._symlog = symlog
        self._env = env = made(name, load_factory(name, target, FACTORY), kwargs)
        if not hasattr(env, "possible_agents"):
            raise UserError(
                f"{name} made {type(env).__name__}, which has no possible_agents: "
                "give a factory of PettingZoo's Parallel interface"
            )
        agents = self._agents = list(env.possible_agents)
        self._watchers = [Watcher(name, a, env.observation_space(a)) for a in agents]
        self._actors = [actor_of(name, a, env.action_space(a)) for a in agents]
        if len({type(actor) for actor in self._actors}) > 1:
            raise UserError(f"{name} mixes discrete and continuous actions: one kind is needed")
        own, sizes = [w.size for w in self._watchers], [a.size for a in self._actors]
        self._width = max(own)
        self._identity = np.eye(len(agents)) if len({*own}) > 1 or len({*sizes}) > 1 else None
        self._mask = np.arange(max(sizes)) < np.array(sizes)[:, None]
        discrete = isinstance(self._actors[0], DiscreteActor)
        limit = episode_limit or limit_of(env) or DEFAULT_LIMIT
        obs_dim = self._width + (0 if self._identity is None else len(agents))
        obs, _ = env.reset(seed=0)
        state = state_of(env)
        if state is not None and self._is_all_there_is_to_see(state, obs):
            state = None  # not worth having it worked out again
        self._has_state = state is not None
        self.spec = EnvSpec(
            name=name,
            n_agents=len(agents),
            obs_dim=obs_dim,
            state_dim=len(agents) * obs_dim if state is None else state.size,
            action_space=Discrete(max(sizes)) if discrete else Continuous(max(sizes)),
            episode_limit=limit,
            score_name="score",
            agent_ids=tuple(map(str, agents)),
            obs_dims=tuple(own),
            action_dims=tuple(sizes),
        )

    def reset(self, seed: int) -> TimeStep:
        """Start an episode."""
        obs, infos = self._env.reset(seed=seed)
        space, n = self.spec.action_space, self.spec.n_agents
        self._t, self._return, self._cut = 0, 0.0, False
        self._terminated = np.zeros(n, bool)
        there = [agent in self._env.agents for agent in self._agents]
        return self._row(np.zeros((n, *space.shape), space.dtype), obs, infos, {}, there)

    def step(self, action: np.ndarray) -> TimeStep:
        """Take one joint step with the actions of those that are there."""
        live = set(self._env.agents)
        chosen = {
            agent: actor(action[i])
            for i, (agent, actor) in enumerate(zip(self._agents, self._actors, strict=True))
            if agent in live
        }
        obs, rewards, terminations, truncations, infos = self._env.step(chosen)
        self._t += 1
        self._cut = not self._env.agents or all(truncations.get(a, False) for a in self._env.agents)
        if any(terminations.values()):
            self._terminated |= [bool(terminations.get(agent, False)) for agent in self._agents]
        return self._row(action, obs, infos, rewards, [agent in live for agent in self._agents])

    def render(self) -> np.ndarray:
        """What the environment draws, if it was made with `render_mode="rgb_array"`."""
        return np.asarray(self._env.render())

    @property
    def frames_per_second(self) -> float | None:
        """Of its metadata."""
        return (getattr(self._env, "metadata", None) or {}).get("render_fps")

    def close(self) -> None:
        """Let go of it."""
        self._env.close()

    def _row(
        self, action: Any, obs: Mapping, infos: Mapping, rewards: Mapping, alive: list[bool]
    ) -> TimeStep:
        n, space = self.spec.n_agents, self.spec.action_space
        seen = np.zeros((n, self.spec.obs_dim), np.float32)
        available = self._mask.copy()
        for i, (agent, watcher) in enumerate(zip(self._agents, self._watchers, strict=True)):
            if alive[i] and agent in obs:
                seen[i, : watcher.size] = watcher.flat(obs[agent])
                if self._identity is not None:
                    seen[i, self._width :] = self._identity[i]
            if not alive[i] or self._terminated[i]:
                available[i] = False
                available[i, 0] = isinstance(space, Discrete)
                continue
            mask = watcher.mask(obs.get(agent), infos.get(agent, {}))
            if mask is not None and mask.any():
                available[i, : len(mask)] = mask
        if self._symlog:
            seen[:, : self._width] = squash(seen[:, : self._width])
        paid = [float(rewards.get(agent, 0.0)) for agent in self._agents]
        self._return += sum(paid) / n
        ended = self._terminated.all()
        truncated = not ended and (self._cut or self._t >= self.spec.episode_limit)
        return TimeStep(
            prev_action=action,
            reward=np.array(paid, np.float32),
            terminated=self._terminated.copy(),
            truncated=np.bool_(truncated),
            obs=seen,
            state=self._state(seen),
            available=available,
            alive=np.array(alive),
            is_first=np.bool_(self._t == 0),
            score=np.float32(score_of(infos, self._return) if ended or truncated else np.nan),
        )

    def _state(self, seen: np.ndarray) -> np.ndarray:
        state = state_of(self._env) if self._has_state else None
        if state is None:
            return seen.ravel()
        return squash(state) if self._symlog else state

    def _is_all_there_is_to_see(self, state: np.ndarray, obs: Mapping) -> bool:
        seen = [w.flat(obs[a]) for a, w in zip(self._agents, self._watchers, strict=True)]
        return np.array_equal(state, np.concatenate(seen))


class Watcher:
    """One agent's observations as vectors, and the mask of actions that may come with them."""

    def __init__(self, name: str, agent: Any, space: Any):
        from gymnasium import spaces

        self._masked = isinstance(space, spaces.Dict) and "action_mask" in space.spaces
        if self._masked:
            parts = {k: v for k, v in space.spaces.items() if k != "action_mask"}
            space = spaces.Dict(parts)
        try:
            self.size = spaces.flatdim(space)
        except (NotImplementedError, ValueError) as error:
            raise UserError(f"{name}: {agent} observes {space}, which has no fixed size") from error
        self._is_box = isinstance(space, spaces.Box)
        self._space, self._flatten = space, spaces.flatten

    def flat(self, obs: Any) -> np.ndarray:
        """As a vector, parts of a dictionary one after the other."""
        if self._is_box:
            return np.asarray(obs, np.float32).ravel()
        if self._masked:
            obs = {k: v for k, v in obs.items() if k != "action_mask"}
        return np.asarray(self._flatten(self._space, obs), np.float32)

    def mask(self, obs: Any, info: Mapping) -> np.ndarray | None:
        """Legal actions, if observation or info tells them."""
        if self._masked and obs is not None:
            return np.asarray(obs["action_mask"], bool)
        return np.asarray(info["action_mask"], bool) if "action_mask" in info else None


class DiscreteActor:
    """One agent's discrete actions."""

    def __init__(self, space: Any):
        self.size, self._start = int(space.n), int(space.start)

    def __call__(self, action: np.ndarray) -> int:
        """In the environment's numbers."""
        return int(action) + self._start


class ContinuousActor:
    """One agent's continuous actions; dimensions without bounds are taken as they are."""

    def __init__(self, space: Any):
        self.size, self._space = int(np.prod(space.shape)), space
        bounded = np.isfinite(space.low) & np.isfinite(space.high)
        low, high = np.where(bounded, space.low, -1.0), np.where(bounded, space.high, 1.0)
        self._middle, self._half = (low + high) / 2, (high - low) / 2

    def __call__(self, action: np.ndarray) -> np.ndarray:
        """From [-1, 1] to the environment's bounds."""
        space, action = self._space, action[: self.size].reshape(self._space.shape)
        unit = np.maximum(np.minimum(action, 1), -1)  # much faster than clip
        stretched = (self._middle + unit * self._half).astype(space.dtype)
        return np.maximum(np.minimum(stretched, space.high), space.low)


def actor_of(name: str, agent: Any, space: Any) -> DiscreteActor | ContinuousActor:
    """How an agent acts. Raises UserError for spaces other than Discrete and Box."""
    from gymnasium import spaces

    if isinstance(space, spaces.Discrete):
        return DiscreteActor(space)
    if isinstance(space, spaces.Box):
        return ContinuousActor(space)
    raise UserError(f"{name}: {agent} acts in {space}: Discrete or Box is needed")


def takes(factory: Callable[..., Any], argument: str) -> bool:
    """Whether a factory can be given an argument of that name."""
    try:
        parameters = inspect.signature(factory).parameters.values()
    except ValueError:  # written in C
        return False
    return any(p.name == argument or p.kind is p.VAR_KEYWORD for p in parameters)


def squash(x: np.ndarray) -> np.ndarray:
    """symlog(x) = sign(x) log(1 + |x|): large numbers come near, small ones stay."""
    return np.sign(x) * np.log1p(np.abs(x))


def limit_of(env: Any) -> int | None:
    """How many joint steps an episode has, if the environment says so."""
    for holder in (env, getattr(env, "unwrapped", env)):
        for attribute in LIMITS:
            limit = getattr(holder, attribute, None)
            if isinstance(limit, int | np.integer) and limit > 0:
                return int(limit)
    return None


def state_of(env: Any) -> np.ndarray | None:
    """Its global state as a vector, if it has one."""
    try:
        state = env.state()
    except (AttributeError, NotImplementedError):
        return None
    return np.asarray(state, np.float32).ravel()


def score_of(infos: Mapping, episode_return: float) -> float:
    """The mean of the scores that infos hold, or the return."""
    scores = [float(info["score"]) for info in infos.values() if "score" in info]
    return float(np.mean(scores)) if scores else episode_return
