"""Project 0: attitude from gyroscope and accelerometer with a complementary filter. Work in this file."""

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
            # To do: only the gyroscope counts here. The accelerometer is ignored, and a bias accumulates.
            dt_s = at_s - self._at_s
            self.q_xyzw = multiply(self.q_xyzw, exp(gyro_radps * dt_s))
            self.q_xyzw /= (self.q_xyzw @ self.q_xyzw) ** 0.5
        self._at_s = at_s
