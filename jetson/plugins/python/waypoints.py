#!/usr/bin/env python3
"""Flies a square around the place where it took off, looking where it flies, and lands.

It needs the vehicle's pose (the course's ground truth, or your own odometry in its place).
"""

import numpy as np

import vizflyt
from vizflyt import Setpoint

# Corners from the start, forward and left of where the nose pointed. [m]
CORNERS_M = [(1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.0)]
# Near enough to go on to the next. [m]
REACHED_M = 0.15


class Waypoints(vizflyt.Plugin):
    def on_start(self, info):
        self.flying = False
        self.waypoints_m = None

    def on_event(self, event):
        if event.details.get("phase") == "flying":
            self.flying = True

    def on_image(self, obs):
        if not self.flying:
            return Setpoint.hold()
        vehicle = obs.vehicle
        if vehicle is None or vehicle.p_world_m is None:
            # Nothing to steer by: the guard holds, then lands.
            return None
        here_m = vehicle.p_world_m
        if self.waypoints_m is None:
            ahead = np.array([np.cos(vehicle.yaw_rad), np.sin(vehicle.yaw_rad), 0.0])
            left = np.array([-ahead[1], ahead[0], 0.0])
            self.waypoints_m = [here_m + x * ahead + y * left for x, y in CORNERS_M]
        if np.linalg.norm(self.waypoints_m[0] - here_m) < REACHED_M:
            print("reached", np.round(self.waypoints_m.pop(0), 2))
            if not self.waypoints_m:
                self.waypoints_m = [here_m]
                return Setpoint.land()
        to_go_m = self.waypoints_m[0] - here_m
        return Setpoint.position(self.waypoints_m[0], yaw=np.arctan2(to_go_m[1], to_go_m[0]))


if __name__ == "__main__":
    vizflyt.run(Waypoints)
