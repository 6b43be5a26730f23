"""Additional requirements of the unscented Kalman filter, for graduates: `python -m pytest` in your folder."""

import numpy as np
from attitude import GRAVITY_MPS2, conjugate, exp, log, multiply, up_in_body
from ukf import Filter, mean_turn

HZ = 100


def fly(seconds, bias_radps):
    """Runs the filter in the air, on samples without noise. Returns it, and the true attitude."""
    filter_ = Filter()
    true_xyzw = exp(np.radians([20.0, -15.0, 0.0]))
    for index in range(seconds * HZ):
        at_s = index / HZ
        turn_radps = np.array([0.4 * np.sin(2.0 * at_s), 0.5 * np.cos(1.7 * at_s), 0.2])
        true_xyzw = multiply(true_xyzw, exp(turn_radps / HZ))
        filter_.update(at_s, turn_radps + bias_radps, GRAVITY_MPS2 * up_in_body(true_xyzw))
    return filter_, true_xyzw


def test_the_mean_of_turns_is_the_one_they_lie_around():
    """So far fails: the guess is not improved."""
    middle = exp(np.array([0.3, -1.0, 2.0]))
    offs = np.array([[0.2, 0, 0], [-0.2, 0, 0], [0, 0.3, 0], [0, -0.3, 0], [0, 0, 0.1], [0, 0, -0.1]])
    attitudes = multiply(middle, exp(offs))
    # A quaternion and its negative are the same attitude.
    attitudes[::2] *= -1
    mean, turns = mean_turn(attitudes, multiply(middle, exp(np.array([0.3, 0.2, -0.2]))))
    assert np.linalg.norm(log(multiply(conjugate(middle), mean))) < 1e-6
    np.testing.assert_allclose(turns, offs, atol=1e-6)


def test_it_finds_level_and_bias_while_it_moves():
    """So far fails: a filter that starts in the air has neither level nor bias."""
    bias_radps = np.radians([1.0, -1.0, 0.0])
    filter_, true_xyzw = fly(30, bias_radps)
    cosine = up_in_body(filter_.q_xyzw) @ up_in_body(true_xyzw)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 1.0
    assert np.degrees(np.abs(filter_.bias_radps - bias_radps)).max() < 0.2


def test_it_knows_what_it_knows():
    """So far fails: the covariance does not change. An accelerometer does not measure the heading."""
    filter_, _ = fly(20, np.zeros(3))
    covariance = filter_.covariance
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    up = up_in_body(filter_.q_xyzw)
    heading = np.sqrt(up @ covariance[:3, :3] @ up)
    across = np.cross(up, [1.0, 0, 0])
    across /= np.linalg.norm(across)
    tilt = np.sqrt(across @ covariance[:3, :3] @ across)
    assert tilt < 0.1 < heading


def test_readings_at_once_and_free_fall_break_nothing():
    filter_, _ = fly(1, np.zeros(3))
    for accel_mps2 in ([0.0, 0, 0], [0.0, 0, GRAVITY_MPS2]):
        filter_.update(1.0, np.zeros(3), np.array(accel_mps2))
    assert abs(np.linalg.norm(filter_.q_xyzw) - 1) < 1e-9
