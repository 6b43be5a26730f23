#!/usr/bin/env python3
"""Project 4: looks, flies forward a little, looks again, lands, and prints results of `gap.py`. To do: the flight."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from gap import F64, Gap, by_depth, by_motion, level

import vizflyt
from vizflyt import Setpoint

# Time to settle at the end of a path, in addition to length over speed. [s]
SETTLE_S = 1.0
# Length, number and speed of forward steps; length of a step to the side if there is no depth. [m], [m/s]
CREEP_M, LOOKS, SPEED_MPS, ASIDE_M = 0.4, 2, 0.6, 0.3

# One setpoint for each image; None keeps the previous one.
Steps = Generator[Setpoint | None, None, None]
Look = Generator[Setpoint | None, None, F64 | None]

# Axes of a level camera that looks forward (x right, y down, z forward), in axes `heading` (x forward, y left, z up).
HEADING_FROM_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


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


class Mine(vizflyt.Plugin):
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
        # Each image of the downward camera also contains the front camera's previous image.
        if front is None or vehicle is None or front.seq == self.seen:
            return None
        self.seen = front.seq
        if not self.flying:
            return Setpoint.hold()
        self.front, self.now_s = front, front.shown_ns * 1e-9
        if self.yaw_rad is None:
            self.yaw_rad = vehicle.yaw_rad
        self.world_from_body = rotation(vehicle.attitude_xyzw)
        return next(self.steps, Setpoint.land())

    def _fly(self) -> Steps:
        """To do: where to look again, when to decide, and how to return."""
        yield from self._rest(SETTLE_S)
        for _ in range(LOOKS):
            to_m = yield from self._look()
            if to_m is not None:
                print(f"gap {to_m[0]:.2f} m ahead, {to_m[1]:+.2f} m left, {to_m[2]:+.2f} m up", flush=True)
            yield from self._go(np.array([CREEP_M, 0, 0]), SPEED_MPS)

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
        """Returns the vector to the gap's middle, (3,) [m, heading]; None if there is no gap. Without depth it steps to
        the side for a second image, and stays there."""
        focal_px = self.front.intrinsics.fx_px
        if self.front.depth_mm.any():
            found = by_depth(self.front.depth, focal_px)
            return None if found is None else self._way(found, self._heading_from_cam())
        images = [self._level_image()]
        yield from self._go(np.array([0, -ASIDE_M, 0]), SPEED_MPS)
        images.append(self._level_image())
        found = by_motion(images, [0.0, ASIDE_M], focal_px)
        return None if found is None else self._way(found, HEADING_FROM_LEVEL) + np.array([0, ASIDE_M, 0])

    def _heading_from_cam(self) -> F64:
        """Returns the rotation (3, 3) from the front camera's axes to the axes `heading` of the flight's begin."""
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
        return heading_from_cam @ (ray * found.wall_m) + self.front.body_from_cam.translation_m


if __name__ == "__main__":
    vizflyt.run(Mine)
