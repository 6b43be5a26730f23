"""Project 0: attitude from gyroscope and accelerometer by a complementary filter. This is the file to work in."""

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
            # So far only the gyroscope counts: the accelerometer is not looked at, and a bias adds up.
            dt_s = at_s - self._at_s
            self.q_xyzw = multiply(self.q_xyzw, exp(gyro_radps * dt_s))
            self.q_xyzw /= (self.q_xyzw @ self.q_xyzw) ** 0.5
        self._at_s = at_s
