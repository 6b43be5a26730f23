#!/usr/bin/env python3
"""Project 5: two windows, a gap, and a window with a turning hand, from colour; at level `ug` the gap from depth.

It looks at rest and flies straight paths between looks. Its position comes only from the requested paths: `home` are
level axes at the take-off position, x along the first heading, y left, z up. The nose always points along x. `gap.py`
is that of project 4.
"""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from gap import by_depth, by_motion, level
from hand import F64, HALF_WIDTH_M, angle_rad, follow, in_plane, start_s
from states import END, FIRST, TABLE, timed
from windows import Mask, Window, find_window, of_colour

import vizflyt
from vizflyt import Setpoint

# Order of the stages: windows by the colour of their bars.
ORDER = ("red", "blue", "gap", "orange")
# Usual width and height of an opening. [m]
SQUARE_M, WIDE_M = (1.17, 1.17), (1.375, 1.25)
# Speed of paths and passages; sideways for a look; past the hand. [m/s]
THERE_MPS, ASIDE_MPS, HAND_MPS = 1.4, 0.8, 2.0
# Time to settle at the end of a path, in addition to length over speed. [s]
SETTLE_S = 0.8
# The same for looks that compare images from several positions. [s]
STILL_S = 1.3
# Distance before a passage, and length behind it. Sideways steps come out longer than requested, so that the wall seems
# nearer than it is. Additional length if the passage is not complete at its end. [m]
STAND_M = {"red": 1.25, "blue": 1.25, "gap": 1.1, "orange": 1.35}
BEYOND_M = {"red": 0.45, "blue": 0.45, "gap": 0.75, "orange": 0.6}
ON_M = 0.4
# A detection from a larger distance is repeated from nearby. [m]
SURE_M = 1.7
# Positions of a look at the gap without depth: to the left of the first image. [m]
VIEWS_M = (0.35, -0.35)
# Minimum radius of the gap, and maximum distance of the wall. [m]
ENOUGH_M, WALL_M = 0.22, 3.0
# Maximum number of images with depth at one position.
PATIENCE = 15
# Positions for further looks if nothing was found: left and up of the take-off position, before the first passage also
# further back. [m, home]
ABOUT_M = ((0.3, 0.3), (-0.3, 0.1), (0.6, 0.1), (-0.6, 0.3))
BACK_M = 0.3
# Margin of the gap's detection, against areas that only look like the wall. [grey levels]
MARGIN = 1.0

# Distance of the hand in front of the window's middle. [m]
AHEAD_OF_WINDOW_M = 0.1
# Point to pass the hand: beside the axle, and above it. [m]
PAST_M = (0.32, 0.80)
# Radius of the vehicle, half of the hand's width, and a margin. [m]
ROOM_M = 0.12 + HALF_WIDTH_M + 0.08
# Angles use pixels at these distances from the axle, where only the hand is: a minimum number, and a maximum spread of
# their directions. [m], [px], [rad]. A rotation needs this number of angles, with pauses of at most this length. [s]
NEAR_AXLE_M, LEAST_PX, SPREAD_RAD = (0.1, 0.7), 30, 0.25
LEAST_ANGLES, PAUSE_S = 45, 0.3
# Additional time of a start from rest, and the speed that is reached; measured in flights. [s], [m/s]
START_S, REACHED_MPS = 0.65, 1.9
# Tolerance of the predicted time in the hand's plane: half of the vehicle's length, and errors. [s]
EARLY_S, LATE_S = 0.25, 0.3

Steps = Generator[Setpoint | None, None, bool]
Way = Generator[Setpoint | None, None, None]


def rotation(xyzw: F64) -> F64:
    """Returns the matrix (3, 3) of a unit quaternion."""
    x, y, z, w = xyzw
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


# Axes of a level camera that looks forward (x right, y down, z forward), in axes x forward, y left, z up.
HOME_FROM_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class Race(vizflyt.Plugin):
    """One flight. Each state of the table is a method that yields one reply for each image."""

    def on_start(self, info: vizflyt.ArenaInfo) -> None:
        self.flying = False
        self.seen = -1
        self.yaw_rad: float | None = None
        self.path = 0
        # Position by dead reckoning; number of passed stages. [m, home]
        self.at_m = np.zeros(3)
        self.passed = 0
        # Detections: point to fly through, and its distance at that time. [m, home], [m]
        self.places: dict[str, tuple[F64, float]] = {}
        self.window: Window | None = None
        self.looked = 0
        self.begun_s = 0.0
        self.steps = self._fly()

    def on_event(self, event: vizflyt.Event) -> None:
        self.flying |= event.details.get("phase") == "flying"
        if event.kind == "stage":
            self.passed = event.details["index"] + 1

    def on_image(self, obs: vizflyt.Observation) -> Setpoint | None:
        front, vehicle = obs.camera("front"), obs.vehicle
        if front is None or vehicle is None or front.seq == self.seen:
            return None
        self.seen = front.seq
        if not self.flying:
            return Setpoint.hold()
        self.front, self.now_s = front, front.shown_ns * 1e-9
        if self.yaw_rad is None:
            self.yaw_rad, self.begun_s = vehicle.yaw_rad, self.now_s
        self.world_from_body = rotation(vehicle.attitude_xyzw)
        return next(self.steps, Setpoint.hold())

    # ---- states

    def _fly(self) -> Way:
        states = {
            "search": self._search,
            "elsewhere": self._elsewhere,
            "approach": self._approach,
            "pass": self._pass,
            "next": self._next,
        }
        self.target = 0
        state = FIRST
        yield from self._rest(SETTLE_S)
        while state != END:
            print(f"{self.now_s - self.begun_s:.1f} s: {ORDER[self.target]}, {state}", flush=True)
            well = yield from timed(states[state](), TABLE[state].most_s, lambda: self.now_s)
            state = TABLE[state].well if well else TABLE[state].otherwise
            # The stage was passed without notice: look for the next one.
            if self.passed > self.target and state in ("search", "elsewhere"):
                state = "next"

    def _search(self) -> Steps:
        """Looks from here; uses an earlier detection if nothing is visible now."""
        what = ORDER[self.target]
        if what == "gap":
            # The complete wall is visible from the net's middle.
            if self.looked == 0:
                yield from self._go(np.array([self.at_m[0], 0.0, 0.2]), THERE_MPS, STILL_S)
            return (yield from self._look_for_gap())
        for soon in ORDER[self.target : self.target + 2]:
            self._look_for_window(soon)
        return what in self.places

    def _elsewhere(self) -> Steps:
        """Flies to another position for the next look."""
        self.places.pop(ORDER[self.target], None)
        left_m, up_m = ABOUT_M[self.looked % len(ABOUT_M)]
        # Passed stages are behind.
        back_m = BACK_M if self.target == 0 else 0.0
        self.looked += 1
        yield from self._go(np.array([self.at_m[0] - back_m, left_m, up_m]), THERE_MPS, STILL_S)
        return True

    def _approach(self) -> Steps:
        """Flies in front of the point, and looks again from there, until it was detected from nearby."""
        what = ORDER[self.target]
        for _ in range(4):
            place_m, _ = self.places[what]
            stand_m = place_m - [STAND_M[what], 0, 0]
            # Never fly back for this: near points were detected from nearby.
            stand_m[0] = max(stand_m[0], self.at_m[0] - 0.3)
            yield from self._go(stand_m, THERE_MPS)
            if what == "gap":
                return True
            if not self._look_for_window(what):
                return False
            if self._off_m(self.places[what][0] - [STAND_M[what], 0, 0]) < 0.05:
                break
        return True

    def _pass(self) -> Steps:
        """Flies straight through the point. Ends well if the runtime reports the stage."""
        what = ORDER[self.target]
        place_m, _ = self.places[what]
        before_m = self.at_m.copy()
        speed_mps = THERE_MPS
        if what == "orange":
            yield from self._wait_for_hand()
            speed_mps = HAND_MPS
        yield from self._go(np.array([place_m[0] + BEYOND_M[what], *place_m[1:]]), speed_mps, 0.5)
        if self.passed <= self.target:
            yield from self._go(self.at_m + np.array([ON_M, 0, 0]), ASIDE_MPS)
        if self.passed <= self.target:
            yield from self._go(before_m, ASIDE_MPS)
        return self.passed > self.target

    def _next(self) -> Steps:
        yield None
        self.looked = 0
        if self.target + 1 == len(ORDER):
            return False
        self.target += 1
        return True

    # ---- paths

    def _rest(self, seconds: float) -> Way:
        until_s = self.now_s + seconds
        while self.now_s < until_s:
            yield Setpoint.hold()

    def _go(self, to_m: F64, speed_mps: float, settle_s: float = SETTLE_S) -> Way:
        """Flies straight to a point [m, home], and waits until the vehicle is there."""
        self.path += 1
        from_m, by_m = self.at_m.copy(), to_m - self.at_m
        takes_s = max(float(np.linalg.norm(by_m)) / speed_mps, 0.01)
        begun_s = self.now_s
        path = Setpoint.waypoints([by_m], speed_mps, id=self.path, axes="heading", yaw=self.yaw_rad)
        # Returning the same path continues it, and holds at its end.
        while self.now_s < begun_s + takes_s + settle_s:
            self.at_m = from_m + by_m * min((self.now_s - begun_s) / takes_s, 1.0)
            yield path
        self.at_m = to_m.copy()

    def _off_m(self, place_m: F64) -> float:
        """Returns the distance to a point, sideways and vertically. [m]"""
        return float(np.hypot(*(place_m - self.at_m)[1:]))

    # ---- looks

    def _home_from_cam(self) -> F64:
        assert self.yaw_rad is not None
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        home_from_world = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        return home_from_world @ self.world_from_body @ self.front.body_from_cam.rotation_matrix

    def _camera_m(self) -> F64:
        """Returns the position of the camera. [m, home]"""
        return self.at_m + self.front.body_from_cam.translation_m

    def _look_for_window(self, colour: str) -> bool:
        """Stores the point to fly through a window, if the window is in the image."""
        if colour == "gap":
            return False
        mask: Mask = of_colour(self.front.rgb, colour)
        square = colour != "orange"
        cam_from_home = self._home_from_cam().T
        found = find_window(mask, cam_from_home, self.front.intrinsics.fx_px, square, SQUARE_M if square else WIDE_M)
        if found is None:
            return False
        place_m = self._camera_m() + found.middle_m
        if not square:
            self.window = found._replace(middle_m=place_m)
            place_m = self._past_hand(self.window)
        self.places[colour] = (place_m, float(found.middle_m[0]))
        print(f"{colour} {np.round(place_m - self.at_m, 2)} m from here, score {found.score:.2f}", flush=True)
        return True

    def _look_for_gap(self) -> Steps:
        focal_px = self.front.intrinsics.fx_px
        if self.front.depth_mm.any():
            for _ in range(PATIENCE):
                found = by_depth(self.front.depth, focal_px)
                if found is not None and found.room_m > ENOUGH_M:
                    break
                yield None
            home_from_cam = self._home_from_cam()
            camera_m = self._camera_m()
        else:
            home_from_cam, camera_m = HOME_FROM_LEVEL, self._camera_m()
            images, left_m = [self._level_image()], [0.0]
            begun_m = self.at_m.copy()
            for view_m in VIEWS_M:
                yield from self._go(begun_m + np.array([0, view_m, 0]), ASIDE_MPS, STILL_S)
                images.append(self._level_image())
                left_m.append(view_m)
            found = by_motion(images, [-m for m in left_m], focal_px, MARGIN)
        if found is None or found.room_m < ENOUGH_M or found.wall_m > WALL_M:
            return False
        lens = self.front.intrinsics
        ray = np.array([(found.u_px - lens.cx_px) / lens.fx_px, (found.v_px - lens.cy_px) / lens.fy_px, 1.0])
        place_m = camera_m + home_from_cam @ (ray * found.wall_m)
        print(f"gap {np.round(place_m - self.at_m, 2)} m from here, {found.room_m:.2f} m of room", flush=True)
        self.places["gap"] = (place_m, found.wall_m)
        return True

    def _level_image(self) -> F64:
        level_from_cam = HOME_FROM_LEVEL.T @ self._home_from_cam()
        return level(self.front.rgb, self.front.intrinsics.fx_px, level_from_cam)

    # ---- the hand

    def _axle_m(self, window: Window) -> F64:
        """Returns the position of the hand's axle. [m, home]"""
        ahead = np.array([np.cos(window.facing_rad), np.sin(window.facing_rad), 0.0])
        return window.middle_m - AHEAD_OF_WINDOW_M * ahead - [0, 0, window.size_m[1] / 2]

    def _past_hand(self, window: Window) -> F64:
        """Returns the point in the hand's plane to fly through, on the vehicle's side. [m, home]"""
        right = np.array([np.sin(window.facing_rad), -np.cos(window.facing_rad), 0.0])
        axle_m = self._axle_m(window)
        side = 1.0 if (self.at_m - axle_m) @ right > 0 else -1.0
        return axle_m + side * PAST_M[0] * right + [0, 0, PAST_M[1]]

    def _angle(self, window: Window) -> float | None:
        """Returns the hand's angle in this image; None if too little of it is visible."""
        v, u = np.nonzero(of_colour(self.front.rgb, "teal"))
        if len(u) < LEAST_PX:
            return None
        lens = self.front.intrinsics
        rays = np.stack(
            [(u + 0.5 - lens.cx_px) / lens.fx_px, (v + 0.5 - lens.cy_px) / lens.fy_px, np.ones(len(u))], axis=1
        )
        axle_m = self._axle_m(window) - self._camera_m()
        points_m = in_plane(rays @ self._home_from_cam().T, axle_m, window.facing_rad)
        rho_m = np.hypot(*points_m.T)
        points_m = points_m[(rho_m > NEAR_AXLE_M[0]) & (rho_m < NEAR_AXLE_M[1])]
        if len(points_m) < LEAST_PX:
            return None
        theta_rad = angle_rad(points_m)
        # Other teal objects, far behind, are not on the hand's line.
        across_m = points_m @ np.array([-np.sin(theta_rad), np.cos(theta_rad)])
        off_rad = np.arctan2(across_m, points_m @ np.array([np.cos(theta_rad), np.sin(theta_rad)]))
        return theta_rad if float(np.std(off_rad)) < SPREAD_RAD else None

    def _wait_for_hand(self) -> Way:
        """Waits until the start."""
        assert self.window is not None
        window = self.window
        off_m = self.places["orange"][0] - self._axle_m(window)
        right = np.array([np.sin(window.facing_rad), -np.cos(window.facing_rad), 0.0])
        place_m = np.array([off_m @ right, off_m[2]])
        at_s: list[float] = []
        angles_rad: list[float] = []
        turning = None
        takes_s = START_S + (self.places["orange"][0] - self.at_m)[0] / REACHED_MPS
        self.path += 1
        here = Setpoint.waypoints([[0, 0, 0]], 0.5, id=self.path, axes="heading", yaw=self.yaw_rad)
        while True:
            theta_rad = self._angle(window)
            if theta_rad is not None:
                # While out of sight, the hand may have turned by any angle, so discard earlier angles.
                if at_s and self.now_s - at_s[-1] > PAUSE_S:
                    at_s, angles_rad = [], []
                at_s.append(self.now_s)
                angles_rad.append(theta_rad)
                if len(at_s) >= LEAST_ANGLES:
                    turning = follow(np.array(at_s), np.array(angles_rad))
            if turning is not None:
                start = start_s(turning, place_m, ROOM_M, self.now_s, takes_s, EARLY_S, LATE_S)
                if start is not None and start < self.now_s + 0.02:
                    omega_deg_s = np.degrees(turning.omega_radps)
                    print(f"hand at {np.degrees(turning.at(self.now_s)):.0f} deg, {omega_deg_s:.1f} deg/s", flush=True)
                    return
            yield here


if __name__ == "__main__":
    vizflyt.run(Race)
