#!/usr/bin/env python3
"""The forest at high speed: maps depth images, and chooses the best velocity at each image."""

from __future__ import annotations

import math

import numpy as np
import primitives
import sight

import vizflyt
from vizflyt import Setpoint

MOST_MPS = 3.0  # the course allows 10
BAND_M = 0.5  # obstacles are within this distance above and below the flight height
FENCE_M = 0.9  # distance from the fence at the sides, where the guard would turn the vehicle
LATENCY_S = 0.06  # until a setpoint takes effect
OVER_S = 0.1  # time over which acceleration is measured
CLIMB_PER_S, CLIMB_MPS = 2.0, 1.0
LOOK_AHEAD = 9  # the nose points at the path, this number of steps ahead
AHEAD_M = 20.0  # part of the map with distances


def box_of(volume, near_m):
    """Returns the low and the high corner of a box with sides along the axes, from a point (3,) near it. [m, world]"""
    away_m = 10_000.0
    probes_m = away_m * np.eye(3)  # far out on an axis, the distance to the box is the distance to one face
    low_m = near_m - away_m + volume.signed_distance_m(near_m - probes_m)
    return low_m, near_m + away_m - volume.signed_distance_m(near_m + probes_m)


class Forest(vizflyt.Plugin):
    def on_start(self, info):
        self.info = info
        self.low_m, self.high_m = box_of(info.geofence, info.goal_m)
        self.map = sight.Map(self.low_m[:2], self.high_m[:2])
        self.rays = sight.Rays(info.cameras[0].intrinsics)
        self.flown: list[tuple[float, np.ndarray]] = []  # times and velocities of the last images
        self.wanted_mps = np.zeros(2)
        self.flying = self.finished = False

    def on_event(self, event):
        self.flying |= event.details.get("phase") == "flying"
        self.finished |= event.kind == "finished"

    def on_image(self, obs):
        vehicle, front = obs.vehicle, obs.camera("front")
        if self.finished:
            return Setpoint.hold()
        if vehicle is None or vehicle.p_world_m is None or front is None:
            return None
        self.look(front)
        if not self.flying:
            return Setpoint.hold()

        now_s, p_m = vehicle.stamp_ns * 1e-9, vehicle.p_world_m
        soon = self.motion(now_s, p_m[:2], vehicle.v_world_mps[:2]).after(self.wanted_mps, LATENCY_S)
        self.map.measure(p_m[:2], AHEAD_M)
        self.wanted_mps, way_m = primitives.best(soon, self.info.goal_m[:2], MOST_MPS, self.room_m)
        ahead_m = way_m[LOOK_AHEAD] - p_m[:2]
        climb_mps = min(max(CLIMB_PER_S * (self.info.goal_m[2] - p_m[2]), -CLIMB_MPS), CLIMB_MPS)
        return Setpoint.velocity([*self.wanted_mps, climb_mps], yaw=math.atan2(ahead_m[1], ahead_m[0]))

    def look(self, front):
        """Adds an image to the map, from the pose at which it was rendered."""
        world_from_cam = front.pose_at_image @ front.body_from_cam
        rotation, camera_m = world_from_cam.rotation_matrix, world_from_cam.translation_m
        height_m = self.info.goal_m[2]
        self.map.see_through(front.depth_mm, front.intrinsics, rotation, camera_m, height_m)
        seen_m = sight.obstacles(
            front.depth_mm, self.rays, rotation, camera_m, height_m - BAND_M, height_m + BAND_M
        )
        inside = ((seen_m > self.low_m[:2]) & (seen_m < self.high_m[:2])).all(axis=1)
        self.map.add(seen_m[inside])

    def motion(self, now_s, p_m, v_mps):
        """Returns the vehicle's motion, with its acceleration over the last images."""
        self.flown.append((now_s, v_mps))
        while len(self.flown) > 2 and now_s - self.flown[1][0] >= OVER_S:
            del self.flown[0]
        past_s, past_mps = self.flown[0]
        a_mps2 = (v_mps - past_mps) / max(now_s - past_s, 0.5 * OVER_S)
        return primitives.Motion.seen(p_m, v_mps, primitives.shortened(a_mps2, primitives.ACCELERATION_MPS2))

    def room_m(self, p_m):
        """Returns the clearance beside the body at points (..., 2), to obstacles and to the fence. [m]"""
        to_fence_m = np.minimum(p_m - self.low_m[:2], self.high_m[:2] - p_m).min(axis=-1) - FENCE_M
        return np.minimum(self.map.room_m(p_m), to_fence_m) - self.info.body_radius_m


if __name__ == "__main__":
    vizflyt.run(Forest)
