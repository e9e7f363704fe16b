"""Pictures of SMAX battles: units and their health, shots, and how far allies see and reach."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

if TYPE_CHECKING:
    from mabl.envs.smax import SmaxEnv, SmaxState

PICTURES = 4
"""Of a joint step: between its two ends, units are drawn on straight lines."""
SCALE = 20
"""Pixels of a map unit."""
FINER = 2
"""Everything is drawn so much larger and shrunk, for smooth edges."""
HEADER = 40
"""Pixels above the map."""

GROUND, BORDER, WALL, TEXT = "#1d2430", "#3a4658", "#566378", "#e8edf4"
TEAMS = ("#4aa8ff", "#ff7a59")
SHOTS = ("#bfe0ff", "#ffd9a8")
HEALTH, HEALTH_LOST, VISION, REACH = "#5fd068", "#7a2e2e", "#263143", "#3d6f9f"

LABELS = {
    "marine": "Ma",
    "marauder": "Md",
    "stalker": "St",
    "zealot": "Ze",
    "zergling": "Zl",
    "hydralisk": "Hy",
    "spine crawler": "Sc",
}


class Units(NamedTuple):
    """Where U units are and how they are, as numpy arrays."""

    position: np.ndarray
    health: np.ndarray
    alive: np.ndarray


class SmaxDrawing:
    """Draws one environment's battles."""

    frames_per_second = 16.0

    def __init__(self, env: "SmaxEnv"):
        game = self._game = env.game
        self._limit, self._name = env.spec.episode_limit, env.spec.name
        self._size = int(game.map_width * SCALE), int(game.map_height * SCALE)
        self._labels = [LABELS.get(name, name[:2]) for name in game.unit_type_names]
        self._radius, self._sight, self._reach, self._full = (
            np.asarray(each)
            for each in (
                game.unit_type_radiuses,
                game.unit_type_sight_ranges,
                game.unit_type_attack_ranges,
                game.unit_type_health,
            )
        )
        self._is_ally = np.arange(game.num_agents) < game.num_allies

    def frames(self, before: "SmaxState | None", after: "SmaxState") -> Iterator[np.ndarray]:
        """`[height, width, 3]` uint8: what happened in a joint step, or how a battle begins."""
        new: Any = jax.device_get(after.game)
        if before is None:
            yield self._picture(new, _units(new), [])
            return
        old: Any = jax.device_get(before.game)
        shots, start, end = self._shots(old, new), _units(old), _units(new)
        for part in np.arange(1, PICTURES + 1) / PICTURES:
            between = Units(
                start.position + part * (end.position - start.position),
                start.health + part * (end.health - start.health),
                end.alive if part == 1 else start.alive,
            )
            yield self._picture(new, between, shots if part < 1 else [])

    def _shots(self, old: Any, new: Any) -> list[tuple[int, int]]:
        """Who fired in a joint step, and at whom: a shot sets the weapon's cooldown."""
        game = self._game
        passed = game.time_per_step * game.world_steps_per_env_step
        fired = new.unit_weapon_cooldowns > old.unit_weapon_cooldowns - passed + 1e-4
        order = new.prev_attack_actions - game.num_movement_actions
        # Enemies count the allies from the last one on.
        target = np.where(self._is_ally, game.num_allies + order, game.num_allies - 1 - order)
        return [(i, int(target[i])) for i in np.flatnonzero(fired & (order >= 0))]

    def _picture(self, state: Any, units: Units, shots: list[tuple[int, int]]) -> np.ndarray:
        width, height = self._size
        image = Image.new("RGB", (width * FINER, (height + HEADER) * FINER), GROUND)
        pen = _Pen(ImageDraw.Draw(image), height)
        types = state.unit_types
        for i in np.flatnonzero(units.alive & self._is_ally):
            pen.circle(units.position[i], self._sight[types[i]], fill=VISION)
        for low, high in zip(self._game.wall_low, self._game.wall_high, strict=True):
            pen.box(np.asarray(low), np.asarray(high), WALL)
        for i in np.flatnonzero(units.alive & self._is_ally):
            pen.circle(units.position[i], self._reach[types[i]], outline=REACH)
        for i in np.flatnonzero(~units.alive):
            pen.cross(units.position[i], 0.6 * self._radius[types[i]], TEAMS[not self._is_ally[i]])
        for i in np.flatnonzero(units.alive):
            kind = types[i]
            label = self._labels[kind]
            pen.unit(units.position[i], self._radius[kind], TEAMS[not self._is_ally[i]], label)
            pen.bar(units.position[i], self._radius[kind], units.health[i] / self._full[kind])
        for i, target in shots:
            pen.line(units.position[i], units.position[target], SHOTS[not self._is_ally[i]])
        pen.draw.rectangle((0, 0, width * FINER, HEADER * FINER), fill=BORDER)
        pen.header(self._says(state, units), width)
        return np.asarray(image.resize((width, height + HEADER), Image.Resampling.BOX))

    def _says(self, state: Any, units: Units) -> tuple[str, str, str]:
        """Allies, the clock and who has won, and enemies."""
        teams, types = [], state.unit_types
        for mine in (self._is_ally, ~self._is_ally):
            share = units.health[mine].clip(0).sum() / self._full[types[mine]].sum()
            teams.append(f"{units.alive[mine].sum()} of {mine.sum()}, health {share:.0%}")
        allies, enemies = units.alive[self._is_ally].any(), units.alive[~self._is_ally].any()
        clock = f"{self._name}   step {int(state.step)} of {self._limit}"
        if not enemies or not allies:
            clock += "   won" if allies else "   lost"
        return f"allies {teams[0]}", clock, f"enemies {teams[1]}"


class _Pen:
    """Draws in map units, y upwards."""

    def __init__(self, draw: ImageDraw.ImageDraw, height: int):
        self.draw, self._height = draw, height

    def at(self, position: np.ndarray) -> tuple[float, float]:
        """In pixels of the finer picture."""
        x, y = position * SCALE
        return float(x * FINER), float((self._height - y + HEADER) * FINER)

    def circle(self, position: np.ndarray, radius: Any, **style: Any) -> None:
        """A circle; its line is two pixels wide before shrinking."""
        x, y = self.at(position)
        r = float(radius) * SCALE * FINER
        self.draw.ellipse((x - r, y - r, x + r, y + r), width=FINER, **style)

    def box(self, low: np.ndarray, high: np.ndarray, colour: str) -> None:
        """A wall."""
        (left, bottom), (right, top) = self.at(low), self.at(high)
        self.draw.rectangle((left, top, right, bottom), fill=colour)

    def line(self, start: np.ndarray, end: np.ndarray, colour: str) -> None:
        """A shot."""
        self.draw.line((*self.at(start), *self.at(end)), fill=colour, width=2 * FINER)

    def cross(self, position: np.ndarray, size: Any, colour: str) -> None:
        """Where somebody died."""
        x, y = self.at(position)
        r = float(size) * SCALE * FINER
        for sign in (1, -1):
            self.draw.line((x - r, y - sign * r, x + r, y + sign * r), fill=colour, width=FINER)

    def unit(self, position: np.ndarray, radius: Any, colour: str, label: str) -> None:
        """A disc that says what it is."""
        self.circle(position, radius, fill=colour, outline=GROUND)
        font = ImageFont.load_default(size=float(radius) * SCALE * FINER)
        self.draw.text(self.at(position), label, fill=GROUND, font=font, anchor="mm")

    def bar(self, position: np.ndarray, radius: Any, share: Any) -> None:
        """Health, above a unit."""
        x, y = self.at(position)
        r = float(radius) * SCALE * FINER
        y -= r + 4 * FINER
        left, right = x - r, x + r
        middle = left + (right - left) * float(np.clip(share, 0, 1))
        self.draw.rectangle((left, y - 2 * FINER, right, y + FINER), fill=HEALTH_LOST)
        if middle > left:
            self.draw.rectangle((left, y - 2 * FINER, middle, y + FINER), fill=HEALTH)

    def header(self, says: tuple[str, str, str], width: int) -> None:
        """Left, middle and right above the map."""
        font, y = ImageFont.load_default(size=14 * FINER), HEADER * FINER / 2
        places = (10, "lm", TEAMS[0]), (width / 2, "mm", TEXT), (width - 10, "rm", TEAMS[1])
        for text, (x, anchor, colour) in zip(says, places, strict=True):
            self.draw.text((x * FINER, y), text, fill=colour, font=font, anchor=anchor)


def _units(state: Any) -> Units:
    return Units(state.unit_positions, state.unit_health, state.unit_alive)
