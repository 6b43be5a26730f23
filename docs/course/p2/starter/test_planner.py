"""Requirements of project 2's planner, in rooms made of boxes: `python -m pytest` in your folder. Add your own tests.

Tests marked "so far fails" pass with a correct solution.
"""

from itertools import pairwise

import numpy as np
import pytest
from planner import astar, is_free, length_m, shorten

BODY_M, MARGIN_M = 0.12, 0.1
LOW_M, HIGH_M = np.array([0.0, -2.0, 0.0]), np.array([6.0, 2.0, 3.0])
START_M, GOAL_M = np.array([1.0, -1.0, 1.0]), np.array([5.0, -1.0, 1.0])
# A wall across the net, and one with a door 2 m high.
WALL = [([2.9, -2.0, 0.0], [3.1, 2.0, 3.0])]
DOOR = [
    ([2.9, -2.0, 0.0], [3.1, 0.6, 3.0]),
    ([2.9, 1.8, 0.0], [3.1, 2.0, 3.0]),
    ([2.9, 0.6, 2.0], [3.1, 1.8, 3.0]),
]


def distance_m(points_m, low_m, high_m):
    """Returns the distance of points (N, 3) from a box, negative inside: shape (N,)."""
    off_m = np.maximum(np.subtract(low_m, points_m), np.subtract(points_m, high_m))
    return np.linalg.norm(np.maximum(off_m, 0), axis=1) + np.minimum(off_m.max(axis=1), 0)


def room_with(boxes):
    """Returns a room: the net with boxes in it."""

    def room(points_m):
        solids_m = [distance_m(points_m, low_m, high_m) for low_m, high_m in boxes]
        return np.min([*solids_m, -distance_m(points_m, LOW_M, HIGH_M)], axis=0) - BODY_M

    return room


def least_room_m(room, path_m):
    """Returns the smallest clearance on a path, sampled at every millimetre."""
    found_m = []
    for from_m, to_m in pairwise(path_m):
        found_m.append(room(np.linspace(from_m, to_m, 2 + int(1000 * np.linalg.norm(to_m - from_m)))).min())
    return min(found_m)


def shortest_m():
    """Returns the length of the shortest path through the door: three lines, with an arc at each of two edges."""
    along_m, across_m, radius_m = 1.9, 1.6, BODY_M + MARGIN_M
    away_m = np.hypot(along_m, across_m)
    turn_rad = np.arctan2(across_m, along_m) + np.arcsin(radius_m / away_m)
    return 2 * (np.sqrt(away_m**2 - radius_m**2) + radius_m * turn_rad) + 0.2


def plan(boxes, start_m=START_M, goal_m=GOAL_M):
    return astar(room_with(boxes), start_m, goal_m, LOW_M, HIGH_M, spacing_m=0.2, margin_m=MARGIN_M)


def test_a_segment_with_room_is_free():
    assert is_free(room_with([]), START_M, GOAL_M, MARGIN_M)


def test_a_segment_that_ends_in_something_is_not_free():
    assert not is_free(room_with(WALL), START_M, np.array([3.0, 0.0, 1.0]), MARGIN_M)
    assert not is_free(room_with(WALL), np.array([3.0, 0.0, 1.0]), START_M, MARGIN_M)


def test_no_segment_through_something_is_free():
    """So far fails: obstacles between the ends are ignored. Find thin posts, but do not reject free segments."""
    random, half_m = np.random.default_rng(1), np.array([0.01, 0.01, 1.0])
    missed, denied = [], []
    for _ in range(300):
        post_m = random.uniform(LOW_M + 0.5, HIGH_M - 0.5)
        room = room_with([(post_m - half_m, post_m + half_m)])
        ends_m = random.uniform(LOW_M + 0.3, HIGH_M - 0.3, (2, 3))
        least_m, said = least_room_m(room, ends_m), is_free(room, ends_m[0], ends_m[1], MARGIN_M)
        missed += [least_m] if said and least_m <= MARGIN_M - 1e-4 else []
        denied += [least_m] if not said and least_m > MARGIN_M + 0.02 else []
    assert (missed, denied) == ([], [])


def test_where_nothing_stands_it_goes_nearly_straight():
    path_m = plan([])
    np.testing.assert_allclose(path_m[[0, -1]], [START_M, GOAL_M])
    assert length_m(path_m) < 1.15 * length_m(np.array([START_M, GOAL_M]))


def test_a_wall_is_passed_by_its_door():
    """So far fails: the straight line leads through the wall."""
    path_m = plan(DOOR)
    np.testing.assert_allclose(path_m[[0, -1]], [START_M, GOAL_M])
    assert least_room_m(room_with(DOOR), path_m) > MARGIN_M - 1e-4
    assert shortest_m() - 1e-3 < length_m(path_m) < 1.2 * shortest_m()


def test_a_goal_beside_the_grid_is_reached():
    """So far fails. Start and goal are not on grid points."""
    start_m, goal_m = START_M + np.array([0.03, -0.07, 0.01]), GOAL_M + np.array([0.11, 0.05, 0.13])
    path_m = plan(DOOR, start_m, goal_m)
    np.testing.assert_allclose(path_m[[0, -1]], [start_m, goal_m])
    assert least_room_m(room_with(DOOR), path_m) > MARGIN_M - 1e-4


def test_no_way_is_none():
    """So far fails: a wall without a door."""
    assert plan(WALL) is None


@pytest.mark.parametrize("near_m", [[2.7, -1.0, 1.0], [3.0, -1.0, 1.0], [1.0, -1.85, 1.0], [1.0, -1.0, 3.5]])
def test_a_start_or_goal_too_near_to_something_is_none(near_m):
    """So far fails: start or goal near the wall, in it, near the fence, or outside it."""
    assert plan(DOOR, start_m=np.array(near_m)) is None
    assert plan(DOOR, goal_m=np.array(near_m)) is None


def test_points_that_it_can_do_without_are_left_out():
    """So far fails: all points are kept."""
    zigzag_m = np.array([START_M, [2, -1.2, 1], [3, 1, 1], [4, -1, 2], GOAL_M])
    np.testing.assert_allclose(shorten(room_with([]), zigzag_m, MARGIN_M), [START_M, GOAL_M])


def test_what_is_shortened_stays_free():
    path_m = np.array([START_M, [1, 1.2, 1], [2, 1.2, 1], [2.5, 1.2, 1], [3.5, 1.2, 1], [5, 1.2, 1], GOAL_M])
    shorter_m = shorten(room_with(DOOR), path_m, MARGIN_M)
    np.testing.assert_allclose(shorter_m[[0, -1]], [START_M, GOAL_M])
    assert least_room_m(room_with(DOOR), shorter_m) > MARGIN_M - 1e-4
    assert shortest_m() - 1e-3 < length_m(shorter_m) <= length_m(path_m)
