"""Project 1 for graduates: attitude and gyroscope bias with an unscented Kalman filter. Work in this file."""

from __future__ import annotations

import numpy as np
from attitude import F64, IDENTITY, exp, multiply

# Initial standard deviations: tilt, heading (zero by the frame's definition), bias. [rad], [rad], [rad/s]
TILT_SIGMA, HEADING_SIGMA, BIAS_SIGMA = 0.3, 1e-3, 0.03


class Filter:
    """Estimates the attitude from one sample after the other."""

    def __init__(self) -> None:
        self.q_xyzw: F64 = IDENTITY
        """Attitude: body to `odom`, x y z w."""
        self.bias_radps: F64 = np.zeros(3)
        self.covariance: F64 = np.diag([TILT_SIGMA, TILT_SIGMA, HEADING_SIGMA, *[BIAS_SIGMA] * 3]) ** 2
        """Of the error: rotation in body axes [rad], then bias [rad/s]."""
        self._at_s: float | None = None

    def update(self, at_s: float, gyro_radps: F64, accel_mps2: F64) -> None:
        """Processes a sample at the instant `at_s`: angular velocity and specific force, shape (3,), body axes."""
        if self._at_s is not None:
            # To do: only the gyroscope counts here. Add sigma points, their mean and covariance, and the correction by
            # the accelerometer.
            dt_s = at_s - self._at_s
            self.q_xyzw = multiply(self.q_xyzw, exp((gyro_radps - self.bias_radps) * dt_s))
            self.q_xyzw /= (self.q_xyzw @ self.q_xyzw) ** 0.5
        self._at_s = at_s


def mean_turn(q_xyzw: F64, guess: F64) -> tuple[F64, F64]:
    """Returns the mean of attitudes (N, 4), and the rotations (N, 3) from it to each of them in body axes.

    To do: this returns the guess. The assignment describes how to find the mean.
    """
    return guess, np.zeros((len(q_xyzw), 3))
