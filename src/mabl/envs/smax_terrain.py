"""What SMAX lacks: walls that block the way, units that are rooted, and an enemy that walks round.

SMAX (jaxmarl 0.2.0) has open ground only, and its collision pushes every unit. `TerrainSMAX` adds
walls and keeps units of velocity zero where they are; with neither it computes exactly what SMAX
computes. `attack_closest` is jaxmarl's heuristic, made able to find the gap in a wall.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from einops import rearrange
from jaxmarl.environments.smax import SMAX
from jaxmarl.environments.smax.heuristic_enemy import HeuristicPolicyState, create_heuristic_policy
from jaxmarl.environments.smax.smax_env import State
from jaxtyping import Array, Bool, Float, Int

from mabl.types import PRNGKey

Wall = tuple[float, float, float, float]
"""An axis-aligned rectangle (x low, y low, x high, y high) in map units; its edge is free."""

STOP = 4
"""Actions 0 to 3 walk up, right, down, left; 4 stops; from 5 on they attack."""
_DIRECTIONS = np.array([[0, 1], [1, 0], [0, -1], [-1, 0], [0, 0]], np.float32)

Policy = Callable[
    [PRNGKey, HeuristicPolicyState, Float[Array, "N O"]],
    tuple[Int[Array, " N"], HeuristicPolicyState],
]


class TerrainSMAX(SMAX):
    """SMAX with walls, and with units of velocity zero pinned to their place.

    A unit is its centre: its radius counts against other units, not against walls. Walls block
    steps and pushes; sight and shots pass over them.
    """

    def __init__(self, walls: tuple[Wall, ...] = (), **smax_options):
        super().__init__(**smax_options)
        corners = np.array(walls, np.float32).reshape(-1, 2, 2)
        self.wall_low, self.wall_high = jnp.asarray(corners[:, 0]), jnp.asarray(corners[:, 1])
        # SMAX adds the pushes of all neighbours up, so a crowd could throw a unit over a wall.
        self.longest_push = float((corners[:, 1] - corners[:, 0]).min(initial=math.inf)) / 2

    @property
    def has_walls(self) -> bool:
        """False on open ground."""
        return len(self.wall_low) > 0

    def inside_walls(self, position: Float[Array, "2"]) -> Bool[Array, " W"]:
        """True for each wall that the position lies in."""
        return ((self.wall_low < position[None]) & (position[None] < self.wall_high)).all(-1)

    def hidden(self, start: Float[Array, "2"], end: Float[Array, "2"]) -> Bool[Array, ""]:
        """True where a wall cuts the segment from start to end (slab method)."""
        way = (end - start)[None]
        way = jnp.where(jnp.abs(way) < 1e-6, 1e-6, way)
        start = start[None]
        low, high = (self.wall_low - start) / way, (self.wall_high - start) / way
        enters, leaves = jnp.minimum(low, high).max(-1), jnp.maximum(low, high).min(-1)
        return ((enters < leaves) & (leaves > 0) & (enters < 1)).any()

    def detour(self, position: Float[Array, "2"], action: Int[Array, ""]) -> Int[Array, ""]:
        """The action, or a walk along the wall to its nearer end if the action leads into one.

        Looks two map units ahead: about one joint step of the fastest unit (8 world steps of 1/16
        at velocity 4.13). Needs at least one wall.
        """
        direction = jnp.asarray(_DIRECTIONS)[jnp.minimum(action, STOP)]
        blocked_by = self.inside_walls(position + 2.0 * direction)
        wall = blocked_by.argmax()
        to_high = self.wall_high[wall] - position < position - self.wall_low[wall]
        along_x, along_y = jnp.where(to_high[0], 1, 3), jnp.where(to_high[1], 0, 2)
        sideways = jnp.where(direction[0] != 0, along_y, along_x)
        return jnp.where(blocked_by.any(), sideways, action)

    def _slide(self, old: Float[Array, "U 2"], new: Float[Array, "U 2"]) -> Float[Array, "U 2"]:
        """The first that is free: the new position, its x alone, its y alone, the old one."""
        result = old
        for x, y in ((old, new), (new, old), (new, new)):
            candidate = jnp.stack([x[:, 0], y[:, 1]], axis=-1)
            blocked = jax.vmap(self.inside_walls)(candidate).any(-1, keepdims=True)
            result = jnp.where(blocked, result, candidate)
        return result

    def _world_step(self, key, state: State, actions) -> State:
        moved = super()._world_step(key, state, actions)
        return replace(
            moved, unit_positions=self._slide(state.unit_positions, moved.unit_positions)
        )

    def _push_units_away(self, state: State, firmness: float = 1.0) -> State:
        old = state.unit_positions
        new = super()._push_units_away(state, firmness).unit_positions
        length = jnp.linalg.norm(new - old, axis=-1, keepdims=True)
        shortened = old + (new - old) * (self.longest_push / jnp.maximum(length, 1e-6))
        new = jnp.where(length > self.longest_push, shortened, new)
        rooted = self.unit_type_velocities[state.unit_types] == 0
        return replace(state, unit_positions=jnp.where(rooted[:, None], old, self._slide(old, new)))


def attack_closest(env: TerrainSMAX, team: int) -> tuple[HeuristicPolicyState, Policy]:
    """jaxmarl's heuristic for one team (0 allies, 1 enemies): its initial state and its policy.

    On open ground it is jaxmarl's to the bit. With walls it would run into them, as it only walks
    along the axis on which its target is farther; so there it chases nobody that a wall hides,
    heads for the other team's start instead, and makes detours.
    """
    units, opponents = (env.num_allies, env.num_enemies)[:: 1 - 2 * team]
    heuristic = create_heuristic_policy(env, team)
    # On open ground the zeros mean "not begun": the policy then picks a point across the map.
    target = ((0.75, 0.5), (0.25, 0.5))[team] if env.has_walls else (0.0, 0.0)
    map_size = jnp.array([env.map_width, env.map_height])
    initial = HeuristicPolicyState(
        default_target=jnp.tile(jnp.array(target) * map_size, (units, 1)),
        last_attacked_enemy=jnp.full((units,), -1, jnp.int32),
    )

    n_features = len(env.unit_features)
    first, last = (units - 1) * n_features, (units - 1 + opponents) * n_features

    def walk_round(key, policy_state, obs):
        own = obs[last:]
        position = own[1:3] * map_size
        sight = env.unit_type_sight_ranges[own[4:].argmax()]
        seen = rearrange(obs[first:last], "(m f) -> m f", f=n_features)
        hidden = jax.vmap(env.hidden, in_axes=(None, 0))(position, position + sight * seen[:, 1:3])
        seen = jnp.where(hidden[:, None], 0.0, seen)
        obs = jnp.concatenate([obs[:first], rearrange(seen, "m f -> (m f)"), own])
        action, policy_state = heuristic(key, policy_state, obs)
        return env.detour(position, action), policy_state

    act = jax.vmap(walk_round if env.has_walls else heuristic)

    def policy(key, policy_state, obs):
        return act(jax.random.split(key, units), policy_state, obs)

    return initial, policy
