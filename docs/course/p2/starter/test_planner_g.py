"""Additional requirements of the planner, for graduates: `python -m pytest` in your folder."""

import numpy as np
import pytest
from planner import length_m
from planner_g import curve, minimum_snap, rrt_star, smooth, timed
from test_planner import DOOR, GOAL_M, HIGH_M, LOW_M, MARGIN_M, START_M, WALL, least_room_m, room_with, shortest_m

POINTS_M = np.array([[0, 0, 1], [1, 0.5, 1], [2, -0.5, 1.5], [3.5, 0, 1]], float)
SECONDS = np.array([1.5, 1.0, 2.0])
THROUGH_M = np.array([START_M, [2.5, 1.2, 1], [3.5, 1.2, 1], GOAL_M])


def grow(boxes, nodes, seed=0):
    return rrt_star(room_with(boxes), START_M, GOAL_M, LOW_M, HIGH_M, nodes=nodes, seed=seed, margin_m=MARGIN_M)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_tree_finds_the_door(seed):
    """So far fails: the straight line leads through the wall."""
    path_m = grow(DOOR, 1000, seed)
    np.testing.assert_allclose(path_m[[0, -1]], [START_M, GOAL_M])
    assert least_room_m(room_with(DOOR), path_m) > MARGIN_M - 1e-4
    # Without rewiring, the path is at least 1.5 times as long.
    assert shortest_m() - 1e-3 < length_m(path_m) < 1.25 * shortest_m()


def test_a_tree_that_grows_makes_no_way_longer():
    lengths_m = [length_m(grow(DOOR, nodes)) for nodes in (500, 700, 1000)]
    assert lengths_m == sorted(lengths_m, reverse=True)


def test_the_same_seed_is_the_same_tree():
    np.testing.assert_array_equal(grow(DOOR, 500), grow(DOOR, 500))


def test_no_tree_is_none():
    """So far fails: a wall without a door; a start in the wall."""
    assert grow(WALL, 300) is None
    room = room_with(DOOR)
    assert rrt_star(room, np.array([3.0, -1, 1]), GOAL_M, LOW_M, HIGH_M, nodes=300, margin_m=MARGIN_M) is None


def test_one_piece_from_rest_to_rest():
    """So far fails. (6) has one solution here: 35 s^4 - 84 s^5 + 70 s^6 - 20 s^7."""
    share = np.linspace(0, 1, 11)
    coefficients = minimum_snap(np.array([[0.0, 0, 0], [1, 2, 0]]), np.array([2.0]))
    expected = share**4 * (35 - 84 * share + 70 * share**2 - 20 * share**3)
    np.testing.assert_allclose(
        curve(np.array([2.0]), coefficients, 2 * share), expected[:, None] * [1, 2, 0], atol=1e-8
    )


def test_the_polynomials_go_through_the_points():
    found_m = curve(SECONDS, minimum_snap(POINTS_M, SECONDS), np.array([0.0, 1.5, 2.5, 4.5]))
    np.testing.assert_allclose(found_m, POINTS_M, atol=1e-7)


def test_they_begin_and_end_at_rest():
    """So far fails: the lines begin at full speed."""
    coefficients = minimum_snap(POINTS_M, SECONDS)
    for derivative in (1, 2, 3):
        np.testing.assert_allclose(curve(SECONDS, coefficients, np.array([0.0, 4.5]), derivative), 0, atol=1e-6)


@pytest.mark.parametrize("derivative", [1, 2, 3, 4, 5, 6])
def test_pieces_meet_in_every_derivative(derivative):
    """So far fails in the first derivative. (6) requires the first four; minimum snap implies the fifth and sixth."""
    coefficients = minimum_snap(POINTS_M, SECONDS)
    for piece, joint_s in enumerate(np.cumsum(SECONDS)[:-1]):
        before = curve(SECONDS[piece:], coefficients[piece:], np.array([SECONDS[piece] - 1e-9]), derivative)
        after = curve(SECONDS, coefficients, np.array([joint_s]), derivative)
        np.testing.assert_allclose(before, after, rtol=1e-4, atol=1e-4)


def test_limits_are_kept_and_used():
    """So far fails: the corners are not flown."""
    seconds, coefficients = timed(POINTS_M, 2.0, 3.0)
    at_s = np.linspace(0, seconds.sum(), 2000)
    mps, mps2 = (np.linalg.norm(curve(seconds, coefficients, at_s, derivative), axis=1) for derivative in (1, 2))
    assert mps[0] < 1e-6 and mps[-1] < 1e-6
    assert mps.max() < 2.0 * 1.02 and mps2.max() < 3.0 * 1.02
    assert mps.max() > 0.9 * 2.0 or mps2.max() > 0.9 * 3.0


def test_the_whole_curve_is_free():
    """So far fails: there is no curve."""
    seconds, coefficients = smooth(room_with(DOOR), THROUGH_M, margin_m=MARGIN_M, max_mps=2.0, max_mps2=3.0)
    at_s = np.linspace(0, seconds.sum(), 5000)
    assert room_with(DOOR)(curve(seconds, coefficients, at_s)).min() > MARGIN_M
    change_mps = np.diff(curve(seconds, coefficients, at_s, 1), axis=0)
    assert np.linalg.norm(change_mps, axis=1).max() < 3.0 * 1.02 * (at_s[1] - at_s[0]) + 1e-6
    np.testing.assert_allclose(curve(seconds, coefficients, at_s[[0, -1]]), THROUGH_M[[0, -1]], atol=1e-6)


def test_what_does_not_fit_is_none():
    """So far fails: the curve is not checked."""
    assert smooth(room_with(WALL), np.array([START_M, GOAL_M]), margin_m=MARGIN_M, max_mps=2.0, max_mps2=3.0) is None
