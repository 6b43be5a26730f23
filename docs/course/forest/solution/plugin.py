"""The forest at high speed: keeps a map of the depth images, and flies the best of many candidate paths."""

import math

import numpy as np
import primitives
import sight

import vizflyt
from vizflyt import Setpoint

MOST_MPS = 8.5
BRAKE_MPS2, BRAKE_LATE_S = 1.6, 0.55  # with which the guard stops in front of the fence, so more speed is useless
GUARD_M = 0.2  # the guard's distance from the fence
FENCE_M = 0.9  # distance from the fence at the sides, where the guard would turn the vehicle
# A short brake at the start shows the guard the vehicle's actual response; otherwise the guard assumes a slower one.
SHOW_S = (0.8, 1.0)
LEAD_MPS = 1.2  # lead of the setpoint over the velocity: enough for the guard, and it keeps the direction
BAND_M = 0.5  # obstacles are within this distance above and below the flight height
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
        self.most_mps = min(MOST_MPS, info.limits.max_speed_mps)
        self.flown: list[tuple[float, np.ndarray]] = []  # times and velocities of the last images
        self.wanted_mps = np.zeros(2)
        self.since_s = None
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
        self.since_s = self.since_s or now_s
        soon = self.motion(now_s, p_m[:2], vehicle.v_world_mps[:2]).after(self.wanted_mps, LATENCY_S)
        self.map.measure(p_m[:2], AHEAD_M)
        most_mps = min(self.most_mps, self.stop_mps(soon.p_m))
        self.wanted_mps, way_m = primitives.best(soon, self.info.goal_m[:2], most_mps, self.room_m)
        if SHOW_S[0] < now_s - self.since_s < SHOW_S[1]:
            self.wanted_mps = np.zeros(2)
        asked_mps = soon.asked_mps + primitives.shortened(self.wanted_mps - soon.asked_mps, LEAD_MPS)
        ahead_m = way_m[LOOK_AHEAD] - p_m[:2]
        climb_mps = min(max(CLIMB_PER_S * (self.info.goal_m[2] - p_m[2]), -CLIMB_MPS), CLIMB_MPS)
        return Setpoint.velocity([*asked_mps, climb_mps], yaw=math.atan2(ahead_m[1], ahead_m[0]))

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

    def stop_mps(self, p_m):
        """Returns the maximum speed from `p_m` (2,) towards the fence behind the goal that the guard allows. [m/s]"""
        ahead = self.info.goal_m[:2] - p_m
        ahead /= max(math.hypot(*ahead), 1e-9)
        out_m = np.where(ahead > 0, self.high_m[:2] - p_m, p_m - self.low_m[:2])
        free_m = (out_m / np.maximum(np.abs(ahead), 1e-9)).min() - self.info.body_radius_m - GUARD_M
        late_mps = BRAKE_MPS2 * BRAKE_LATE_S
        return math.sqrt(late_mps**2 + 2.0 * BRAKE_MPS2 * max(free_m, 0.1)) - late_mps

    def room_m(self, p_m):
        """Returns the clearance beside the body at points (..., 2), to obstacles and to the fence. [m]"""
        to_fence_m = np.minimum(p_m - self.low_m[:2], self.high_m[:2] - p_m).min(axis=-1) - FENCE_M
        return np.minimum(self.map.room_m(p_m), to_fence_m) - self.info.body_radius_m


if __name__ == "__main__":
    vizflyt.run(Forest)
