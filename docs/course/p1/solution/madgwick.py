"""Project 1, reference solution: Madgwick's filter for a gyroscope and an accelerometer.

S. Madgwick, "An efficient orientation filter for inertial and inertial/magnetic sensor arrays", report, University of
Bristol, 2010: equations 25 and 26 (objective and gradient, here with z up and q from body to world), 44 (the step along
the gradient), 47 to 49 (the gyroscope's bias).
"""

from __future__ import annotations

import numpy as np
from attitude import F64, IDENTITY, is_quiet, level, multiply

# Step size along the gradient for the quaternion's components, and for the bias. [1/s], [rad/s^2]
BETA, ZETA = 0.004, 2e-5
# A filter that starts in the air has neither tilt nor bias: these values, divided by the elapsed time, apply while they
# are larger. [1], [rad/s]
FIRST_BETA, FIRST_ZETA = 0.4, 0.1
# Number of samples at rest in one test, after which their mean is accepted. [samples]
REST = 50


def gradient(q_xyzw: F64, accel_mps2: F64) -> F64:
    """Returns the gradient of |up_in_body(q) - accel / |accel||^2 / 2 by the quaternion's components, shape (4,)."""
    x, y, z, w = q_xyzw
    ax, ay, az = accel_mps2 / np.linalg.norm(accel_mps2)
    off = np.array([2 * (x * z - w * y) - ax, 2 * (y * z + w * x) - ay, 1 - 2 * (x * x + y * y) - az])
    by_part = 2 * np.array([[z, -w, x, -y], [w, z, y, x], [-2 * x, -2 * y, 0, 0]])
    return by_part.T @ off


class Filter:
    """Estimates the attitude from one sample after the other."""

    def __init__(self) -> None:
        self.q_xyzw: F64 = IDENTITY
        """Attitude: body to `odom`, x y z w."""
        self.bias_radps: F64 = np.zeros(3)
        self._at_s: float | None = None
        self._standing: list[tuple[F64, F64]] | None = []
        self._stood = False
        self._moving_s = 0.0

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
            self.bias_radps, self.q_xyzw, self._stood = gyro.mean(axis=0), level(accel.mean(axis=0)), True
        else:
            self._standing = None

    def _turn(self, dt_s: float, gyro_radps: F64, accel_mps2: F64) -> None:
        beta, zeta = BETA, ZETA
        if not self._stood:
            self._moving_s = max(self._moving_s + dt_s, 1.0)
            beta, zeta = max(beta, FIRST_BETA / self._moving_s), max(zeta, FIRST_ZETA / self._moving_s)
        q, step = self.q_xyzw, np.zeros(4)
        if np.linalg.norm(accel_mps2) > 1.0:
            slope = gradient(q, accel_mps2)
            length = np.linalg.norm(slope)
            step = slope / length if length > 1e-9 else step
        # The step as an angular velocity in body axes.
        wrong_radps = 2 * multiply(q * [-1.0, -1.0, -1.0, 1.0], step)[:3]
        self.bias_radps = self.bias_radps + zeta * wrong_radps * dt_s
        rate = multiply(q, np.append(gyro_radps - self.bias_radps, 0.0)) / 2
        q = q + (rate - beta * step) * dt_s
        self.q_xyzw = q / np.linalg.norm(q)
