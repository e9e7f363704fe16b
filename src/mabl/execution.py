"""Acting in the real world, from real observations."""

from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mabl.behaviour.base import ActorFunction
from mabl.envs.base import ActionSpace, Discrete
from mabl.nets.mlp import Features
from mabl.rows import TimeStep
from mabl.types import PRNGKey
from mabl.world_models.levels import forget, team_of

Memory = Any
M = TypeVar("M")


class Executor(Protocol):
    """Chooses a team's joint action row by row; pure, for one environment."""

    def initial(self, row: TimeStep) -> Memory:
        """What it remembers before a first row; `row` only gives shapes."""
        ...

    def act(self, memory: Memory, row: TimeStep, key: PRNGKey) -> tuple[Memory, Array]:
        """The joint action at `row`, an int32 `[N]` or float32 `[N, A]`."""
        ...


class LocalFilter(Protocol[M]):
    """What one agent remembers, from its own observations and actions alone.

    There is no agent axis, no state and no teammate in its inputs: decentralised by type.
    """

    @property
    def obs_dim(self) -> int:
        """Features of an observation."""
        ...

    def initial(self) -> M:
        """The memory before an episode's first row."""
        ...

    def __call__(
        self, memory: M, prev_action: Float[Array, " A"], obs: Float[Array, " O"], key: PRNGKey
    ) -> M:
        """One step; the caller resets `memory` and `prev_action` at a first row."""
        ...

    def features(self, memory: M) -> Features:
        """What the policy sees of it."""
        ...


@runtime_checkable
class JointFilter(Protocol[M]):
    """What a team remembers together: execution needs everybody's observations in one place."""

    @property
    def obs_dim(self) -> int:
        """Features of an observation."""
        ...

    def initial(self) -> M:
        """The memory before an episode's first row."""
        ...

    def joint(
        self,
        memory: M,
        prev_action: Float[Array, "N A"],
        obs: Float[Array, "N O"],
        alive: Bool[Array, " N"],
        key: PRNGKey,
    ) -> M:
        """One step of all; the caller resets `memory` and `prev_action` at a first row."""
        ...

    def features(self, memory: M) -> Features:
        """What each agent's policy sees of it."""
        ...


class Policy(NamedTuple):
    """All that is needed to act: parameters of a filter and of an actor."""

    filter: Any
    actor: ActorFunction


def act_alone(
    policy: Policy,
    action_space: ActionSpace,
    memory: Memory,
    prev_action: Array,
    obs: Array,
    available: Array,
    is_first: Array,
    key: PRNGKey,
    greedy: bool,
) -> tuple[Memory, Array]:
    """One agent, one step, on its own: nothing of its teammates or of the state can get in.

    With a world model's filter: a_t ~ pi(a_t | z_t, h_t), inferred from o_t, h_{t-1}, z_{t-1},
    a_{t-1}; or what `WorldModelConfig.policy_input` says in place of (z_t, h_t).
    """
    key_latent, key_action = jax.random.split(key)
    memory, encoded = forget((memory, action_space.encode(prev_action)), is_first)
    memory = policy.filter(memory, encoded, obs, key_latent)
    choice = policy.actor(policy.filter.features(memory), available)
    action = choice.mode() if greedy else choice.sample(key_action)
    return memory, action.astype(action_space.dtype)


class LocalExecutor(NamedTuple):
    """Decentralised execution: the same filter and actor for every agent, each on its own row."""

    policy: Policy
    action_space: ActionSpace
    greedy: bool = False

    def initial(self, row: TimeStep) -> Memory:
        """Memories `[N, ...]`."""
        return team_of(row.obs.shape[0], self.policy.filter.initial())

    def act(self, memory: Memory, row: TimeStep, key: PRNGKey) -> tuple[Memory, Array]:
        """Every agent acts alone."""
        keys = jax.random.split(key, row.obs.shape[0])

        def one(memory, prev_action, obs, available, key):
            return act_alone(
                self.policy,
                self.action_space,
                memory,
                prev_action,
                obs,
                available,
                row.is_first,
                key,
                self.greedy,
            )

        return jax.vmap(one)(memory, row.prev_action, row.obs, row.available, keys)


class JointExecutor(NamedTuple):
    """Centralised execution: one filter for the team, then the actor on each agent's features."""

    policy: Policy
    action_space: ActionSpace
    greedy: bool = False

    def initial(self, row: TimeStep) -> Memory:
        """The team's memory."""
        del row
        return self.policy.filter.initial()

    def act(self, memory: Memory, row: TimeStep, key: PRNGKey) -> tuple[Memory, Array]:
        """The team infers its latents together, and each agent acts on its own."""
        key_latent, key_action = jax.random.split(key)
        joint = self.policy.filter
        encoded = self.action_space.encode(row.prev_action)
        memory, encoded = forget((memory, encoded), row.is_first)
        memory = joint.joint(memory, encoded, row.obs, row.alive, key_latent)
        choice = jax.vmap(self.policy.actor)(joint.features(memory), row.available)
        action = choice.mode() if self.greedy else choice.sample(key_action)
        return memory, action.astype(self.action_space.dtype)


def executor_of(
    policy: Policy, action_space: ActionSpace, greedy: bool = False
) -> LocalExecutor | JointExecutor:
    """How a policy acts: its filter decides whether agents can act alone."""
    together = isinstance(policy.filter, JointFilter)
    return (JointExecutor if together else LocalExecutor)(policy, action_space, greedy)


class RandomExecutor(NamedTuple):
    """Uniform over available actions: the baseline that anything must beat."""

    action_space: ActionSpace

    def initial(self, row: TimeStep) -> None:
        """Remembers nothing."""
        return None

    def act(self, memory: None, row: TimeStep, key: PRNGKey) -> tuple[None, Array]:
        """One draw for each agent."""
        if isinstance(self.action_space, Discrete):
            logits = jnp.where(row.available, 0.0, -jnp.inf)
            return None, jax.random.categorical(key, logits).astype(jnp.int32)
        shape = (row.obs.shape[0], self.action_space.size)
        return None, jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
