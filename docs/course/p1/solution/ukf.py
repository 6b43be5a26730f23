"""Project 1 for graduates, the reference: an unscented Kalman filter of attitude and gyroscope bias.

E. Kraft, "A quaternion-based unscented Kalman filter for orientation tracking", Fusion 2003: sigma points are turns
about the mean, and their mean is found by iteration; the error of the attitude has three parts, not four. Instead of
the angular velocity the state has the gyroscope's bias, and the gyroscope drives the prediction (J. Crassidis and F.
Markley, "Unscented filtering for spacecraft attitude estimation", Journal of Guidance, Control, and Dynamics 26(4),
2003).
"""

from __future__ import annotations

import numpy as np
from attitude import F64, GRAVITY_MPS2, IDENTITY, conjugate, exp, is_quiet, level, log, multiply, up_in_body

# White noise of the gyroscope and walk of its bias, as densities; the accelerometer's on the floor, a sample.
# [rad/sqrt(s)], [rad/s/sqrt(s)], [m/s^2]
GYRO_NOISE, BIAS_WALK, STANDING_MPS2 = 7e-4, 1e-4, 0.5
# What the vehicle's own acceleration adds in flight, a sample. It is no white noise: 2.5 m/s^2 of it that last for some
# 0.1 s in one direction count as 2.5 sqrt(2 0.1 s / 0.01 s). [m/s^2]
MOVING_MPS2 = 11.0
# The gyroscope on the floor, a sample. [rad/s]
STANDING_RADPS = 0.02
# What is not known in the beginning: tilt and bias; the heading is the frame's own. [rad], [rad/s]
TILT_SIGMA, HEADING_SIGMA, BIAS_SIGMA = 0.3, 1e-3, 0.03
# So many readings tell whether it stands.
REST = 50
TURN, BIAS = slice(0, 3), slice(3, 6)
SIZE = 6


def mean_turn(q_xyzw: F64, guess: F64) -> tuple[F64, F64]:
    """Returns the mean of attitudes (N, 4), and the turns (N, 3) from it to each of them in body axes."""
    mean = guess
    for _ in range(10):
        turns = log(multiply(conjugate(mean), q_xyzw))
        step = turns.mean(axis=0)
        if step @ step < 1e-20:
            break
        mean = multiply(mean, exp(step))
    return mean / np.linalg.norm(mean), turns


class Filter:
    """Turns readings into an attitude, one after the other."""

    def __init__(self) -> None:
        self.q_xyzw: F64 = IDENTITY
        """The attitude: body to `odom`, x y z w."""
        self.bias_radps: F64 = np.zeros(3)
        self.covariance: F64 = np.diag([TILT_SIGMA, TILT_SIGMA, HEADING_SIGMA, *[BIAS_SIGMA] * 3]) ** 2
        """Of the error: its turn in body axes [rad], then the bias [rad/s]."""
        self._at_s: float | None = None
        self._newest: list[tuple[F64, F64]] = []
        self._stands = True

    def update(self, at_s: float, gyro_radps: F64, accel_mps2: F64) -> None:
        """Takes a reading of the instant `at_s`: angular velocity and specific force, shape (3,), body axes."""
        if self._at_s is None:
            self.q_xyzw = level(accel_mps2)
        else:
            self._predict(at_s - self._at_s, gyro_radps)
        self._at_s = at_s
        rested = self._stands and self._rest(gyro_radps, accel_mps2)
        # What does not stand for sure is taken to move.
        sigma_mps2 = STANDING_MPS2 if rested else MOVING_MPS2
        self._correct(accel_mps2, sigma_mps2, lambda q, bias: GRAVITY_MPS2 * up_in_body(q))
        if rested:
            self._correct(gyro_radps, STANDING_RADPS, lambda q, bias: bias)

    def _rest(self, gyro_radps: F64, accel_mps2: F64) -> bool:
        """Tells whether it has stood for the newest readings; from the first motion on, never again."""
        self._newest = [*self._newest[1 - REST :], (gyro_radps, accel_mps2)]
        if len(self._newest) < REST:
            return False
        gyro, accel = (np.array(readings) for readings in zip(*self._newest))
        self._stands = is_quiet(accel, gyro)
        return self._stands

    def _points(self) -> F64:
        """Returns the errors of the sigma points, shape (2 SIZE, SIZE): equal weights, none in the middle."""
        root = np.linalg.cholesky(SIZE * self.covariance)
        return np.concatenate([root.T, -root.T])

    def _predict(self, dt_s: float, gyro_radps: F64) -> None:
        points = self._points()
        bias = self.bias_radps + points[:, BIAS]
        turned = multiply(multiply(self.q_xyzw, exp(points[:, TURN])), exp((gyro_radps - bias) * dt_s))
        guess = multiply(self.q_xyzw, exp((gyro_radps - self.bias_radps) * dt_s))
        self.q_xyzw, turns = mean_turn(turned, guess)
        off = np.concatenate([turns, points[:, BIAS]], axis=1)
        noise = np.repeat([GYRO_NOISE, BIAS_WALK], 3) ** 2 * dt_s
        self.covariance = off.T @ off / len(off) + np.diag(noise)

    def _correct(self, measured: F64, sigma: float, expected) -> None:
        """Takes a measurement (3,), whose value for attitudes (N, 4) and biases (N, 3) `expected` says."""
        points = self._points()
        values = expected(multiply(self.q_xyzw, exp(points[:, TURN])), self.bias_radps + points[:, BIAS])
        mean = values.mean(axis=0)
        off = values - mean
        expected_covariance = off.T @ off / len(off) + np.eye(3) * sigma**2
        gain = np.linalg.solve(expected_covariance, off.T @ points / len(off)).T
        change = gain @ (measured - mean)
        self.q_xyzw = multiply(self.q_xyzw, exp(change[TURN]))
        self.bias_radps = self.bias_radps + change[BIAS]
        covariance = self.covariance - gain @ expected_covariance @ gain.T
        self.covariance = (covariance + covariance.T) / 2
