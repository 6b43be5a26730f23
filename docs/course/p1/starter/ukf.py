"""Project 1 for graduates: attitude and gyroscope bias by an unscented Kalman filter. This is the file to work in."""

from __future__ import annotations

import numpy as np
from attitude import F64, IDENTITY, exp, multiply

# What is not known in the beginning: tilt, heading (zero is where it looks), bias. [rad], [rad], [rad/s]
TILT_SIGMA, HEADING_SIGMA, BIAS_SIGMA = 0.3, 1e-3, 0.03


class Filter:
    """Turns readings into an attitude, one after the other."""

    def __init__(self) -> None:
        self.q_xyzw: F64 = IDENTITY
        """The attitude: body to `odom`, x y z w."""
        self.bias_radps: F64 = np.zeros(3)
        self.covariance: F64 = np.diag([TILT_SIGMA, TILT_SIGMA, HEADING_SIGMA, *[BIAS_SIGMA] * 3]) ** 2
        """Of the error: its turn in body axes [rad], then the bias [rad/s]."""
        self._at_s: float | None = None

    def update(self, at_s: float, gyro_radps: F64, accel_mps2: F64) -> None:
        """Takes a reading of the instant `at_s`: angular velocity and specific force, shape (3,), body axes."""
        if self._at_s is not None:
            # So far only the gyroscope counts. Sigma points, their mean and covariance belong here; then the
            # correction by the accelerometer.
            dt_s = at_s - self._at_s
            self.q_xyzw = multiply(self.q_xyzw, exp((gyro_radps - self.bias_radps) * dt_s))
            self.q_xyzw /= (self.q_xyzw @ self.q_xyzw) ** 0.5
        self._at_s = at_s


def mean_turn(q_xyzw: F64, guess: F64) -> tuple[F64, F64]:
    """Returns the mean of attitudes (N, 4), and the turns (N, 3) from it to each of them in body axes.

    So far the guess is taken for the mean; the assignment says how to find it.
    """
    return guess, np.zeros((len(q_xyzw), 3))
