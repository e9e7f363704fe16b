"""The railway as a graph and the tree that trains see of it, on maps small enough to draw."""

from math import inf, log

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mabl.envs.rails import (
    EDGE_FEATURES,
    FEATURES,
    FORWARD,
    LEFT,
    RIGHT,
    ROOT_FEATURES,
    Rails,
    Train,
    deadlocked,
    observe,
)

NORTH, EAST, SOUTH, WEST = range(4)


def cell(*ways):
    """Bits of a cell in which a train that heads for the first may leave for the second."""
    return sum(1 << (15 - 4 * heading - out) for heading, out in ways)


STRAIGHT = cell((EAST, EAST), (WEST, WEST))
END_EAST = cell((EAST, WEST))
END_WEST = cell((WEST, EAST))
# From the west one may go on east or turn north; from the east or the north, only west.
FORK = cell((EAST, EAST), (EAST, NORTH), (WEST, WEST), (SOUTH, WEST))
UP = cell((NORTH, NORTH), (SOUTH, SOUTH))
TOP = cell((NORTH, SOUTH))

#      0  1  2  3  4  5  6
# 0             T
# 1             |
# 2    E--------F--------E
GRID = np.zeros((3, 7), np.uint16)
GRID[2] = [END_WEST, STRAIGHT, STRAIGHT, FORK, STRAIGHT, STRAIGHT, END_EAST]
GRID[0, 3], GRID[1, 3] = TOP, UP
RAILS = Rails(GRID)


def at(row, column, heading):
    return 4 * (7 * row + column) + heading


def distances(rails, target):
    """To a cell, from every node, by searching backwards."""
    distance = [inf] * (4 * rails.rows * rails.columns)
    for heading in range(4):
        distance[4 * target + heading] = 0
    changed = True
    while changed:
        changed = False
        for node, exits in rails.exits.items():
            best = min((distance[way.node] + 1 for way in exits), default=inf)
            if best < distance[node]:
                distance[node], changed = best, True
    return distance


def train(row, column, heading, target=(2, 6), **changes):
    distance = distances(RAILS, 7 * target[0] + target[1])
    given = dict(on_rails=True, deadlocked=False, broken=False, ready=False, luck=0.25)
    return Train(at(row, column, heading), distance=distance, **(given | changes))


def edges(vector):
    """The 14 edges of one observation."""
    return vector[ROOT_FEATURES:].reshape(-1, EDGE_FEATURES)


def test_ways_on():
    assert RAILS.exits[at(2, 1, EAST)] == [(FORWARD, at(2, 2, EAST))]
    assert RAILS.exits[at(2, 3, EAST)] == [(LEFT, at(1, 3, NORTH)), (FORWARD, at(2, 4, EAST))]
    assert RAILS.exits[at(2, 3, SOUTH)] == [(RIGHT, at(2, 2, WEST))]
    assert RAILS.exits[at(2, 6, EAST)] == [(FORWARD, at(2, 5, WEST))]  # a dead end: back
    assert RAILS.exits[at(2, 1, NORTH)] == []


def test_where_there_is_something_to_decide():
    assert RAILS.is_switch(at(2, 3, EAST)) and not RAILS.is_switch(at(2, 3, WEST))
    assert RAILS.is_near_decision(at(2, 2, EAST))
    assert RAILS.is_near_decision(at(2, 4, WEST))  # a switch, though for others
    assert not RAILS.is_near_decision(at(2, 1, EAST))
    assert not RAILS.is_near_decision(at(2, 3, EAST))


def test_branches_reach_from_choice_to_choice():
    branch = RAILS.branch(at(2, 1, EAST))
    assert branch.nodes == [at(2, 1, EAST), at(2, 2, EAST), at(2, 3, EAST)]
    assert len(branch.exits) == 2 and branch.unusable == inf
    # West of the fork, around the dead end and back to it.
    branch = RAILS.branch(at(2, 4, WEST))
    assert [node % 4 for node in branch.nodes] == [WEST] * 5 + [EAST] * 3
    assert branch.nodes[-1] == at(2, 3, EAST) and branch.unusable == 1
    assert branch.offset[7 * 2 + 3] == 1  # met first on the way west


def test_a_circle_without_a_choice_ends_where_it_began():
    ring = np.zeros((2, 2), np.uint16)
    ring[0, 0], ring[0, 1] = cell((NORTH, EAST), (WEST, SOUTH)), cell((EAST, SOUTH), (NORTH, WEST))
    ring[1, 0], ring[1, 1] = cell((WEST, NORTH), (SOUTH, EAST)), cell((SOUTH, WEST), (EAST, NORTH))
    branch = Rails(ring).branch(EAST + 4 * 1)
    assert len(branch.nodes) == 4 and len(branch.exits) == 1


def near(cells):
    """How distances are told."""
    return log(1 + cells) / 2


FAR = near(100)


def test_the_root_says_where_the_train_is():
    one = observe(RAILS, [train(2, 2, EAST, broken=True)])
    assert one.shape == (1, FEATURES)
    # row 2 of 3, column 2 of 7, luck, not deadlocked, broken, 4 cells to go, no switch, near one
    assert_allclose(one[0, :9], [2 / 3, 2 / 7, 0.25, -1, -1, near(4), -1, 1, -1], rtol=1e-6)
    assert observe(RAILS, [train(2, 3, EAST, ready=True)])[0, 6] == 1
    assert observe(RAILS, [train(2, 3, EAST, ready=True)])[0, 8] == 1
    assert observe(RAILS, [train(2, 3, EAST, deadlocked=True)])[0, 3] == 1


def test_edges_of_a_train_alone():
    vector = observe(RAILS, [train(2, 2, EAST)])[0]
    tree = edges(vector)
    # One cell to the fork, where the target is 3 cells away, 1 nearer than from here.
    alone = [-1.0, -1, -1, -1, -1, 0, 0, -1]
    assert_allclose(tree[0], [1, FAR, near(1), FAR, near(1), near(1), *alone], rtol=1e-5)
    assert_array_equal(tree[1], [-1] + [0] * 13)  # no second way on
    # Going north from the fork: 2 cells away, around the top, over the fork again as the fifth cell
    # (no switch on the way down), around the western end and back to the fork as the eleventh, 3
    # from the target. So the target is 9 + 3 from (1, 3), where it is 4 from here.
    north, east = tree[2], tree[3]
    assert_allclose(north[1:6], [FAR, near(11), near(5), -near(8), near(1)], rtol=1e-5)
    assert east[0] == 1 and east[4] == pytest.approx(near(2))
    assert_array_equal(tree[4:6, 0], [-1, -1])  # below the edge that is not there
    assert_array_equal(tree[10:14, 0], [-1] * 4)


def test_edges_tell_of_other_trains():
    me = train(2, 1, EAST)
    ahead, towards = train(2, 2, EAST), train(2, 3, WEST, deadlocked=True)
    tree = edges(observe(RAILS, [me, ahead, towards])[0])
    # nearest 1 away; one the same way, one against with a higher number; the first goes the same
    # way and has a higher number; one is deadlocked
    assert_allclose(
        tree[0, [1, 6, 7, 8, 9, 10, 11, 12, 13]], [near(1), 1, -1, 1, -1, 1, 1, 1, 1], rtol=1e-5
    )
    tree = edges(observe(RAILS, [towards, me, ahead])[1])
    assert_allclose(tree[0, [1, 8, 10, 11, 12]], [near(1), 1, -1, 1, 1], rtol=1e-5)
    gone = [other._replace(on_rails=False) for other in (ahead, towards)]
    assert_array_equal(edges(observe(RAILS, [me, *gone])[0])[0], edges(observe(RAILS, [me])[0])[0])


@pytest.mark.parametrize(
    ("trains", "stuck"),
    [
        ([(2, 1, EAST), (2, 2, WEST)], {0, 1}),  # face to face
        ([(2, 1, EAST), (2, 3, WEST)], set()),  # not yet
        ([(2, 1, EAST), (2, 2, EAST)], set()),  # one behind the other
        ([(2, 4, EAST), (2, 5, WEST), (2, 3, EAST)], {0, 1}),  # the third may turn north
        ([(2, 4, EAST), (2, 5, WEST), (2, 6, EAST)], {0, 1, 2}),  # the third waits behind
    ],
)
def test_who_can_never_move_again(trains, stuck):
    assert deadlocked(RAILS, [train(*place) for place in trains]) == stuck


def test_trains_off_the_rails_hold_nobody_up():
    here, there = train(2, 1, EAST), train(2, 2, WEST, on_rails=False)
    assert deadlocked(RAILS, [here, there]) == set()
