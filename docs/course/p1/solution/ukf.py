"""Project 1 for graduates, reference solution: unscented Kalman filter of attitude and gyroscope bias.

E. Kraft, "A quaternion-based unscented Kalman filter for orientation tracking", Fusion 2003: sigma points are rotations
from the mean, the mean is found by iteration, and the attitude error has three components, not four. The state contains
the gyroscope's bias instead of the angular velocity, and the gyroscope drives the prediction (J. Crassidis and F.
Markley, "Unscented filtering for spacecraft attitude estimation", Journal of Guidance, Control, and Dynamics 26(4),
2003).
"""

from __future__ import annotations

import numpy as np
from attitude import F64, GRAVITY_MPS2, IDENTITY, conjugate, exp, is_quiet, level, log, multiply, up_in_body

# Densities of the gyroscope's white noise and of its bias's random walk; standard deviation of an accelerometer sample
# at rest. [rad/sqrt(s)], [rad/s/sqrt(s)], [m/s^2]
GYRO_NOISE, BIAS_WALK, STANDING_MPS2 = 7e-4, 1e-4, 0.5
# Standard deviation of an accelerometer sample in flight, because of the vehicle's acceleration. This is not white
# noise: 2.5 m/s^2 for about 0.1 s in one direction count as 2.5 sqrt(2 0.1 s / 0.01 s). [m/s^2]
MOVING_MPS2 = 11.0
# Standard deviation of a gyroscope sample at rest. [rad/s]
STANDING_RADPS = 0.02
# Initial standard deviations: tilt, heading (zero by the frame's definition), bias. [rad], [rad], [rad/s]
TILT_SIGMA, HEADING_SIGMA, BIAS_SIGMA = 0.3, 1e-3, 0.03
# Number of samples for the test of rest.
REST = 50
TURN, BIAS = slice(0, 3), slice(3, 6)
SIZE = 6


def mean_turn(q_xyzw: F64, guess: F64) -> tuple[F64, F64]:
    """Returns the mean of attitudes (N, 4), and the rotations (N, 3) from it to each of them in body axes."""
    mean = guess
    for _ in range(10):
        turns = log(multiply(conjugate(mean), q_xyzw))
        step = turns.mean(axis=0)
        if step @ step < 1e-20:
            break
        mean = multiply(mean, exp(step))
    return mean / np.linalg.norm(mean), turns


class Filter:
    """Estimates the attitude from one sample after the other."""

    def __init__(self) -> None:
        self.q_xyzw: F64 = IDENTITY
        """Attitude: body to `odom`, x y z w."""
        self.bias_radps: F64 = np.zeros(3)
        self.covariance: F64 = np.diag([TILT_SIGMA, TILT_SIGMA, HEADING_SIGMA, *[BIAS_SIGMA] * 3]) ** 2
        """Of the error: rotation in body axes [rad], then bias [rad/s]."""
        self._at_s: float | None = None
        self._newest: list[tuple[F64, F64]] = []
        self._stands = True

    def update(self, at_s: float, gyro_radps: F64, accel_mps2: F64) -> None:
        """Processes a sample at the instant `at_s`: angular velocity and specific force, shape (3,), body axes."""
        if self._at_s is None:
            self.q_xyzw = level(accel_mps2)
        else:
            self._predict(at_s - self._at_s, gyro_radps)
        self._at_s = at_s
        rested = self._stands and self._rest(gyro_radps, accel_mps2)
        # Unless rest is certain, assume motion.
        sigma_mps2 = STANDING_MPS2 if rested else MOVING_MPS2
        self._correct(accel_mps2, sigma_mps2, lambda q, bias: GRAVITY_MPS2 * up_in_body(q))
        if rested:
            self._correct(gyro_radps, STANDING_RADPS, lambda q, bias: bias)

    def _rest(self, gyro_radps: F64, accel_mps2: F64) -> bool:
        """Returns whether the vehicle was at rest for the newest samples; always False after the first motion."""
        self._newest = [*self._newest[1 - REST :], (gyro_radps, accel_mps2)]
        if len(self._newest) < REST:
            return False
        gyro, accel = (np.array(readings) for readings in zip(*self._newest))
        self._stands = is_quiet(accel, gyro)
        return self._stands

    def _points(self) -> F64:
        """Returns the errors of the sigma points, shape (2 SIZE, SIZE), with equal weights and no central point."""
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
        """Processes a measurement (3,). `expected` returns its values for attitudes (N, 4) and biases (N, 3)."""
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
