"""What a train sees of a railway: a tree of the branches ahead, after the MAMBA code's observation.

A node is a cell that a train is on together with its heading, `4 * cell + heading`; cells are
numbered row by row, headings are north, east, south, west.
"""

from collections.abc import Sequence
from math import copysign, inf, log1p
from typing import NamedTuple

import numpy as np

DEPTH = 3
"""Branches ahead of a train, one after the other."""
EDGES = 2 ** (DEPTH + 1) - 2
ROOT_FEATURES, EDGE_FEATURES = 9, 14
GAINED = 4
"""Where an edge tells by how much the target is nearer at its first cell."""
FEATURES = ROOT_FEATURES + EDGES * EDGE_FEATURES
"""Length of an observation: 205."""
FAR = 100.0
"""Cells beyond which it does not matter how far; what is not there is as far."""

LEFT, FORWARD, RIGHT = 1, 2, 3
"""The simulator's actions that move a train."""


class Exit(NamedTuple):
    """A way on from a node."""

    action: int
    """The simulator's action that takes it."""
    node: int


class Branch(NamedTuple):
    """All nodes from one to the next at which there is a choice, both included."""

    nodes: list[int]
    offset: dict[int, int]
    """Of each of its cells."""
    exits: list[Exit]
    """At its end."""
    unusable: float
    """Offset of the first cell that is a switch for other headings only; infinite without."""


class Train(NamedTuple):
    """Where a train is; `node` is its start as long as it is not on the rails."""

    node: int
    on_rails: bool
    deadlocked: bool
    broken: bool
    ready: bool
    """Not departed yet."""
    distance: Sequence[float]
    """To its target, from every node."""
    luck: float
    """A number of its own in this episode."""


class Rails:
    """One map, as a graph."""

    def __init__(self, grid: np.ndarray):
        """`grid` `[rows, columns]`: which exits the 16 bits of a cell allow to each heading."""
        self.rows, self.columns = grid.shape
        self._step = (-self.columns, 1, self.columns, -1)
        self.exits: dict[int, list[Exit]] = {}
        for cell in np.flatnonzero(grid).tolist():
            bits = int(grid.flat[cell])
            for heading in range(4):
                self.exits[4 * cell + heading] = self._exits_of(cell, heading, bits)
        self._switches = {node // 4 for node, exits in self.exits.items() if len(exits) > 1}
        self._branches: dict[int, Branch] = {}

    def _exits_of(self, cell: int, heading: int, bits: int) -> list[Exit]:
        allowed = bits >> (12 - 4 * heading) & 15
        can = [bool(allowed >> (3 - out) & 1) for out in range(4)]
        found = [
            Exit(action, 4 * (cell + self._step[out]) + out)
            for action, turn in ((LEFT, -1), (FORWARD, 0), (RIGHT, 1))
            if can[out := (heading + turn) % 4]
        ]
        back = (heading + 2) % 4
        if not found and can[back]:  # a dead end
            found = [Exit(FORWARD, 4 * (cell + self._step[back]) + back)]
        return found

    def is_switch(self, node: int) -> bool:
        """Whether a train has a choice there."""
        return len(self.exits[node]) > 1

    def is_near_decision(self, node: int) -> bool:
        """Whether the only cell ahead is a switch, for this train or for others."""
        exits = self.exits[node]
        return len(exits) == 1 and exits[0].node // 4 in self._switches

    def branch(self, node: int) -> Branch:
        """The branch that begins at a node."""
        if node not in self._branches:
            self._branches[node] = self._follow(node)
        return self._branches[node]

    def _follow(self, node: int) -> Branch:
        nodes, seen, unusable = [node], {node}, inf
        while len(exits := self.exits.get(nodes[-1], [])) == 1:
            if nodes[-1] // 4 in self._switches:
                unusable = min(unusable, len(nodes) - 1)
            if exits[0].node in seen:
                break
            nodes.append(exits[0].node)
            seen.add(nodes[-1])
        offset: dict[int, int] = {}
        for k, each in enumerate(nodes):
            offset.setdefault(each // 4, k)
        return Branch(nodes, offset, exits, unusable)


def deadlocked(rails: Rails, trains: Sequence[Train]) -> set[int]:
    """Trains that can never move again: each way on is held by another of them."""
    at = {train.node // 4: i for i, train in enumerate(trains) if train.on_rails}
    stuck = set(at.values())
    while True:
        free = {
            i
            for i in stuck
            if any(at.get(way.node // 4) not in stuck for way in rails.exits[trains[i].node])
        }
        if not free:
            return stuck
        stuck -= free


def observe(rails: Rails, trains: Sequence[Train]) -> np.ndarray:
    """Observations `[N, 205]`; booleans are 1 and -1, distances log(1 + cells) / 2, 2.3 at most.

    Of the train (9): row and column as shares of the map, its luck, deadlocked, not broken,
    distance to its target, on a switch, near a decision, ready to depart.

    Of each of the 2 + 4 + 8 edges (14; zeros and a -1 where there is none): is there; distances to
    the first other train, to the end, and to the first switch that is none for this train; by how
    much the distance to the target falls to the edge's first cell, and to its last; one, and two,
    trains that go the same way; one, and two, that do not; one of these with a higher number;
    whether the first train goes the same way, and whether its number is higher (0 without a train);
    a deadlocked one.
    """
    out = np.zeros((len(trains), FEATURES), np.float32)
    for i, train in enumerate(trains):
        out[i] = _Tree(rails, trains, i).features(train)
    return out


class _Tree:
    """One train's observation."""

    def __init__(self, rails: Rails, trains: Sequence[Train], me: int):
        self._rails, self._me = rails, me
        self._others = [
            (train.node // 4, train.node % 4, i, train.deadlocked)
            for i, train in enumerate(trains)
            if train.on_rails and i != me
        ]

    def features(self, train: Train) -> list[float]:
        """Root, then edges level by level."""
        rails, node = self._rails, train.node
        self._distance = train.distance
        self._here = train.distance[node]
        row, column = divmod(node // 4, rails.columns)
        values = [
            row / rails.rows,
            column / rails.columns,
            train.luck,
            _sign(train.deadlocked),
            _sign(not train.broken),
            _near(self._here),
            _sign(rails.is_switch(node)),
            _sign(rails.is_near_decision(node)),
            _sign(train.ready),
        ]
        level: list[tuple[int, int] | None] = _two([(way.node, 1) for way in rails.exits[node]])
        for _ in range(DEPTH):
            below: list[tuple[int, int] | None] = []
            for edge in level:
                if edge is None:
                    values += _NOTHING
                    below += [None, None]
                    continue
                branch = rails.branch(edge[0])
                values += self._edge(branch, edge[1])
                end = edge[1] + len(branch.nodes)
                forks = branch.exits if len(branch.exits) > 1 else []
                below += _two([(way.node, end) for way in forks])
            level = below
        return values

    def _edge(self, branch: Branch, before: int) -> list[float]:
        """Features of a branch whose first cell is `before` cells away."""
        first, same, against, higher, stuck = (inf, 0, False), 0, 0, False, False
        for cell, heading, other, is_stuck in self._others:
            offset = branch.offset.get(cell)
            if offset is None:
                continue
            along = branch.nodes[offset] % 4 == heading
            same, against = same + along, against + (not along)
            higher |= not along and other > self._me
            stuck |= is_stuck
            first = min(first, (offset, other, along))
        offset, other, along = first
        met = offset < inf
        return [
            1.0,
            _near(before + offset),
            _near(before + len(branch.nodes) - 1),
            _near(before + branch.unusable),
            self._fall(branch.nodes[0]),
            self._fall(branch.nodes[-1]),
            _sign(same >= 1),
            _sign(same >= 2),
            _sign(against >= 1),
            _sign(against >= 2),
            _sign(higher),
            _sign(along) if met else 0.0,
            _sign(other > self._me) if met else 0.0,
            _sign(stuck),
        ]

    def _fall(self, node: int) -> float:
        """By how much the target is nearer there than here."""
        there = self._distance[node]
        if there == inf:
            return -_near(inf)
        return copysign(_near(abs(self._here - there)), self._here - there)


_NOTHING = [-1.0] + [0.0] * (EDGE_FEATURES - 1)


def _two(ways: list[tuple[int, int]]) -> list[tuple[int, int] | None]:
    """The first two, or nothing in their place."""
    return [*ways[:2], *[None] * (2 - len(ways))]


def _near(distance: float) -> float:
    """A cell counts much where distances are small, and little where they are great."""
    return log1p(min(distance, FAR)) / 2


def _sign(truth: bool) -> float:
    return 1.0 if truth else -1.0
