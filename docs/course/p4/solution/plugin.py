#!/usr/bin/env python3
"""Project 4: looks for the gap, flies in front of it, looks again from there, and flies through.

With depth (`ug`), a look is one image at rest. Without depth (`g`), a look is a step to both sides: points far behind
the wall move less in the image than the wall. The position comes only from the requested steps.
"""

from __future__ import annotations

import itertools
from collections.abc import Generator

import numpy as np
from gap import F64, Gap, by_depth, by_motion, level

import vizflyt
from vizflyt import Setpoint

# Distance from the wall at the last look, and distance behind it at the end of the path. [m]
STAND_M, BEYOND_M = 1.7, 0.9
# From this distance it flies straight, along the middle of the gap. [m]
NEAR_M = 1.2
# Speed to the wall, through the gap, and sideways for a look. [m/s]
THERE_MPS, THROUGH_MPS, ASIDE_MPS = 1.2, 1.2, 0.8
# Time to settle at the end of a path, in addition to length over speed. [s]
SETTLE_S = 1.0
# Positions of a look without depth: to the left of the first image. [m]
VIEWS_M = (0.35, -0.35)
# Minimum radius for a passage: the vehicle, a margin, and errors of path and wall. [m]
ENOUGH_M = 0.22
# Maximum number of images with depth at one position.
PATIENCE = 15
# Positions for further looks if nothing was found: steps that end at the start. [m, heading]
ABOUT_M = ((-0.4, 0.0, 0.3), (0.0, 0.5, 0.0), (0.0, -1.0, 0.0), (0.4, 0.5, -0.3))

Steps = Generator[Setpoint | None, None, None]
Look = Generator[Setpoint | None, None, F64 | None]


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
HEADING_FROM_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class Through(vizflyt.Plugin):
    """One flight. `_fly` goes through the states, and yields one reply for each image."""

    def on_start(self, info: vizflyt.ArenaInfo) -> None:
        self.flying = False
        self.seen = -1
        self.yaw_rad: float | None = None
        self.path = 0
        self.steps = self._fly()

    def on_event(self, event: vizflyt.Event) -> None:
        self.flying |= event.details.get("phase") == "flying"

    def on_image(self, obs: vizflyt.Observation) -> Setpoint | None:
        front, vehicle = obs.camera("front"), obs.vehicle
        if front is None or vehicle is None or front.seq == self.seen:
            return None
        self.seen = front.seq
        if not self.flying:
            return Setpoint.hold()
        self.front, self.now_s = front, front.shown_ns * 1e-9
        if self.yaw_rad is None:
            self.yaw_rad = vehicle.yaw_rad
        self.world_from_body = rotation(vehicle.attitude_xyzw)
        return next(self.steps, Setpoint.hold())

    def _fly(self) -> Steps:
        yield from self._rest(SETTLE_S)
        about_m = itertools.cycle(ABOUT_M)
        while True:
            to_m = yield from self._look()
            if to_m is None:
                print("no gap seen, looking about", flush=True)
                yield from self._go(np.array(next(about_m)), ASIDE_MPS)
                continue
            print(f"gap {to_m[0]:.2f} m ahead, {to_m[1]:+.2f} m left, {to_m[2]:+.2f} m up", flush=True)
            if to_m[0] < STAND_M + 0.3:
                break
            yield from self._go(to_m - [STAND_M, 0, 0], THERE_MPS)
        # First to a point in front of the middle, then straight.
        before_m = np.array([max(to_m[0] - NEAR_M, 0.0), to_m[1], to_m[2]])
        yield from self._go(before_m, THERE_MPS)
        print("through", flush=True)
        yield from self._go(np.array([to_m[0] - before_m[0] + BEYOND_M, 0, 0]), THROUGH_MPS)

    def _rest(self, seconds: float) -> Steps:
        until_s = self.now_s + seconds
        while self.now_s < until_s:
            yield Setpoint.hold()

    def _go(self, by_m: F64, speed_mps: float) -> Steps:
        """Flies a straight path [m, heading], and waits until the vehicle is at rest at its end."""
        self.path += 1
        until_s = self.now_s + float(np.linalg.norm(by_m)) / speed_mps + SETTLE_S
        path = Setpoint.waypoints([by_m], speed_mps, id=self.path, axes="heading", yaw=self.yaw_rad)
        # Returning the same path continues it, and holds at its end. With None the vehicle would stop 0.5 s later.
        while self.now_s < until_s:
            yield path

    def _look(self) -> Look:
        """Returns the vector to the gap's middle, (3,) [m, heading]; None if there is no gap."""
        if self.front.depth_mm.any():
            for _ in range(PATIENCE):
                found = by_depth(self.front.depth, self.front.intrinsics.fx_px)
                if found is not None and found.room_m > ENOUGH_M:
                    return self._way(found, self._heading_from_cam())
                yield None
            return None
        images, left_m = [self._level_image()], [0.0]
        for view_m in VIEWS_M:
            yield from self._go(np.array([0, view_m - left_m[-1], 0]), ASIDE_MPS)
            images.append(self._level_image())
            left_m.append(view_m)
        found = by_motion(images, [-m for m in left_m], self.front.intrinsics.fx_px)
        if found is None or found.room_m < ENOUGH_M:
            yield from self._go(np.array([0, -left_m[-1], 0]), ASIDE_MPS)
            return None
        return self._way(found, HEADING_FROM_LEVEL) - [0, left_m[-1], 0]

    def _heading_from_cam(self) -> F64:
        assert self.yaw_rad is not None
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        heading_from_world = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        return heading_from_world @ self.world_from_body @ self.front.body_from_cam.rotation_matrix

    def _level_image(self) -> F64:
        level_from_cam = HEADING_FROM_LEVEL.T @ self._heading_from_cam()
        return level(self.front.rgb, self.front.intrinsics.fx_px, level_from_cam)

    def _way(self, found: Gap, heading_from_cam: F64) -> F64:
        lens = self.front.intrinsics
        ray = np.array([(found.u_px - lens.cx_px) / lens.fx_px, (found.v_px - lens.cy_px) / lens.fy_px, 1.0])
        mount_m = self.front.body_from_cam.translation_m
        return heading_from_cam @ (ray * found.wall_m) + mount_m


if __name__ == "__main__":
    vizflyt.run(Through)
