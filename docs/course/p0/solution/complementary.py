"""Project 0, reference solution: explicit complementary filter on unit quaternions, with the gyroscope's bias.

R. Mahony, T. Hamel and J.-M. Pflimlin, "Nonlinear complementary filters on the special orthogonal group", IEEE
Transactions on Automatic Control 53(5), 2008, the explicit filter: equations 32 and 48.
"""

from __future__ import annotations

import numpy as np
from attitude import F64, IDENTITY, exp, is_quiet, level, multiply, up_in_body

# Gains of the accelerometer's tilt error for attitude and bias. The vehicle tilts by 20 degrees to either side every 2
# s, and its accelerometer does not measure that: at K_P = 0.05/s it moves the estimate by 20 deg 0.05/s / (2 pi / 4 s)
# = 0.6 deg. Damping 1: K_I = K_P^2 / 4. [1/s], [1/s^2]
K_P, K_I = 0.05, 0.05**2 / 4
# Number of samples at rest in one test, after which their mean is accepted. [samples]
REST = 50


class Filter:
    """Estimates the attitude from one sample after the other."""

    def __init__(self) -> None:
        self.q_xyzw: F64 = IDENTITY
        """Attitude: body to `odom`, x y z w."""
        self.bias_radps: F64 = np.zeros(3)
        self._at_s: float | None = None
        self._standing: list[tuple[F64, F64]] | None = []

    def update(self, at_s: float, gyro_radps: F64, accel_mps2: F64) -> None:
        """Processes a sample at the instant `at_s`: angular velocity and specific force, shape (3,), body axes."""
        if self._standing is not None:
            self._stand(gyro_radps, accel_mps2)
        if self._at_s is not None:
            self._turn(at_s - self._at_s, gyro_radps, accel_mps2)
        self._at_s = at_s

    def _stand(self, gyro_radps: F64, accel_mps2: F64) -> None:
        """Sets bias and tilt to the means of the samples at rest. Stops at the first motion."""
        assert self._standing is not None
        self._standing.append((gyro_radps, accel_mps2))
        if len(self._standing) % REST:
            return
        gyro, accel = (np.array(readings) for readings in zip(*self._standing))
        if is_quiet(accel[-REST:], gyro[-REST:]):
            self.bias_radps, self.q_xyzw = gyro.mean(axis=0), level(accel.mean(axis=0))
        else:
            self._standing = None

    def _turn(self, dt_s: float, gyro_radps: F64, accel_mps2: F64) -> None:
        length = np.linalg.norm(accel_mps2)
        # Rotation between the up directions of accelerometer and estimate.
        off = np.cross(accel_mps2 / length, up_in_body(self.q_xyzw)) if length > 1.0 else np.zeros(3)
        self.bias_radps = self.bias_radps - K_I * off * dt_s
        self.q_xyzw = multiply(self.q_xyzw, exp((gyro_radps - self.bias_radps + K_P * off) * dt_s))
        self.q_xyzw /= np.linalg.norm(self.q_xyzw)
