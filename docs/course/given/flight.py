"""The flight: moves, and runs a filter on the IMU's samples. Given; nothing is to be filled in here."""

from __future__ import annotations

import numpy as np

import vizflyt
from vizflyt import Setpoint

# Forward, then figures of eight, then forward to the end. [s], [m/s]
AHEAD_S, EIGHTS_S, AHEAD_MPS = 3.0, 40.0, 0.7
# Period of a figure; maximum speeds along x and y. [s], [m/s]
EIGHT_S, X_MPS, Y_MPS = 4.0, 1.6, 1.3
# Swing of the nose to both sides: period and amplitude. [s], [rad]
SWING_S, SWING_RAD = 20 / 3, 0.6


class AttitudeFlight(vizflyt.Plugin):
    """Flies by the clock of the images, and publishes the filter's attitude at each image.

    `make` creates the filter: an object with `update(at_s, gyro_radps, accel_mps2)`, which is called once for each
    sample, and with `q_xyzw`.
    """

    def __init__(self, make):
        self.make = make

    def on_start(self, info):
        self.filter = self.make()
        self.since_ns = None
        self.flying = False
        self.published_ns = 0

    def on_event(self, event):
        if event.details.get("phase") == "flying":
            self.flying = True

    def on_image(self, obs):
        for sample in obs.imu:
            self.filter.update(sample.stamp_ns * 1e-9, sample.gyro_radps, sample.accel_mps2)
        if obs.imu and obs.imu[-1].stamp_ns > self.published_ns:
            self.published_ns = obs.imu[-1].stamp_ns
            vizflyt.publish_odometry(self.published_ns, [0.0, 0.0, 0.0], self.filter.q_xyzw)
        if not self.flying:
            return Setpoint.hold()
        if self.since_ns is None:
            self.since_ns = obs.stamp_ns
        return self.steer((obs.stamp_ns - self.since_ns) * 1e-9)

    def steer(self, t_s):
        """Returns the setpoint `t_s` after the plugin got control."""
        t_s -= AHEAD_S
        if not 0 < t_s < EIGHTS_S:
            return Setpoint.velocity([AHEAD_MPS, 0, 0], axes="heading")
        # Smooth transitions at both ends of the figures.
        share = min(t_s, EIGHTS_S - t_s, 1.0)
        phase = 2 * np.pi * t_s / EIGHT_S
        x_mps, y_mps = share * X_MPS * np.cos(phase), share * Y_MPS * np.sin(2 * phase)
        # Heading axes turn with the nose, but the figures must not.
        swing = 2 * np.pi * t_s / SWING_S
        yaw_rad = SWING_RAD * np.sin(swing)
        yaw_radps = SWING_RAD * 2 * np.pi / SWING_S * np.cos(swing)
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        v_mps = [cos * x_mps + sin * y_mps, cos * y_mps - sin * x_mps, 0]
        return Setpoint.velocity(v_mps, axes="heading", yaw_rate=yaw_radps)
