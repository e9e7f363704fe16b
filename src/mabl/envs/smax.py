"""SMAX (jaxmarl 0.2.0): StarCraft-like battles of the allies against a built-in heuristic enemy.

A proxy for SMAC, not SMAC: no shields, armour, double hits or terrain but what the two scenarios
at the end of this list add. Results here support no claim about SMAC's numbers.
"""

import inspect
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxmarl.environments.smax import SMAX
from jaxmarl.environments.smax.heuristic_enemy import HeuristicPolicyState
from jaxmarl.environments.smax.smax_env import MAP_NAME_TO_SCENARIO, Scenario, State
from jaxtyping import Array, Float, Int

from mabl.envs.base import Discrete, Drawing, EnvSpec
from mabl.envs.smax_terrain import STOP, TerrainSMAX, Wall, attack_closest
from mabl.errors import unknown_name
from mabl.rows import TimeStep
from mabl.types import PRNGKey

OUT_OF_REACH = 2**30
"""Inner step limit; SMAX's own is off by one and sets the same flag as a battle's end."""


@dataclass(frozen=True)
class Battle:
    """One scenario: who fights, for how many joint steps, on what ground."""

    scenario: Scenario
    episode_limit: int
    """SMAC's limit for the map of the same name."""
    walls: tuple[Wall, ...] = ()
    units: Mapping[str, Any] = field(default_factory=dict)
    """Replaced `unit_type_*` arguments of SMAX; empty: its six unit types."""

    def build(self) -> TerrainSMAX:
        """The simulator of this battle."""
        return TerrainSMAX(self.walls, scenario=self.scenario, max_steps=OUT_OF_REACH, **self.units)

    @property
    def description(self) -> str:
        """One line, e.g. `3 stalkers against 4 zealots`."""
        names = self.units.get("unit_type_names", _SMAX_DEFAULTS["unit_type_names"].default)
        types, allies = np.asarray(self.scenario.unit_types), self.scenario.num_allies

        def army(types) -> str:
            if self.scenario.smacv2_unit_type_generation:
                return f"{len(types)} random units"
            counts = Counter(names[t] for t in types).items()
            return " and ".join(f"{n} {name}{'s' if n > 1 else ''}" for name, n in counts)

        ground = ", a wall with one gap between them" if self.walls else ""
        return f"{army(types[:allies])} against {army(types[allies:])}{ground}"


class SmaxState(NamedTuple):
    """Everything that a battle needs to go on."""

    game: State
    enemy_policy: HeuristicPolicyState
    enemy_obs: Float[Array, "M O"]
    """What the enemies saw on arriving here, kept so that it is computed once a step."""


class SmaxEnv:
    """The allied team as agents; the enemy attacks the closest unit.

    Observation and action order are SMAX's: 0 to 3 walk up, right, down, left, 4 stops (all that
    the dead may do), 5 + m attacks enemy m. The reward is SMAX's team reward, dead or alive: at
    most 1 for damage and 1 for the win in an episode. Score: 1 for a win, 0 otherwise, a draw
    included.

    State: per unit, allies first, (health / full health, x / width, y / height, weapon cooldown /
    longest cooldown of any unit type, one-hot unit type), zeros for the dead; then the team
    (0 or 1) of every unit; then every unit's type / (number of types - 1). All within [0, 1].
    """

    def __init__(self, name: str, battle: Battle):
        game = battle.build()
        self.game = game
        self.spec = EnvSpec(
            name=f"smax/{name}",
            n_agents=game.num_allies,
            obs_dim=game.obs_size,
            state_dim=game.state_size,
            action_space=Discrete(game.num_ally_actions),
            episode_limit=battle.episode_limit,
            score_name="win_rate",
        )
        self._enemy_start, self._enemy_act = attack_closest(game, team=1)
        self._state_scale = _state_scale(game)

    def reset(self, key: PRNGKey) -> tuple[SmaxState, TimeStep]:
        """Start a battle; its randomness is that of `HeuristicEnemySMAX.reset`."""
        _, key_game = jax.random.split(key)
        with jax.numpy_rank_promotion("allow"):  # jaxmarl relies on it
            obs, game = self.game.reset(key_game)
            return self._row(
                obs,
                game,
                self._enemy_start,
                prev_action=jnp.zeros((self.spec.n_agents,), jnp.int32),
                reward=jnp.zeros((), jnp.float32),
                is_first=True,
            )

    def step(
        self, key: PRNGKey, env_state: SmaxState, action: Int[Array, " N"]
    ) -> tuple[SmaxState, TimeStep]:
        """One joint step of 8 world steps of 1/16 s, keyed as `HeuristicEnemySMAX.step_env`."""
        key_game, key_enemy = jax.random.split(key)
        action = action.astype(jnp.int32)
        with jax.numpy_rank_promotion("allow"):
            enemy_action, enemy_policy = self._enemy_act(
                key_enemy, env_state.enemy_policy, env_state.enemy_obs
            )
            decoded = self.game._decode_discrete_actions(jnp.concatenate([action, enemy_action]))
            obs, game, reward, _, _ = self.game.step_env_no_decode(
                key_game, env_state.game, decoded
            )
            return self._row(
                obs,
                game,
                enemy_policy,
                prev_action=action,
                reward=reward[self.game.agents[0]],
                is_first=False,
            )

    def heuristic(self) -> "HeuristicAllies":
        """The enemy's own heuristic for the allied side: a baseline."""
        return HeuristicAllies(self)

    def drawing(self) -> Drawing:
        """Pictures of battles."""
        from mabl.envs.smax_drawing import SmaxDrawing

        return SmaxDrawing(self)

    def _row(
        self, obs, game: State, enemy_policy, *, prev_action, reward, is_first
    ) -> tuple[SmaxState, TimeStep]:
        n_agents, names = self.spec.n_agents, self.game.agents
        units = jnp.stack([obs[name] for name in names])
        available = self.game.get_avail_actions(game)
        alive, enemy_alive = game.unit_alive[:n_agents], game.unit_alive[n_agents:]
        over = ~(alive.any() & enemy_alive.any())
        truncated = ~over & (game.step >= self.spec.episode_limit)
        won = (alive.any() & ~enemy_alive.any()).astype(jnp.float32)
        row = TimeStep(
            prev_action=prev_action,
            reward=jnp.broadcast_to(reward, (n_agents,)),
            terminated=jnp.broadcast_to(over, (n_agents,)),
            truncated=truncated,
            obs=units[:n_agents],
            # Clipped because a weapon long unused counts its cooldown below zero without end, and
            # smacv2 may place units off the map.
            state=jnp.clip(obs["world_state"] * self._state_scale, 0.0, 1.0),
            available=jnp.stack([available[name] for name in names[:n_agents]]).astype(bool),
            alive=alive,
            is_first=jnp.asarray(is_first),
            score=jnp.where(over | truncated, won, jnp.nan),
        )
        return SmaxState(game, enemy_policy, units[n_agents:]), row


def _state_scale(game: SMAX) -> Float[np.ndarray, " S"]:
    """Factors that bring SMAX's world state, described in `SmaxEnv`, into [0, 1]."""
    # A shot sets the cooldown up to two world steps above the unit type's own.
    cooldown = float(game.unit_type_weapon_cooldowns.max()) + 2 * game.time_per_step
    unit = np.ones(len(game.own_features))
    unit[1:4] = 1 / game.map_width, 1 / game.map_height, 1 / cooldown
    teams = np.ones(game.num_agents)
    types = np.full(game.num_agents, 1 / (game.unit_type_bits - 1))
    return np.concatenate([np.tile(unit, game.num_agents), teams, types]).astype(np.float32)


class HeuristicAllies:
    """A baseline for the allied side: the enemy's own heuristic, "attack the closest"."""

    def __init__(self, env: SmaxEnv):
        self._start, self._act = attack_closest(env.game, team=0)

    def initial(self, row: TimeStep) -> HeuristicPolicyState:
        """What it remembers before a first row."""
        del row
        return self._start

    def act(
        self, memory: HeuristicPolicyState, row: TimeStep, key: PRNGKey
    ) -> tuple[HeuristicPolicyState, Int[Array, " N"]]:
        """The team's action at a row; stop wherever the heuristic's choice is unavailable."""
        memory = jax.tree.map(
            lambda old, new: jnp.where(row.is_first, new, old), memory, self._start
        )
        with jax.numpy_rank_promotion("allow"):
            action, memory = self._act(key, memory, row.obs)
        may = jnp.take_along_axis(row.available, action[:, None], axis=-1)[:, 0]
        return memory, jnp.where(may, action, STOP).astype(jnp.int32)


_SMAX_DEFAULTS = inspect.signature(SMAX).parameters
_MARINE, _MARAUDER, _STALKER, _ZEALOT, _ZERGLING, _HYDRALISK, _SPINE_CRAWLER = range(7)


def _armies(allies: list[int], enemies: list[int]) -> Scenario:
    types = jnp.array(allies + enemies, jnp.uint8)
    return Scenario(types, len(allies), len(enemies), False, False)


def _with_spine_crawler() -> dict[str, Any]:
    """SMAX's unit types and a seventh, with the damage per hit of the one pair that meets.

    StarCraft II's spine crawler: health 300, armour 2, range 7, sight 11, 25 damage (+5 against
    armoured), rooted. Its cooldown of 1.85 s is at the game's normal speed, the clock on which
    SMAX gives the stalker its 1.87 s. SMAX knows neither bonus damage nor armour (2 and, for the
    stalker, 1; both are armoured), so each hit has them worked in: 25 + 5 - 1 and 13 + 5 - 2.
    """
    crawler = {
        "velocities": 0.0,
        "attacks": 25.0 + 5.0 - 1.0,
        "attack_ranges": 7.0,
        "sight_ranges": 11.0,
        "radiuses": 0.875,
        "health": 300.0,
        "weapon_cooldowns": 1.85,
    }
    arrays = {
        f"unit_type_{what}": jnp.append(_SMAX_DEFAULTS[f"unit_type_{what}"].default, value)
        for what, value in crawler.items()
    }
    arrays["unit_type_attacks"] = arrays["unit_type_attacks"].at[_STALKER].set(13.0 + 5.0 - 2.0)
    names = {"names": "spine crawler", "shorthands": "c"}
    return arrays | {
        f"unit_type_{what}": [*_SMAX_DEFAULTS[f"unit_type_{what}"].default, value]
        for what, value in names.items()
    }


def _zealots_against_zerglings() -> dict[str, Any]:
    """SMAX's unit types, with the damage per attack of the one pair that meets in `corridor`.

    StarCraft II's zealot hits twice for 8, the zergling once for 5 less the zealot's armour of 1.
    """
    attacks = _SMAX_DEFAULTS["unit_type_attacks"].default
    return {"unit_type_attacks": attacks.at[_ZEALOT].set(2 * 8.0).at[_ZERGLING].set(5.0 - 1.0)}


# The gap is wider than one joint step of a zergling (2.1), so that nobody strides past it, and the
# wall thicker than any reach (2), so that nobody fights through it. The walls run on beyond the
# 32 x 32 map so that their nearer end is always the gap.
_GAP_WALLS = ((13.0, -32.0, 17.0, 14.5), (13.0, 17.5, 17.0, 64.0))

_SMAC_LIMITS = {
    "3m": 60,
    "8m": 120,
    "25m": 150,
    "2s3z": 120,
    "3s5z": 150,
    "5m_vs_6m": 70,
    "10m_vs_11m": 150,
    "27m_vs_30m": 180,
    "3s5z_vs_3s6z": 170,
    "3s_vs_5z": 250,
    "6h_vs_8z": 150,
    "smacv2_5_units": 200,
    "smacv2_10_units": 200,
    "smacv2_20_units": 200,
}

SCENARIOS: dict[str, Battle] = {
    **{name: Battle(MAP_NAME_TO_SCENARIO[name], limit) for name, limit in _SMAC_LIMITS.items()},
    "3s_vs_4z": Battle(_armies([_STALKER] * 3, [_ZEALOT] * 4), 200),
    "2s_vs_1sc": Battle(
        _armies([_STALKER] * 2, [_SPINE_CRAWLER]), 300, units=_with_spine_crawler()
    ),
    "corridor": Battle(
        _armies([_ZEALOT] * 6, [_ZERGLING] * 24),
        400,
        walls=_GAP_WALLS,
        units=_zealots_against_zerglings(),
    ),
}
"""Name to battle; every scenario that jaxmarl ships and three more of SMAC's maps."""


def make(name: str) -> SmaxEnv:
    """The scenario of that name, e.g. `3s_vs_4z`; `UserError` if there is none."""
    if name not in SCENARIOS:
        raise unknown_name("environment", f"smax/{name}", [f"smax/{n}" for n in SCENARIOS])
    return SmaxEnv(name, SCENARIOS[name])
