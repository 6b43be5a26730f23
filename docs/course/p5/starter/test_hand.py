"""Requirements of `hand.py` of project 5, with generated hands: `python -m pytest` in your folder.

Tests marked "so far fails" pass with a correct solution. Add your own.
"""

import numpy as np
import pytest
from hand import LENGTH_M, Turning, angle_rad, blocked_rad, follow, in_plane, is_away, sigma_omega_radps, start_s

AXLE_M = np.array([1.6, 0.2, -0.5])
ROOM_M = 0.255
# Rotations in both directions: speed, first angle, first time. [rad/s], [rad], [s]
TURNS = [(0.96, 0.3, 0.0), (-0.96, 0.3, 100.0), (1.1, 3.0, 50.0), (-0.8, -3.1, 7.0)]


def hand(theta_rad, from_m=-0.08, to_m=LENGTH_M):
    """Returns points all over a hand, (N, 2) [m]: along it, and to both sides."""
    along, aside = (grid.ravel() for grid in np.meshgrid(np.linspace(from_m, to_m, 80), np.linspace(-0.03, 0.03, 7)))
    cos, sin = np.cos(theta_rad), np.sin(theta_rad)
    return np.stack([along * cos - aside * sin, along * sin + aside * cos], axis=1)


def rays(points_m, facing_rad):
    """Returns rays of any length to points in the hand's plane, (N, 3)."""
    right = np.array([np.sin(facing_rad), -np.cos(facing_rad), 0.0])
    at_m = AXLE_M + points_m[:, :1] * right + points_m[:, 1:] * [0.0, 0.0, 1.0]
    return at_m * np.random.default_rng(1).uniform(0.3, 2.0, (len(at_m), 1))


def angles(turn, seconds, sigma_rad=0.0, seed=2):
    """Returns times and noisy angles in [-pi, pi) of a hand, at 30 Hz."""
    omega_radps, theta_rad, from_s = turn
    at_s = from_s + np.arange(0.0, seconds, 1 / 30)
    noise_rad = np.random.default_rng(seed).normal(0.0, sigma_rad, len(at_s))
    return at_s, (theta_rad + omega_radps * (at_s - from_s) + noise_rad + np.pi) % (2 * np.pi) - np.pi


def off(one_rad, other_rad):
    return abs((one_rad - other_rad + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize("facing_rad", [0.0, 0.3, -0.25])
def test_rays_meet_the_plane_where_the_hand_is(facing_rad):
    """So far fails: the plane is ignored."""
    points_m = hand(1.9)
    np.testing.assert_allclose(in_plane(rays(points_m, facing_rad), AXLE_M, facing_rad), points_m, atol=1e-9)


@pytest.mark.parametrize("theta_rad", [0.0, 1.2, 2.9, -3.0, -1.4])
def test_the_angle_is_where_the_free_end_is(theta_rad):
    """So far fails: one pixel is not sufficient. The hand's other end extends beyond the axle."""
    assert off(angle_rad(hand(theta_rad)), theta_rad) < 0.02


@pytest.mark.parametrize("theta_rad", [1.2, 2.0])
def test_a_part_of_the_hand_has_its_angle(theta_rad):
    """So far fails. The image shows only a part of the hand."""
    assert off(angle_rad(hand(theta_rad, 0.1, 0.5)), theta_rad) < 0.02


@pytest.mark.parametrize("turn", TURNS)
def test_a_turning_is_followed_either_way_and_across_pi(turn):
    """So far fails: angles wrap at pi."""
    found = follow(*angles(turn, 5.0))
    assert found.omega_radps == pytest.approx(turn[0], abs=1e-6)
    assert off(found.at(turn[2] + 6.0), turn[1] + 6.0 * turn[0]) < 1e-6


@pytest.mark.parametrize("turn", TURNS)
def test_noise_is_averaged(turn):
    """So far fails: only two angles are used."""
    seconds, sigma_rad = 2.0, np.radians(3)
    found = [follow(*angles(turn, seconds, sigma_rad, seed)) for seed in range(60)]
    off_radps = np.std([one.omega_radps - turn[0] for one in found])
    # The value of (2), and the scatter of 60 samples around it.
    assert off_radps == pytest.approx(sigma_rad * np.sqrt(12 / 60) / seconds, rel=0.35)


def test_pauses_do_not_matter():
    """So far fails. The samples are not uniform; the line must fit the existing ones."""
    at_s, theta_rad = angles(TURNS[2], 6.0, np.radians(2))
    seen = (at_s < 51.0) | (at_s > 52.2)
    found = follow(at_s[seen], theta_rad[seen])
    assert found.omega_radps == pytest.approx(1.1, abs=0.01)


def test_it_is_known_how_well_it_turns():
    """So far fails: the result is infinite."""
    assert sigma_omega_radps(np.radians(3), 30, 1.0) == pytest.approx(np.radians(1.897), rel=1e-3)
    assert sigma_omega_radps(np.radians(3), 90, 3.0) == pytest.approx(np.radians(0.365), rel=2e-3)


def nearest_m(place_m, theta_rad):
    """Returns the distance from a point to the hand's middle line. [m]"""
    tip = np.array([np.cos(theta_rad), np.sin(theta_rad)])
    along_m = np.clip(place_m @ tip, 0.0, LENGTH_M)
    return np.hypot(*(place_m - along_m * tip))


@pytest.mark.parametrize("rho_m", [0.4, 0.6, 0.9, 1.0, 1.15])
def test_a_place_is_blocked_while_the_hand_is_too_near(rho_m):
    """So far fails: the point is always blocked."""
    beta_rad = blocked_rad(rho_m, ROOM_M)
    assert 0 < beta_rad < np.pi / 2
    # The tests use (3), which is slightly too strict if the nearest point of the line would be beyond the free end.
    assert nearest_m(np.array([rho_m, 0.0]), beta_rad + 0.01) > ROOM_M
    assert nearest_m(np.array([rho_m, 0.0]), beta_rad - 0.12) < ROOM_M


def test_beyond_the_hand_nothing_is_blocked_and_at_the_axle_all():
    """So far fails: the point is always blocked."""
    assert blocked_rad(LENGTH_M + ROOM_M + 0.01, ROOM_M) == 0.0
    assert blocked_rad(0.2, ROOM_M) == pytest.approx(np.pi)


PLACE_M = np.array([0.3, 0.8])


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("seconds", [0.0, 0.7])
def test_away_is_what_keeps_its_distance_all_the_time(turn, seconds):
    """So far fails: the result is always False."""
    turning = Turning(turn[2], turn[1], turn[0])
    said = []
    for from_s in turn[2] + np.arange(0.0, 9.0, 0.1):
        least_m = min(nearest_m(PLACE_M, turning.at(t)) for t in np.linspace(from_s, from_s + seconds, 50))
        away = is_away(turning, PLACE_M, ROOM_M, from_s, from_s + seconds)
        # Within 1 cm both results are accepted.
        assert away == (least_m > ROOM_M) or abs(least_m - ROOM_M) < 0.01
        said.append(away)
    assert 20 < sum(said) < len(said)


@pytest.mark.parametrize("turn", TURNS)
def test_a_start_is_the_first_after_which_it_is_away(turn):
    """So far fails: the result is None."""
    turning = Turning(turn[2], turn[1], turn[0])
    takes_s, early_s, late_s = 1.1, 0.3, 0.4
    waits = 0
    for now_s in turn[2] + np.arange(0.0, 9.0, 0.4):
        found = start_s(turning, PLACE_M, ROOM_M, now_s, takes_s, early_s, late_s)
        assert found is not None and found >= now_s
        there_s = found + takes_s
        assert is_away(turning, PLACE_M, ROOM_M, there_s - early_s, there_s + late_s)
        # Just before that time the point is blocked: the start is the earliest possible.
        before_s = found - 0.06 + takes_s
        assert found == now_s or not is_away(turning, PLACE_M, ROOM_M, before_s - early_s, before_s + late_s)
        waits += found > now_s
    assert 0 < waits < 23


def test_a_place_that_is_always_blocked_has_no_start():
    assert start_s(Turning(0.0, 0.0, 1.0), np.array([0.1, 0.1]), ROOM_M, 0.0, 1.0, 0.3, 0.4) is None
