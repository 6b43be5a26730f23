"""Requirements of project 0's filter, on samples without noise: `python -m pytest` in your folder.

Tests marked "so far fails" pass with a correct solution.
"""

import numpy as np
import pytest
from attitude import GRAVITY_MPS2, conjugate, exp, log, multiply, up_in_body
from complementary import Filter

UP = np.array([0.0, 0.0, GRAVITY_MPS2])
STILL = np.zeros(3)
HZ = 100


def run(filter_, seconds, gyro_radps, accel_mps2, from_s=0.0):
    """Passes the same sample to a filter for some seconds. Returns the time of the end."""
    count = round(seconds * HZ)
    for index in range(count):
        filter_.update(from_s + index / HZ, np.array(gyro_radps, float), np.array(accel_mps2, float))
    return from_s + count / HZ


def tilt_deg(filter_, true_xyzw):
    cosine = up_in_body(filter_.q_xyzw) @ up_in_body(true_xyzw)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def turn_deg(filter_, true_xyzw):
    return np.degrees(np.linalg.norm(log(multiply(conjugate(true_xyzw), filter_.q_xyzw))))


def test_a_turn_of_the_nose_is_followed():
    filter_ = Filter()
    at_s = run(filter_, 3.0, STILL, UP)
    run(filter_, 2.0, [0, 0, np.pi / 4], UP, at_s)
    assert turn_deg(filter_, exp(np.array([0, 0, np.pi / 2]))) < 1.5


def test_a_turn_that_begins_at_once_is_followed():
    filter_ = Filter()
    run(filter_, 2.0, [0, 0, np.pi / 4], UP)
    assert turn_deg(filter_, exp(np.array([0, 0, np.pi / 2]))) < 2.0


@pytest.mark.parametrize("axis", [0, 1])
def test_a_tilted_body_at_rest_is_seen_as_tilted(axis):
    """So far fails: the accelerometer is ignored."""
    turn_rad = np.zeros(3)
    turn_rad[axis] = np.radians(12)
    true_xyzw = exp(turn_rad)
    filter_ = Filter()
    run(filter_, 60.0, STILL, GRAVITY_MPS2 * up_in_body(true_xyzw))
    assert tilt_deg(filter_, true_xyzw) < 1.0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_bias_does_not_add_up_at_rest(axis):
    """So far fails: a bias of 1 deg/s adds up to 60 degrees in a minute."""
    bias_radps = np.zeros(3)
    bias_radps[axis] = np.radians(1.0)
    filter_ = Filter()
    run(filter_, 60.0, bias_radps, UP)
    assert turn_deg(filter_, np.array([0.0, 0.0, 0.0, 1.0])) < 2.0


def test_a_short_push_is_no_tilt():
    filter_ = Filter()
    at_s = run(filter_, 5.0, STILL, UP)
    run(filter_, 0.5, STILL, [4.0, 0, GRAVITY_MPS2], at_s)
    assert tilt_deg(filter_, np.array([0.0, 0.0, 0.0, 1.0])) < 2.0


def test_free_fall_and_time_that_stands_still_break_nothing():
    filter_ = Filter()
    at_s = run(filter_, 1.0, STILL, UP)
    at_s = run(filter_, 1.0, [0.3, 0.2, 0.1], STILL, at_s)
    filter_.update(at_s, STILL, UP)
    filter_.update(at_s, STILL, UP)
    assert np.linalg.norm(filter_.q_xyzw) == pytest.approx(1.0, abs=1e-9)
