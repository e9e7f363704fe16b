"""A trained policy, taken away: one agent, its own observations, its own latent state."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from mabl.algorithms import registry as algorithms
from mabl.algorithms.config import Config
from mabl.envs import registry as envs
from mabl.envs.base import CompiledEnv, EnvSpec
from mabl.errors import UserError
from mabl.execution import LocalExecutor, act_alone
from mabl.runs import folder
from mabl.runs.checkpoint import Checkpoints


class LoadedRun(NamedTuple):
    """What a run folder holds, ready to act."""

    config: Config
    env: CompiledEnv
    executor: LocalExecutor
    step: int
    """Environment steps at which the checkpoint was written."""


def load_run(path: Path | str, env: str | None = None, greedy: bool = True) -> LoadedRun:
    """The newest checkpoint's policy, in its own environment or in `env`.

    Raises UserError if the folder is not a run or if the policy does not fit the environment.
    """
    path = Path(path)
    config = folder.read_config(path)
    checkpoints = Checkpoints(path / "checkpoints")
    trained_in = envs.make(config.env)
    played_in = envs.make(env) if env else trained_in
    check_fits(trained_in.spec, played_in.spec)
    algorithm = algorithms.make(config, trained_in.spec)
    shape = jax.eval_shape(lambda key: algorithm.policy(algorithm.init(key)), jax.random.key(0))
    policy = checkpoints.restore("policy", shape)
    executor = algorithm.executor(policy, greedy)
    return LoadedRun(config, played_in, executor, checkpoints.latest)


def check_fits(trained: EnvSpec, played: EnvSpec) -> None:
    """Raise UserError unless a policy trained in one environment can act in another."""
    for what, field in (
        ("agents", "n_agents"),
        ("observation features", "obs_dim"),
        ("actions", "action_space"),
    ):
        expected, found = getattr(trained, field), getattr(played, field)
        if expected != found:
            raise UserError(
                f"{played.name} has {found} {what}, the checkpoint expects {expected}: "
                f"pass --env {trained.name}"
            )


class Policy:
    """One agent's policy. It sees its own observation and holds its own latent state, nothing else.

    policy = Policy.load("runs/smax/3m/mabl/seed_0/20260101-120000", seed=i)  # for agent i
    policy.reset()                        # at the start of an episode
    action = policy.act(obs, available)   # once a step
    """

    def __init__(self, executor: LocalExecutor, seed: int = 0):
        self._executor = executor
        self._key = jax.random.key(seed)
        self._act = jax.jit(self._act_once)
        self.reset()

    @classmethod
    def load(cls, run: Path | str, greedy: bool = True, seed: int = 0) -> "Policy":
        """The newest policy of a run folder; load one for each agent, with a seed of its own.

        `seed` decides the samples of the latent state, and of the actions unless `greedy`.
        Raises UserError if the folder is not a run.
        """
        return cls(load_run(run, greedy=greedy).executor, seed)

    def reset(self) -> None:
        """Forget the episode so far."""
        space = self._executor.action_space
        self._level = self._executor.policy.filter.initial()
        self._prev_action = jnp.zeros(space.shape, space.dtype)
        self._is_first = True

    def act(self, obs: ArrayLike, available: ArrayLike | None = None) -> int | np.ndarray:
        """The action at an observation `[O]`, of those available `[A]` (None: all).

        Raises UserError if the sizes are not those that the policy was trained with.
        """
        n_obs = self._executor.policy.filter.encoder.layers[0].weight.shape[0]
        n_actions = self._executor.action_space.size
        obs = np.asarray(obs, np.float32)
        mask = np.ones(n_actions, bool) if available is None else np.asarray(available, bool)
        if obs.shape != (n_obs,):
            raise UserError(f"obs has shape {obs.shape}, the policy expects ({n_obs},)")
        if mask.shape != (n_actions,):
            raise UserError(f"available has shape {mask.shape}, the policy expects ({n_actions},)")
        self._key, key = jax.random.split(self._key)
        self._level, self._prev_action = self._act(
            self._level, self._prev_action, obs, mask, self._is_first, key
        )
        self._is_first = False
        action = np.asarray(self._prev_action)
        return int(action) if action.ndim == 0 else action

    def _act_once(self, level, prev_action, obs, available, is_first, key):
        executor = self._executor
        return act_alone(
            executor.policy,
            executor.action_space,
            level,
            prev_action,
            obs,
            available,
            is_first,
            key,
            executor.greedy,
        )
