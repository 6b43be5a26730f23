"""Tests of primitives.py, without images and without a flight."""

import numpy as np
import primitives

ZERO, GOAL_M = np.zeros(2), np.array([30.0, 0.0])


def at_speed(speed_mps, p_m=ZERO):
    return primitives.Motion.seen(np.asarray(p_m, float), np.array([speed_mps, 0.0]), ZERO)


def trunks(*centres_m, radius_m=0.2):
    """Returns the clearance of a body of 0.12 m among trunks, up to 1.2 m."""

    def room_m(p_m):
        away_m = [np.hypot(*np.moveaxis(p_m - np.array(centre), -1, 0)) - radius_m for centre in centres_m]
        return np.min([*away_m, np.full(p_m.shape[:-1], 1.2)], axis=0) - 0.12

    return room_m


def test_a_vehicle_gets_to_what_is_asked_and_not_at_once():
    motion = at_speed(0.0)
    for _ in range(5):
        motion = motion.after(np.array([4.0, 0.0]), 0.1)
    assert 0.2 < motion.v_mps[0] < 1.5
    for _ in range(60):
        motion = motion.after(np.array([4.0, 0.0]), 0.1)
    np.testing.assert_allclose(motion.v_mps, [4.0, 0.0], atol=0.05)


def test_nothing_in_the_way_is_straight_on_and_fast():
    """So far fails: it flies straight, but at most at 1 m/s."""
    velocity_mps, way_m = primitives.best(at_speed(6.0), GOAL_M, 8.0, trunks((50.0, 50.0)))
    assert velocity_mps[0] > 7.5 and abs(velocity_mps[1]) < 0.9
    assert way_m.shape == (primitives.STEPS, 2) and way_m[-1, 0] > 12.0 and abs(way_m[-1, 1]) < 0.5


def test_a_trunk_in_the_way_is_passed_without_a_touch():
    """So far fails: it flies too slowly."""
    for side_m in (-0.05, 0.05):
        room_m = trunks((8.0, side_m))
        velocity_mps, way_m = primitives.best(at_speed(6.0), GOAL_M, 8.0, room_m)
        assert room_m(way_m).min() >= 0.1 and way_m[-1, 0] > 10.0
        assert velocity_mps[1] * side_m < 0.0, "away from the side on which the trunk stands"


def test_a_gap_between_trunks_is_taken_in_its_middle():
    """So far fails: it flies straight and ignores the trunks."""
    room_m = trunks((9.0, -1.4), (9.0, -0.1), (9.0, 1.8), (9.0, 3.0))
    _, way_m = primitives.best(at_speed(5.0), GOAL_M, 7.0, room_m)
    assert room_m(way_m).min() > 0.35
    assert 0.5 < np.interp(9.0, way_m[:, 0], way_m[:, 1]) < 1.2


def test_before_a_wall_it_brakes():
    wall = trunks(*[(7.0, y) for y in np.arange(-15.0, 15.1, 0.3)])
    velocity_mps, _ = primitives.best(at_speed(5.0), GOAL_M, 8.0, wall)
    assert np.hypot(*velocity_mps) < 3.0
