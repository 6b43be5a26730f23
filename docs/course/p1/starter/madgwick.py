"""Project 1: attitude by Madgwick's filter. This is the file to work in; graduates also in ukf.py."""

from __future__ import annotations

from attitude import F64, IDENTITY, exp, multiply


class Filter:
    """Turns readings into an attitude, one after the other."""

    def __init__(self) -> None:
        self.q_xyzw: F64 = IDENTITY
        """The attitude: body to `odom`, x y z w."""
        self._at_s: float | None = None

    def update(self, at_s: float, gyro_radps: F64, accel_mps2: F64) -> None:
        """Takes a reading of the instant `at_s`: angular velocity and specific force, shape (3,), body axes."""
        if self._at_s is not None:
            # So far only the gyroscope counts. Madgwick's step along the gradient, and his bias, belong here.
            dt_s = at_s - self._at_s
            self.q_xyzw = multiply(self.q_xyzw, exp(gyro_radps * dt_s))
            self.q_xyzw /= (self.q_xyzw @ self.q_xyzw) ** 0.5
        self._at_s = at_s


def gradient(q_xyzw: F64, accel_mps2: F64) -> F64:
    """Returns how |up_in_body(q) - accel / |accel||^2 / 2 grows with each part of the quaternion, shape (4,).

    So far by small differences, which is slow; the assignment derives it.
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
