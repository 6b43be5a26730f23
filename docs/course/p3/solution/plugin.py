#!/usr/bin/env python3
"""Project 3: a network detects the windows in each image, filters track them, and the path follows their normals.

Window positions are relative to the plugin's dead reckoning: axes `odom` with the origin where the plugin got control,
x along the nose at that time, z up. The dead reckoning integrates the setpoints with the vehicle's lag.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from windows import F64, SIDE_M, SIDE_SD_M, Seen, WindowFilter, corners_of, noise, pose_of

import vizflyt
from vizflyt import Setpoint

# Input size of the network, and by how much its masks extend beyond a frame's edges, in its pixels.
COLUMNS, ROWS, EXCESS_PX = 160, 120, 1.3
# Minimum number of pixels of a mask at twice that size.
LEAST_PX = 150
# Maximum residual of a window's corners. [px]
MOST_OFF_PX = 3.0
# Standard deviation of the windows' rotation against the net; at most 20 degrees. [rad]
TURNED_RAD = 0.2
# Drift of the dead reckoning. [m in 1 s]
DRIFT_MPS = 0.12
# Lag of the velocity behind the setpoint. [s]
LAG_S = 0.35
# Prediction time for steering: delays, and most of the lag. [s]
AHEAD_S = 0.25
# Speed along the line through a window; maximum sideways speed, and its gain. [m/s], [m/s], [1/s]
CRUISE_MPS, SIDE_MPS, OFF_PER_S = 2.0, 1.3, 1.8
# Allowed offset from the line at the window, and its increase per metre before it.
NECK_M, FUNNEL = 0.12, 0.6
# Nearer than this, the nose turns to the next window. [m]
NEAR_M = 1.0
WINDOWS = 3


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


def about_up(angle_rad: float) -> F64:
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


class Network:
    """Classifies pixels by window."""

    def __init__(self, path: Path) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        """Returns 0 or a window's number for each pixel, (2 ROWS, 2 COLUMNS), of an image (H, W, 3)."""
        small = cv2.resize(rgb, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA).astype(np.float32)
        logits = self.session.run(None, {"images": small[None]})[0][0]
        # Interpolation between pixels gives the edge with sub-pixel accuracy.
        return np.argmax([cv2.resize(each, (2 * COLUMNS, 2 * ROWS)) for each in logits], axis=0)


class Window:
    """State of one window: its filter in `odom`, and the side of its opening."""

    def __init__(self, z: F64, R: F64) -> None:
        self.filter = WindowFilter(z, R)
        self.side_m, self.side_sd_m = SIDE_M, SIDE_SD_M

    def measured_side(self, side_m: float, sd_m: float) -> None:
        gain = self.side_sd_m**2 / (self.side_sd_m**2 + sd_m**2)
        self.side_m += gain * (side_m - self.side_m)
        # Errors of successive images are correlated, so the standard deviation has a lower limit.
        self.side_sd_m = max(math.sqrt(1 - gain) * self.side_sd_m, 0.02)

    @property
    def normal(self) -> F64:
        psi = self.filter.x[3]
        return np.array([math.cos(psi), math.sin(psi), 0.0])


class Race(vizflyt.Plugin):
    """State and steps of one flight."""

    def on_start(self, info: vizflyt.ArenaInfo) -> None:
        self.network = Network(Path(__file__).parent / "windows.onnx")
        self.windows: dict[int, Window] = {}
        self.next, self.seen, self.flying = 1, -1, False
        self.yaw_0_rad: float | None = None
        self.p_m, self.v_mps, self.asked_mps = np.zeros(3), np.zeros(3), np.zeros(3)
        self.last_s, self.search_s = 0.0, 0.0

    def on_event(self, event: vizflyt.Event) -> None:
        self.flying |= event.details.get("phase") == "flying"
        if event.kind == "stage":
            self.next += 1
            print(f"passed {self.next - 1}", flush=True)

    def on_image(self, obs: vizflyt.Observation) -> Setpoint | None:
        front, vehicle = obs.camera("front"), obs.vehicle
        if front is None or vehicle is None or front.seq == self.seen:
            return None
        self.seen = front.seq
        if not self.flying:
            return Setpoint.hold()
        now_s = front.shown_ns * 1e-9
        if self.yaw_0_rad is None:
            self.yaw_0_rad, self.last_s = vehicle.yaw_rad, now_s
        dt_s, self.last_s = min(now_s - self.last_s, 0.2), now_s
        self._reckon(dt_s)
        # The attitude is some milliseconds older than the image.
        turn = vehicle.omega_body_radps * (front.shown_ns - vehicle.stamp_ns) * 1e-9
        world_from_body = rotation(vehicle.attitude_xyzw) @ cv2.Rodrigues(turn)[0]
        odom_from_body = about_up(-self.yaw_0_rad) @ world_from_body
        self._look(front, odom_from_body, dt_s)
        yaw_rad = math.atan2(odom_from_body[1, 0], odom_from_body[0, 0])
        self.asked_mps, to_rad = self._steer(dt_s, yaw_rad)
        return Setpoint.velocity(about_up(-yaw_rad) @ self.asked_mps, axes="heading", yaw=self.yaw_0_rad + to_rad)

    def _reckon(self, dt_s: float) -> None:
        """Integrates the position: the velocity follows the setpoint with a lag."""
        share = 1 - math.exp(-dt_s / LAG_S)
        before = self.v_mps
        self.v_mps = before + share * (self.asked_mps - before)
        self.p_m = self.p_m + dt_s * (before + self.v_mps) / 2

    def _look(self, front: vizflyt.CameraImage, odom_from_body: F64, dt_s: float) -> None:
        """Updates the filters of this window and the next from the image."""
        for window in self.windows.values():
            window.filter.predict(dt_s, DRIFT_MPS)
        shown = self.network(front.rgb)
        odom_from_cam = odom_from_body @ front.body_from_cam.rotation_matrix
        camera_m = self.p_m + odom_from_body @ front.body_from_cam.translation_m
        focal_px = front.intrinsics.fx_px * 2 * COLUMNS / front.width_px
        for number in range(self.next, min(self.next + 2, WINDOWS + 1)):
            mask = shown == number
            if mask.sum() < LEAST_PX:
                continue
            corners = corners_of(mask, focal_px, odom_from_cam, 2 * EXCESS_PX)
            if corners is None:
                continue
            window = self.windows.get(number)
            side, heading = (SIDE_M, SIDE_SD_M), (0.0, TURNED_RAD)
            if window is not None:
                side = (window.side_m, window.side_sd_m)
                heading = (window.filter.x[3], max(math.sqrt(window.filter.P[3, 3]), 0.1))
            seen = pose_of(corners, focal_px, (2 * COLUMNS, 2 * ROWS), odom_from_cam, side, heading)
            if seen.off_px > MOST_OFF_PX:
                continue
            known = np.isfinite(corners.hole[:, 0]).sum() + np.isfinite(corners.outline[:, 0]).sum()
            side_sd_m = 0.05
            if front.depth_mm.any():
                seen = by_depth(seen, front, mask, odom_from_cam)
                side_sd_m = 0.03
            R = noise(seen.p_m, seen.side_m, focal_px) * (1.0 if known == 8 else 4.0)
            z = np.array([*(camera_m + seen.p_m), seen.heading_rad])
            if window is None or window.filter.rejected > 10:
                R[3, 3] = max(R[3, 3], 0.1**2)
                self.windows[number] = window = Window(z, R * 4)
            elif not window.filter.update(z, R):
                continue
            window.measured_side(seen.side_m, side_sd_m)

    def _steer(self, dt_s: float, yaw_rad: float) -> tuple[F64, float]:
        """Returns the next velocity [m/s, odom] and heading [rad, odom]."""
        if self.next > WINDOWS:
            return np.zeros(3), yaw_rad
        window = self.windows.get(self.next)
        if window is None:
            # Stay, and turn left and right.
            self.search_s += dt_s
            return np.zeros(3), 0.8 * math.sin(0.8 * self.search_s)
        self.search_s = 0.0
        p_m = self.p_m + self.v_mps * AHEAD_S
        to_m, n = window.filter.x[:3] - p_m, window.normal
        before_m = float(to_m @ n)
        off_m = to_m - before_m * n
        allowed_m = NECK_M + FUNNEL * max(before_m - 0.3, 0.0)
        share = float(np.clip(2 * (1 - np.linalg.norm(off_m) / allowed_m), -0.3 if 0.3 < before_m < 0.8 else 0.0, 1.0))
        if before_m < 0.3:
            share = 1.0
        side_mps = OFF_PER_S * off_m
        side_mps *= min(1.0, SIDE_MPS / max(float(np.linalg.norm(side_mps)), 1e-6))
        to = window
        if before_m < NEAR_M:
            to = self.windows.get(self.next + 1)
        if to is None:
            to_rad = float(window.filter.x[3])
        else:
            there_m = to.filter.x[:3] - self.p_m
            to_rad = math.atan2(there_m[1], there_m[0])
        return CRUISE_MPS * share * n + side_mps, to_rad


def by_depth(seen: Seen, front: vizflyt.CameraImage, mask: np.ndarray, odom_from_cam: F64) -> Seen:
    """Scales a window's distance and size by the depth of its bars."""
    rows, columns = np.nonzero(cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)))
    lens = front.intrinsics
    scale = front.width_px / (2 * COLUMNS)
    u_px, v_px = (columns + 0.5) * scale, (rows + 0.5) * scale
    depth_m = front.depth[v_px.astype(int), u_px.astype(int)]
    rays = np.column_stack([(u_px - lens.cx_px) / lens.fx_px, (v_px - lens.cy_px) / lens.fy_px, np.ones(len(u_px))])
    n = np.array([math.cos(seen.heading_rad), math.sin(seen.heading_rad), 0.0])
    told_m = (seen.p_m @ n) / (rays @ odom_from_cam.T @ n)
    is_told = (depth_m > 0.1) & (told_m > 0.1)
    if is_told.sum() < 20:
        return seen
    ratio = float(np.median(depth_m[is_told] / told_m[is_told]))
    return seen._replace(p_m=seen.p_m * ratio, side_m=float(np.clip(seen.side_m * ratio, 0.8, 1.6)))


if __name__ == "__main__":
    vizflyt.run(Race)
