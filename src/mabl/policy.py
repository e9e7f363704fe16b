"""A trained policy, taken away: by one agent with its own observations, or by a whole team."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from mabl.algorithms import registry as algorithms
from mabl.algorithms.config import Config
from mabl.envs import registry as envs
from mabl.envs.base import CompiledEnv, EnvSpec
from mabl.envs.host import Hosted
from mabl.errors import UserError
from mabl.execution import JointExecutor, LocalExecutor, act_alone, executor_of
from mabl.rows import TimeStep
from mabl.runs import folder
from mabl.runs.checkpoint import Checkpoints


class LoadedRun(NamedTuple):
    """What a run folder holds, ready to act."""

    config: Config
    env: CompiledEnv | Hosted
    executor: LocalExecutor | JointExecutor
    step: int
    """Environment steps at which the checkpoint was written."""


def load_run(
    path: Path | str,
    env: str | None = None,
    env_kwargs: Sequence[str] = (),
    greedy: bool = True,
    trust: bool = False,
) -> LoadedRun:
    """The newest checkpoint's policy, in its own environment or in `env`.

    With `trust`, the run may name code of this machine as its environment, whoever wrote it.
    Raises UserError if the folder is not a run or if the policy does not fit the environment.
    """
    path = Path(path)
    config = folder.read_config(path, trust)
    checkpoints = Checkpoints(path / "checkpoints")
    trained_in = envs.make(config.env, config.env_kwargs)
    played_in = envs.make(env or config.env, env_kwargs) if env or env_kwargs else trained_in
    check_fits(trained_in.spec, played_in.spec)
    algorithm = algorithms.make(config, trained_in.spec)
    shape = jax.eval_shape(lambda key: algorithm.policy(algorithm.init(key)), jax.random.key(0))
    step, policy = checkpoints.restore("policy", shape)
    executor = executor_of(policy, trained_in.spec.action_space, greedy)
    return LoadedRun(config, played_in, executor, step)


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


class TeamPolicy:
    """A team's policy: all observations in one place, one call a step. Any algorithm has one.

    team = TeamPolicy.load("runs/smax/3m/mamba/seed_0/20260101-120000")
    team.reset()                                   # at the start of an episode
    actions = team.act(obs, available, alive)      # once a step
    """

    def __init__(self, executor: LocalExecutor | JointExecutor, n_agents: int, seed: int = 0):
        self._executor = executor
        self._n_agents = n_agents
        self._key = jax.random.key(seed)
        self._act = jax.jit(executor.act)
        self.reset()

    @classmethod
    def load(
        cls, run: Path | str, greedy: bool = True, seed: int = 0, trust: bool = False
    ) -> "TeamPolicy":
        """The newest policy of a run folder; `seed` decides what it samples; `trust` as `load_run`.

        Raises UserError if the folder is not a run.
        """
        loaded = load_run(run, greedy=greedy, trust=trust)
        return cls(loaded.executor, loaded.env.spec.n_agents, seed)

    def reset(self) -> None:
        """Forget the episode so far."""
        self._memory = None

    def act(
        self, obs: ArrayLike, available: ArrayLike | None = None, alive: ArrayLike | None = None
    ) -> np.ndarray:
        """The joint action at observations `[N, O]`, of those available `[N, A]` (None: all).

        `alive` `[N]` (None: all) says who is there to be heard. Raises UserError if the sizes are
        not those that the policy was trained with.
        """
        n, space = self._n_agents, self._executor.action_space
        obs = checked("obs", obs, (n, self._executor.policy.filter.obs_dim), np.float32)
        everything = np.ones((n, space.size), bool)
        available = everything if available is None else available
        is_first = self._memory is None
        if is_first:
            self._prev_action = jnp.zeros((n, *space.shape), space.dtype)
        row = TimeStep(
            prev_action=self._prev_action,
            reward=jnp.zeros(n),
            terminated=jnp.zeros(n, bool),
            truncated=jnp.bool_(False),
            obs=jnp.asarray(obs),
            state=jnp.zeros(0),
            available=jnp.asarray(checked("available", available, (n, space.size), bool)),
            alive=jnp.asarray(checked("alive", np.ones(n) if alive is None else alive, (n,), bool)),
            is_first=jnp.bool_(is_first),
            score=jnp.float32(jnp.nan),
        )
        self._key, key = jax.random.split(self._key)
        memory = self._executor.initial(row) if is_first else self._memory
        self._memory, self._prev_action = self._act(memory, row, key)
        return np.asarray(self._prev_action)


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
    def load(
        cls, run: Path | str, greedy: bool = True, seed: int = 0, trust: bool = False
    ) -> "Policy":
        """The newest policy of a run folder; load one for each agent, with a seed of its own.

        `seed` decides the samples of the latent state, and of the actions unless `greedy`; `trust`
        is for `load_run`.
        Raises UserError if the folder is not a run, or one of an algorithm whose agents cannot act
        alone.
        """
        loaded = load_run(run, greedy=greedy, trust=trust)
        if not isinstance(loaded.executor, LocalExecutor):
            raise UserError(
                f"{loaded.config.algo} executes centrally, there is no policy of one agent: "
                "use TeamPolicy"
            )
        return cls(loaded.executor, seed)

    def reset(self) -> None:
        """Forget the episode so far."""
        space = self._executor.action_space
        self._memory = self._executor.policy.filter.initial()
        self._prev_action = jnp.zeros(space.shape, space.dtype)
        self._is_first = True

    def act(self, obs: ArrayLike, available: ArrayLike | None = None) -> int | np.ndarray:
        """The action at an observation `[O]`, of those available `[A]` (None: all).

        Raises UserError if the sizes are not those that the policy was trained with.
        """
        n_actions = self._executor.action_space.size
        obs = checked("obs", obs, (self._executor.policy.filter.obs_dim,), np.float32)
        mask = np.ones(n_actions, bool) if available is None else available
        mask = checked("available", mask, (n_actions,), bool)
        self._key, key = jax.random.split(self._key)
        self._memory, self._prev_action = self._act(
            self._memory, self._prev_action, obs, mask, self._is_first, key
        )
        self._is_first = False
        action = np.asarray(self._prev_action)
        return int(action) if action.ndim == 0 else action

    def _act_once(self, memory, prev_action, obs, available, is_first, key):
        executor = self._executor
        return act_alone(
            executor.policy,
            executor.action_space,
            memory,
            prev_action,
            obs,
            available,
            is_first,
            key,
            executor.greedy,
        )


def checked(name: str, given: ArrayLike, shape: tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
    """An array of that type. Raises UserError for another shape."""
    array = np.asarray(given, dtype)
    if array.shape != shape:
        raise UserError(f"{name} has shape {array.shape}, the policy expects {shape}")
    return array
