#!/usr/bin/env python3
"""Project 3: looks, flies forward a little, looks again, and lands; prints its detections. To do: the flight.

The network is `windows.onnx` next to this file, after you have trained one. It takes images (1, 120, 160, 3), colour
from 0 to 255, and returns (1, 4, 120, 160): a number for each pixel and class, 0 for the background, 1 to 3 for
windows.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from pathlib import Path

import numpy as np
from windows import F64, Seen, corners_of, side_of, square_pose

import vizflyt
from vizflyt import Setpoint

NETWORK = Path(__file__).parent / "windows.onnx"
# Time at rest at first; step length, number and speed of the steps. [s], [m], [m/s]
SETTLE_S, CREEP_M, LOOKS, SPEED_MPS = 1.0, 0.3, 2, 0.5

# One setpoint for each image; None keeps the previous one.
Steps = Generator[Setpoint | None, None, None]


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


class Network:
    """Classifies pixels by window; all 0 until a network is trained."""

    def __init__(self) -> None:
        self.session = None
        if not NETWORK.exists():
            print(f"there is no {NETWORK.name} yet, so no window is seen", flush=True)
            return
        # Imported here, so that the plugin also flies without it.
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(NETWORK, options, providers=["CPUExecutionProvider"])

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        """Returns 0 or a window's number for each pixel, (H / 2, W / 2), of an image (H, W, 3)."""
        rows, columns = rgb.shape[0] // 2, rgb.shape[1] // 2
        if self.session is None:
            return np.zeros((rows, columns), int)
        half = rgb.reshape(rows, 2, columns, 2, 3).mean(axis=(1, 3), dtype=np.float32)
        return self.session.run(None, {"images": half[None]})[0][0].argmax(axis=0)


class Mine(vizflyt.Plugin):
    """One flight. `_fly` goes through the states, and yields one reply for each image."""

    def on_start(self, info: vizflyt.ArenaInfo) -> None:
        self.network = Network()
        self.flying = False
        self.seen = -1
        self.next = 1
        self.yaw_rad: float | None = None
        self.steps = self._fly()

    def on_event(self, event: vizflyt.Event) -> None:
        self.flying |= event.details.get("phase") == "flying"
        self.next += event.kind == "stage"

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
        """To do: filters, the line through the next window, the turn to the one after it."""
        yield from self._for(SETTLE_S, Setpoint.hold())
        for _ in range(LOOKS):
            window = self._look()
            if window is not None:
                p_m, heading_deg = window.p_m, math.degrees(window.heading_rad)
                print(f"window {self.next}: {p_m[0]:.2f} m ahead, {p_m[1]:+.2f} m left, {p_m[2]:+.2f} m up, ", end="")
                print(f"{window.side_m:.2f} m wide, turned by {heading_deg:+.0f} degrees", flush=True)
            yield from self._for(CREEP_M / SPEED_MPS, Setpoint.velocity([SPEED_MPS, 0, 0], axes="heading"))
        yield from self._for(SETTLE_S, Setpoint.hold())

    def _for(self, seconds: float, setpoint: Setpoint) -> Steps:
        until_s = self.now_s + seconds
        while self.now_s < until_s:
            yield setpoint

    def _look(self) -> Seen | None:
        """Returns the next window in the axes `heading` of the flight's begin; None if not completely visible."""
        mask = self.network(self.front.rgb) == self.next
        level_from_cam = self._heading_from_cam()
        focal_px = self.front.intrinsics.fx_px / 2
        found = corners_of(mask, focal_px, level_from_cam)
        if found is None or np.isnan(found).any():
            return None
        side_m = side_of(found.hole, found.outline)
        return square_pose(found.hole, side_m, focal_px, (mask.shape[1], mask.shape[0]), level_from_cam)

    def _heading_from_cam(self) -> F64:
        """Returns the rotation (3, 3) from the front camera's axes to the axes `heading` of the flight's begin."""
        assert self.yaw_rad is not None
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        heading_from_world = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        return heading_from_world @ self.world_from_body @ self.front.body_from_cam.rotation_matrix


if __name__ == "__main__":
    vizflyt.run(Mine)
