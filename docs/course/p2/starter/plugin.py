"""Project 2: plans on the ground, and flies the points in the air. Runs at both levels without changes."""

import numpy as np
import planner

import vizflyt
from vizflyt import Setpoint

MARGIN_M = 0.3  # planned clearance
SPEED_MPS = 1.0  # on the way to each point


def box_of(volume, near_m):
    """Returns the low and the high corner of a box with sides along the axes, from a point (3,) near it. [m, world]"""
    away_m = 10_000.0
    probes_m = away_m * np.eye(3)  # far out on an axis, the distance to the box is the distance to one face
    low_m = near_m - away_m + volume.signed_distance_m(near_m - probes_m)
    return low_m, near_m + away_m - volume.signed_distance_m(near_m + probes_m)


class PathPlanner(vizflyt.Plugin):
    def on_start(self, info):
        self.info, self.map = info, vizflyt.course_map()
        self.low_m, self.high_m = box_of(info.geofence, info.goal_m)
        # There is no pose yet. Take-off ends above the middle of the start box.
        low_m, high_m = box_of(info.start_box, self.low_m)
        start_m = np.array([*(low_m + high_m)[:2] / 2, info.takeoff_height_m])
        self.flying = self.asked = False

        line_m = np.linspace(start_m, info.goal_m, 200)
        print(f"{len(self.map)} obstacles; least room on the straight line: {self.room(line_m).min():.2f} m")
        path_m = planner.astar(self.room, start_m, info.goal_m, self.low_m, self.high_m, margin_m=MARGIN_M)
        if path_m is None:
            raise RuntimeError(f"there is no way with {MARGIN_M} m of room")
        self.path_m = planner.shorten(self.room, path_m, MARGIN_M)
        print(f"a path of {len(path_m)} points, {planner.length_m(path_m):.2f} m")
        print(f"shortened to {len(self.path_m)} points, {planner.length_m(self.path_m):.2f} m")

    def room(self, points_m):
        """Returns the clearance of the body's centre at points (N, 3), with the fence: shape (N,). [m]"""
        solid_m = np.min([volume.signed_distance_m(points_m) for volume in self.map], axis=0)
        inside_m = -self.info.geofence.signed_distance_m(points_m)
        return np.minimum(solid_m, inside_m) - self.info.body_radius_m

    def on_event(self, event):
        self.flying |= event.details.get("phase") == "flying"

    def on_image(self, obs):
        if not self.flying:
            return Setpoint.hold()
        if self.asked:
            return None  # the path stays in force
        self.asked = True
        return Setpoint.waypoints(self.path_m[1:], SPEED_MPS)


if __name__ == "__main__":
    vizflyt.run(PathPlanner)
