"""Project 2, reference solution: undergraduates' A* with waypoints; graduates' RRT* and polynomials with velocities.

The setpoints that the level allows determine the variant.
"""

from itertools import product

import numpy as np
from planner import F64, astar, shorten
from planner_g import curve, rrt_star, smooth

import vizflyt
from vizflyt import Setpoint

# Margins of clearance: the first with a path (ug); the one with the fastest curve (g). [m]
MARGINS_M = (0.40, 0.35, 0.30, 0.25)

# For waypoints: speed on lines, and maximum change of velocity at a corner. A vehicle with lag overshoots a corner the
# more, the more its velocity changes. [m/s]
LINE_MPS, TURN_MPS = 1.6, 0.4
# Distance behind a corner at which the speed may increase again. [m]
CORNER_M = 0.3

# Minimum clearance of a curve. [m]
LEAST_M = 0.22
# Number of trees for each margin, and their nodes. A single tree may find only a long detour.
TREES, NODES = 2, 600

# For velocities: limits of the curve. The reserve to the limits of 3 m/s and 6 m/s^2 is for corrections. [m/s], [m/s^2]
CURVE_MPS, CURVE_MPS2 = 2.6, 3.0
# Lag of the velocity behind the setpoint along x, y, z, measured in flight logs (`sent` and `motion`). [s]
LAG_S = np.array([0.40, 0.40, 0.20])
# Delay from the vehicle's state to the effect of the setpoint. [s]
AHEAD_S = 0.07
# k of (7). [1/s]
GAIN_PER_S = 1.0
# The reference slows down at the first distance from the vehicle, and stops at the second. [m]
WAITS_M, STANDS_M = 0.10, 0.40


def box_of(volume: vizflyt.Volume, near_m: F64) -> tuple[F64, F64]:
    """Returns the low and the high corner of a box with sides along the axes, from a point (3,) near it. [m, world]"""
    away_m = 10_000.0
    probes_m = away_m * np.eye(3)  # far out on an axis, the distance to the box is the distance to one face
    low_m = near_m - away_m + volume.signed_distance_m(near_m - probes_m)
    return low_m, near_m + away_m - volume.signed_distance_m(near_m + probes_m)


def slow_corners(path_m: F64) -> tuple[F64, F64]:
    """Returns waypoints (N, 3) along a path [m, world], and the speeds (N,) on the way to each: slow at corners. [m/s]

    The runtime reaches a corner at most with the speed of the next segment.
    """
    ways_m = np.diff(path_m, axis=0)
    lengths_m = np.linalg.norm(ways_m, axis=1)
    directions = ways_m / lengths_m[:, None]
    points_m, speeds_mps = [path_m[1]], [LINE_MPS]
    for corner_m, before, after, length_m in zip(path_m[1:-1], directions[:-1], directions[1:], lengths_m[1:]):
        turn = float(np.linalg.norm(after - before))
        points_m += [corner_m + min(CORNER_M, 0.5 * length_m) * after, corner_m + length_m * after]
        speeds_mps += [min(LINE_MPS, TURN_MPS / max(turn, 1e-6)), LINE_MPS]
    return np.array(points_m), np.array(speeds_mps)


class Planned(vizflyt.Plugin):
    def on_start(self, info):
        self.info = info
        self.low_m, self.high_m = box_of(info.geofence, info.goal_m)
        # Ignore solids that do not reach into the fence: the fence is always nearer.
        axes = [np.arange(low, high + 0.2, 0.2) for low, high in zip(self.low_m, self.high_m)]
        places_m = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self.solids = [solid for solid in vizflyt.course_map() if solid.signed_distance_m(places_m).min() < 0.2]

        low_m, high_m = box_of(info.start_box, self.low_m)
        self.start_m = np.array([*(0.5 * (low_m + high_m))[:2], info.takeoff_height_m])
        self.by_velocity = "velocity" in info.setpoints
        self.path_m = self.plan_curve() if self.by_velocity else self.plan_lines()
        self.flying, self.asked = False, False
        self.at_s, self.pace, self.seen_ns = 0.0, 1.0, None

    def on_event(self, event):
        self.flying |= event.details.get("phase") == "flying"

    def room(self, points_m):
        """Returns the clearance of the body's centre at points (N, 3): shape (N,). [m]"""
        distances_m = [solid.signed_distance_m(points_m) for solid in self.solids]
        return np.min([*distances_m, -self.info.geofence.signed_distance_m(points_m)], axis=0) - self.info.body_radius_m

    def plan_lines(self):
        """Returns the path (N, 3) with the largest possible margin. [m, world]"""
        for margin_m in MARGINS_M:
            path_m = astar(self.room, self.start_m, self.info.goal_m, self.low_m, self.high_m, margin_m=margin_m)
            if path_m is not None:
                return shorten(self.room, path_m, margin_m)
        raise RuntimeError(f"no way with {MARGINS_M[-1]} m of room")

    def plan_curve(self):
        """Returns the points (N, 3) of the fastest curve; `seconds, pieces` are the curve."""
        ends_m = self.start_m, self.info.goal_m, self.low_m, self.high_m
        fastest_s, best_m = np.inf, None
        for margin_m, seed in product(MARGINS_M, range(TREES)):
            path_m = rrt_star(self.room, *ends_m, nodes=NODES, seed=seed, margin_m=margin_m)
            if path_m is None:
                continue
            path_m = shorten(self.room, path_m, margin_m)
            laid = self.lay(path_m)
            if laid is not None and laid[0].sum() < fastest_s:
                fastest_s, best_m = laid[0].sum(), path_m
                self.seconds, self.pieces = laid
        if best_m is None:
            raise RuntimeError(f"no curve with {LEAST_M} m of room")
        return best_m

    def lay(self, path_m):
        return smooth(self.room, path_m, margin_m=LEAST_M, max_mps=CURVE_MPS, max_mps2=CURVE_MPS2, most_pieces=20)

    def on_image(self, obs):
        if not self.flying or obs.vehicle is None:
            return Setpoint.hold()
        return self.follow_curve(obs) if self.by_velocity else self.follow_lines()

    def follow_lines(self):
        if self.asked:
            return None
        self.asked = True
        return Setpoint.waypoints(*slow_corners(self.path_m))

    def follow_curve(self, obs):
        """Returns (7) with a term for the lag, and publishes the reference at the instant that the image shows."""
        vehicle, front = obs.vehicle, obs.camera("front")
        if self.seen_ns is None:
            # The curve begins at the vehicle.
            self.path_m[0] = vehicle.p_world_m
            self.seconds, self.pieces = self.lay(self.path_m) or (self.seconds, self.pieces)
            self.seen_ns = vehicle.stamp_ns
        # Wait for a vehicle that the guard slows down.
        self.at_s += self.pace * 1e-9 * (vehicle.stamp_ns - self.seen_ns)
        self.seen_ns = vehicle.stamp_ns
        off_m = self.reference(0.0) - vehicle.p_world_m
        ahead = self.reference(0.0, 1)
        lead_m = off_m @ ahead / max(float(np.linalg.norm(ahead)), 1e-6)
        self.pace = float(np.clip((STANDS_M - lead_m) / (STANDS_M - WAITS_M), 0.0, 1.0))

        if front is not None:
            shown_s = 1e-9 * (front.shown_ns - vehicle.stamp_ns)
            vizflyt.publish_odometry(front.shown_ns, self.reference(shown_s), vehicle.attitude_xyzw)
        v_mps = self.pace * self.reference(AHEAD_S, 1) + self.pace**2 * LAG_S * self.reference(AHEAD_S, 2)
        return Setpoint.velocity(v_mps + GAIN_PER_S * off_m)

    def reference(self, later_s, derivative=0):
        """Returns the reference after this time, or a derivative of it along the curve: shape (3,). [m/s^d, world]"""
        at_s = np.array([self.at_s + self.pace * later_s])
        return curve(self.seconds, self.pieces, at_s, derivative)[0]


if __name__ == "__main__":
    vizflyt.run(Planned)
