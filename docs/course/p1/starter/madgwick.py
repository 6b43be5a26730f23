"""Project 1: attitude with Madgwick's filter. Work in this file; graduates also in ukf.py."""

from __future__ import annotations

from attitude import F64, IDENTITY, exp, multiply


class Filter:
    """Estimates the attitude from one sample after the other."""

    def __init__(self) -> None:
        self.q_xyzw: F64 = IDENTITY
        """Attitude: body to `odom`, x y z w."""
        self._at_s: float | None = None

    def update(self, at_s: float, gyro_radps: F64, accel_mps2: F64) -> None:
        """Processes a sample at the instant `at_s`: angular velocity and specific force, shape (3,), body axes."""
        if self._at_s is not None:
            # To do: only the gyroscope counts here. Add Madgwick's step along the gradient, and his bias.
            dt_s = at_s - self._at_s
            self.q_xyzw = multiply(self.q_xyzw, exp(gyro_radps * dt_s))
            self.q_xyzw /= (self.q_xyzw @ self.q_xyzw) ** 0.5
        self._at_s = at_s


def gradient(q_xyzw: F64, accel_mps2: F64) -> F64:
    """Returns the gradient of |up_in_body(q) - accel / |accel||^2 / 2 by the quaternion's components, shape (4,).

    To do: this uses small differences, which is slow. Derive it, as in the assignment.
    """
    from attitude import up_in_body

    force = accel_mps2 / (accel_mps2 @ accel_mps2) ** 0.5
    found = 0.0 * q_xyzw
    for part in range(4):
        step = 0.0 * q_xyzw
        step[part] = 1e-6
        found[part] = (
            ((up_in_body(q_xyzw + step) - force) ** 2).sum() - ((up_in_body(q_xyzw - step) - force) ** 2).sum()
        ) / 4e-6
    return found
