#!/usr/bin/env python3
"""Hovers at the take-off height, turns around once, and lands.

The smallest useful plugin: it needs no pose and works on every course.
"""

import math

import vizflyt
from vizflyt import Setpoint

# A full turn takes 2 pi / 0.8 = 8 s. [rad/s]
TURN_RADPS = 0.8


class Hover(vizflyt.Plugin):
    def on_start(self, info):
        self.flying = False
        self.since_ns = None

    def on_event(self, event):
        if event.details.get("phase") == "flying":
            self.flying = True
            print("flying: once around, then down")

    def on_image(self, obs):
        # Images arrive before take-off too; the turn begins in flight.
        if not self.flying:
            return Setpoint.hold()
        if self.since_ns is None:
            self.since_ns = obs.stamp_ns
        turned_rad = TURN_RADPS * (obs.stamp_ns - self.since_ns) * 1e-9
        if turned_rad > 2 * math.pi:
            return Setpoint.land()
        return Setpoint.velocity([0, 0, 0], yaw_rate=TURN_RADPS)


if __name__ == "__main__":
    vizflyt.run(Hover)
