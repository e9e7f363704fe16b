"""Acting in the real world, from real observations."""

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array

from mabl.behaviour.actor import Actor
from mabl.envs.base import ActionSpace, Discrete
from mabl.types import PRNGKey, TimeStep
from mabl.world_models.levels import AgentFilter, Level

Memory = Any


class Executor(Protocol):
    """Chooses a team's joint action row by row; pure, for one environment."""

    def initial(self, row: TimeStep) -> Memory:
        """What it remembers before a first row; `row` only gives shapes."""
        ...

    def act(self, memory: Memory, row: TimeStep, key: PRNGKey) -> tuple[Memory, Array]:
        """The joint action at `row`, an int32 `[N]` or float32 `[N, A]`."""
        ...


class LocalPolicy(NamedTuple):
    """All that an agent needs to act: shared parameters of its filter and its actor."""

    filter: AgentFilter
    actor: Actor


def act_alone(
    policy: LocalPolicy,
    action_space: ActionSpace,
    level: Level,
    prev_action: Array,
    obs: Array,
    available: Array,
    is_first: Array,
    key: PRNGKey,
    greedy: bool,
) -> tuple[Level, Array]:
    """One agent, one step, on its own: nothing of its teammates or of the state can get in.

    a_t ~ pi(a_t | z_t, h_t) with (z_t, h_t) inferred from o_t, h_{t-1}, z_{t-1}, a_{t-1}.
    """
    key_latent, key_action = jax.random.split(key)
    encoded = action_space.encode(prev_action)
    level, encoded = jax.tree.map(
        lambda x: jnp.where(is_first, jnp.zeros_like(x), x), (level, encoded)
    )
    level = policy.filter(level, encoded, obs, key_latent)
    choice = policy.actor(jnp.concatenate([level.z, level.h]), available)
    action = choice.mode() if greedy else choice.sample(key_action)
    return level, action.astype(action_space.dtype)


class LocalExecutor(NamedTuple):
    """Decentralised execution: the same filter and actor for every agent, each on its own row."""

    policy: LocalPolicy
    action_space: ActionSpace
    greedy: bool = False

    def initial(self, row: TimeStep) -> Level:
        """Zero latents `[N, ...]`."""
        n_agents = row.obs.shape[0]
        return jax.tree.map(
            lambda x: jnp.zeros((n_agents, *x.shape), x.dtype), self.policy.filter.initial()
        )

    def act(self, memory: Level, row: TimeStep, key: PRNGKey) -> tuple[Level, Array]:
        """Every agent acts alone."""
        keys = jax.random.split(key, row.obs.shape[0])

        def one(level, prev_action, obs, available, key):
            return act_alone(
                self.policy,
                self.action_space,
                level,
                prev_action,
                obs,
                available,
                row.is_first,
                key,
                self.greedy,
            )

        return jax.vmap(one)(memory, row.prev_action, row.obs, row.available, keys)


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
