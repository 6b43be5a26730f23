#!/usr/bin/env python3
"""Flies a square around the take-off position with the nose in flight direction, and lands.

It needs the vehicle's pose (the course's ground truth, or your own odometry instead).
"""

import numpy as np

import vizflyt
from vizflyt import Setpoint

# Corners relative to the start: forward and left of the nose. [m]
CORNERS_M = [(1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.0)]
SPEED_MPS = 0.8
# Distance at which a corner counts as reached. The path stops only at its end. [m]
REACHED_M = 0.25


class Waypoints(vizflyt.Plugin):
    def on_start(self, info):
        self.flying = False
        self.corners_m = None

    def on_event(self, event):
        if event.details.get("phase") == "flying":
            self.flying = True

    def on_image(self, obs):
        vehicle = obs.vehicle
        if not self.flying or vehicle is None:
            return Setpoint.hold()
        if vehicle.p_world_m is None:
            # Without a pose: the guard holds, then lands.
            return None
        here_m = vehicle.p_world_m
        if self.corners_m is None:
            ahead = np.array([np.cos(vehicle.yaw_rad), np.sin(vehicle.yaw_rad), 0.0])
            left = np.array([-ahead[1], ahead[0], 0.0])
            self.corners_m = [here_m + x * ahead + y * left for x, y in CORNERS_M]
            # The runtime follows the path. Returning None below continues it.
            return Setpoint.waypoints(self.corners_m, SPEED_MPS)
        if np.linalg.norm(self.corners_m[0] - here_m) < REACHED_M:
            print("reached", np.round(self.corners_m[0], 2))
            if len(self.corners_m) == 1:
                return Setpoint.land()
            self.corners_m.pop(0)
        return None


if __name__ == "__main__":
    vizflyt.run(Waypoints)
