"""Project 3: window corners from a mask, window pose from corners, and a filter over images.

Pixels are continuous: (0, 0) is the outer corner of the top-left pixel, and the camera's axis goes through the middle
of the image. The camera's axes are x right, y down, z forward. *Level* axes have their origin at the camera, with z up;
the caller chooses the direction of x, and `level_from_cam` (3, 3) rotates the camera's directions into them. The order
of corners is upper left, upper right, lower right, lower left in the direction of passage; NaN is an unknown corner.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]

# Bars of a frame: width, and thickness along the passage. [m]
BAR_M, THICK_M = 0.16, 0.09
# Given for all windows: side of the opening, and its standard deviation. [m]
SIDE_M, SIDE_SD_M = 1.175, 0.1
# Left and up coordinates of the corners of a square with side 2.
SQUARE = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
# Standard deviation of a corner, which is the intersection of two lines. [px]
NOISE_PX = 0.7
# 99 % quantile of the squared distance of four numbers.
BEYOND_CHANCE = 13.3


class Corners(NamedTuple):
    """Corners of a window in an image, (4, 2) each, NaN if unknown. [px]"""

    hole: F64
    outline: F64


class Seen(NamedTuple):
    """A window detected in one image."""

    p_m: F64
    """Middle of the opening, (3,). [m, level]"""
    heading_rad: float
    """Direction of passage, counter-clockwise about up from x. [rad, level]"""
    side_m: float
    """Side of the opening."""
    off_px: float
    """Root mean square of the corners' residuals. [px]"""


# -- From a mask to corners --------------------------------------------------------------------------------------------


def corners_of(
    mask: npt.NDArray[np.bool_], focal_px: float, level_from_cam: F64, excess_px: float = 0.0
) -> Corners | None:
    """Finds the corners of one window's frame in its mask (H, W); None if too little of it is visible.

    The mask extends beyond the frame's edges by `excess_px`. A corner is the intersection of two neighbouring sides, so
    hidden corners and corners just outside the image are also found.
    """
    parts, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if parts < 2:
        return None
    areas = stats[:, cv2.CC_STAT_AREA]
    kept = [n for n in range(1, parts) if areas[n] >= max(30, 0.1 * areas[1:].max())]
    if not kept:
        return None
    frame = np.isin(labels, kept)
    outer = np.concatenate(cv2.findContours(frame.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0])
    hull = cv2.convexHull(outer)
    within = np.zeros(mask.shape, np.uint8)
    cv2.fillConvexPoly(within, hull, 1)
    found, labels, stats, _ = cv2.connectedComponentsWithStats(((within > 0) & ~frame).astype(np.uint8), connectivity=4)
    hole = np.full((4, 2), np.nan)
    if found > 1:
        largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
        edge = max(
            cv2.findContours((labels == largest).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0], key=len
        )
        # The line that closes a partly visible frame is not a side, because it does not lie along the frame.
        near = cv2.dilate(frame.astype(np.uint8), np.ones((3, 3), np.uint8))
        along = edge[near[edge[:, 0, 1], edge[:, 0, 0]] > 0]
        hole = _corners(along, edge, mask.shape, focal_px, level_from_cam, 0.5 + excess_px)
    outline = _corners(outer, hull, mask.shape, focal_px, level_from_cam, 0.5 - excess_px)
    corners = Corners(hole, outline)
    known = np.isfinite(corners.hole[:, 0]).sum() + np.isfinite(corners.outline[:, 0]).sum()
    return corners if known >= 3 else None


def _corners(
    pixels: npt.NDArray[np.int32],
    contour: npt.NDArray[np.int32],
    shape: tuple[int, ...],
    focal_px: float,
    level_from_cam: F64,
    outwards_px: float,
) -> F64:
    """Returns the intersections of neighbouring sides of a region, (4, 2), from its valid outermost pixels (N, 1, 2).

    The sides are detected along `contour` (M, 1, 2). The region's true edge is `outwards_px` outside of the pixels'
    centres.
    """
    rows, columns = shape
    nan = np.full((4, 2), np.nan)
    points = pixels[:, 0, :].astype(np.float64) + 0.5
    is_inside = (points > 1.6).all(1) & (points[:, 0] < columns - 1.6) & (points[:, 1] < rows - 1.6)
    polygon = cv2.approxPolyDP(contour, 2.0, True)[:, 0, :].astype(np.float64) + 0.5
    points = points[is_inside]
    if len(points) < 8 or len(polygon) < 3:
        return nan
    middle = polygon.mean(0)
    # The longest valid line of each side (left, top, right, bottom).
    best: dict[str, tuple[float, F64]] = {}
    for a, b in zip(polygon, np.roll(polygon, -1, 0)):
        long_px = float(np.hypot(*(b - a)))
        if long_px < 5:
            continue
        line = _line(points, a, (b - a) / long_px, long_px, middle)
        if line is None:
            continue
        line[2] += outwards_px
        # The plane through camera and line is vertical for left and right sides, otherwise not.
        at_axis = line @ [columns / 2, rows / 2, 1.0]
        normal = level_from_cam @ np.array([line[0] * focal_px, line[1] * focal_px, at_axis])
        normal /= np.linalg.norm(normal)
        if abs(normal[2]) < 0.22:
            name = "left" if line[0] > 0 else "right"
        elif abs(line[1]) > 0.5:
            name = "top" if line[1] > 0 else "bottom"
        else:
            continue
        if name not in best or best[name][0] < long_px:
            best[name] = (long_px, line)
    corners = nan
    for n, (upright, level) in enumerate((("left", "top"), ("right", "top"), ("right", "bottom"), ("left", "bottom"))):
        if upright in best and level in best:
            at = np.cross(best[upright][1], best[level][1])
            if abs(at[2]) > 1e-6:
                at = at[:2] / at[2]
                margin_px = 0.12 * columns
                if (at > -margin_px).all() and (at < [columns + margin_px, rows + margin_px]).all():
                    corners[n] = at
    return corners


def _line(points: F64, start: F64, along: F64, long_px: float, middle: F64) -> F64 | None:
    """Fits a line to the points along an edge. Returns (a, b, c), a u + b v + c = 0, positive on `middle`'s side."""
    across = np.array([-along[1], along[0]])
    for _ in range(2):
        s, d = (points - start) @ along, (points - start) @ across
        # Exclude the ends, because corners are round.
        cut_px = min(3.0, 0.15 * long_px)
        near = points[(abs(d) < 2.0) & (s > cut_px) & (s < long_px - cut_px)]
        if len(near) < max(4, 0.35 * long_px):
            return None
        u, v, x, y = cv2.fitLine(near.astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.01)[:, 0].astype(np.float64)
        turned = np.array([u, v]) * np.sign(u * along[0] + v * along[1])
        start = np.array([x, y]) + turned * ((start - [x, y]) @ turned)
        along, across = turned, np.array([-turned[1], turned[0]])
    line = np.array([across[0], across[1], -across @ start])
    return line if line @ [*middle, 1.0] > 0 else -line


# -- From corners to a pose --------------------------------------------------------------------------------------------


def side_of(hole_px: F64, outline_px: F64) -> float:
    """Returns the side of the opening [m] from the corners of hole and outline, (4, 2) each [px], by equation (5)."""
    carried, _ = cv2.findHomography(hole_px, SQUARE)
    out = np.column_stack([outline_px, np.ones(4)]) @ carried.T
    q = float(abs(out[:, :2] / out[:, 2:]).mean())
    return 2 * BAR_M / (q - 1)


def square_pose(
    corners_px: F64, side_m: float, focal_px: float, size_px: tuple[int, int], level_from_cam: F64
) -> Seen:
    """Returns the pose of a vertical square with a known side, from its corners (4, 2) in an image of size (W, H)."""
    unknown = np.full((4, 2), np.nan)
    return _solve(Corners(corners_px, unknown), focal_px, size_px, level_from_cam, (side_m, 1e-6), None, 0.0)


def pose_of(
    corners: Corners,
    focal_px: float,
    size_px: tuple[int, int],
    level_from_cam: F64,
    side_m: tuple[float, float] = (SIDE_M, SIDE_SD_M),
    heading_rad: tuple[float, float] | None = None,
) -> Seen:
    """Returns the window with these corners; at least three of the eight must be known.

    Prior values of side [m] and heading [rad, level] are given with their standard deviations.
    """
    return _solve(corners, focal_px, size_px, level_from_cam, side_m, heading_rad, THICK_M)


def _solve(
    corners: Corners,
    focal_px: float,
    size_px: tuple[int, int],
    level_from_cam: F64,
    side: tuple[float, float],
    heading: tuple[float, float] | None,
    thick_m: float,
) -> Seen:
    """Least squares for position, heading and side by Gauss-Newton, from several headings. Returns the best result."""
    seen_px = np.concatenate([corners.hole, corners.outline])
    is_known = np.isfinite(seen_px).all(1)
    seen_px = seen_px[is_known]
    middle_px = np.array(size_px) / 2
    cam_from_level = level_from_cam.T
    inner = np.array([True] * 4 + [False] * 4)[is_known]
    square = np.concatenate([SQUARE, SQUARE])[is_known]

    def project(x: F64, face_m: float) -> F64:
        half_m = x[4] / 2 + np.where(inner, 0.0, BAR_M)
        cos, sin = math.cos(x[3]), math.sin(x[3])
        left_m = square[:, 0] * half_m
        off = [face_m * cos - left_m * sin, face_m * sin + left_m * cos, square[:, 1] * half_m]
        cam = (x[:3] + np.column_stack(off)) @ cam_from_level.T
        return focal_px * cam[:, :2] / np.maximum(cam[:, 2:], 0.05) + middle_px

    # Left and upper edges have the smallest u and v; the visible face of the hole is the one that covers more.
    wants_greater = np.column_stack([square[:, 0] > 0, square[:, 1] > 0]) == inner[:, None]

    def residual(x: F64) -> F64:
        if thick_m > 0:
            front, back = project(x, -thick_m / 2), project(x, thick_m / 2)
            at_px = np.where(wants_greater, np.maximum(front, back), np.minimum(front, back))
        else:
            at_px = project(x, 0.0)
        off = [((at_px - seen_px) / NOISE_PX).ravel(), [(x[4] - side[0]) / side[1]]]
        if heading is not None:
            off.append([_wrapped(x[3] - heading[0]) / heading[1]])
        return np.concatenate(off)

    # Start on the ray through the middle, at the distance given by the corners' spread.
    ray = level_from_cam @ np.array([*((seen_px.mean(0) - middle_px) / focal_px), 1.0])
    half_m = side[0] / 2 + np.where(inner, 0.0, BAR_M)
    spread_m = square[:, 1] * half_m
    spread_px = np.ptp(seen_px[:, 1])
    away = focal_px * max(np.ptp(spread_m), 0.3) / max(spread_px, 3.0)
    bearing = math.atan2(ray[1], ray[0])
    starts = [bearing + d for d in (-0.5, 0.0, 0.5)] if heading is None or heading[1] > 0.1 else [heading[0]]
    best: tuple[float, F64] | None = None
    for start in starts:
        x = np.array([*(ray * away), start, side[0]])
        # If some corners are unknown, the mean of the known ones is not the middle.
        left_m = float(np.mean(square[:, 0] * half_m))
        x[:3] -= [-left_m * math.sin(start), left_m * math.cos(start), np.mean(spread_m)]
        r = residual(x)
        damping = 1e-3
        for _ in range(15):
            jacobian = np.column_stack([(residual(x + d) - r) / 1e-4 for d in 1e-4 * np.eye(5)])
            normal = jacobian.T @ jacobian
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)) + 1e-9 * np.eye(5), -jacobian.T @ r)
            step /= max(1.0, abs(step[3]) / 0.4, np.linalg.norm(step[:3]) / 2.0)
            tried = residual(x + step)
            if tried @ tried <= r @ r:
                x, r, damping = x + step, tried, damping / 5
                if abs(step).max() < 1e-4:
                    break
            else:
                damping *= 8
        if best is None or r @ r < best[0]:
            best = (float(r @ r), x)
    x = best[1]
    off_px = NOISE_PX * float(np.sqrt(np.mean(residual(x)[: 2 * len(seen_px)] ** 2)))
    return Seen(x[:3], _wrapped(x[3]), float(x[4]), off_px)


def _wrapped(angle_rad: float) -> float:
    """Returns the equivalent angle in [-pi, pi). [rad]"""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


# -- A filter over images ----------------------------------------------------------------------------------------------


def noise(p_m: F64, side_m: float, focal_px: float, noise_px: float = NOISE_PX) -> F64:
    """Returns the covariance (4, 4) of position [m] and heading [rad] of a window detected at `p_m` [m, level].

    (4), plus 1 % of the distance and 0.03 rad for errors that (4) does not contain.
    """
    z = float(np.linalg.norm(p_m))
    ray = p_m / z
    aside_m = z * noise_px / (2 * focal_px) + 0.01 * z
    ahead_m = z**2 * noise_px / (focal_px * side_m) + 0.01 * z
    covariance = np.zeros((4, 4))
    covariance[:3, :3] = aside_m**2 * np.eye(3) + (ahead_m**2 - aside_m**2) * np.outer(ray, ray)
    covariance[3, 3] = (2 * z**2 * noise_px / (focal_px * side_m**2)) ** 2 + 0.03**2
    return covariance


class WindowFilter:
    """One window in fixed axes: x = (p, psi) (4,) [m, m, m, rad], P (4, 4), by equations (6)."""

    def __init__(self, x: F64, P: F64) -> None:
        self.x, self.P = np.array(x, float), np.array(P, float)
        self.rejected = 0

    def predict(self, dt_s: float, drift: float) -> None:
        """Adds the drift of the dead reckoning: `drift` m in the first second; squares add up; heading a tenth."""
        self.P = self.P + np.diag([1.0, 1.0, 1.0, 0.01]) * drift**2 * dt_s

    def update(self, z: F64, R: F64) -> bool:
        """Applies a measurement z (4,) with covariance R (4, 4). Returns False and ignores it if it is an outlier."""
        e = z - self.x
        e[3] = _wrapped(e[3])
        S = self.P + R
        if e @ np.linalg.solve(S, e) > BEYOND_CHANCE:
            self.rejected += 1
            return False
        self.rejected = 0
        gain = np.linalg.solve(S.T, self.P.T).T
        self.x = self.x + gain @ e
        self.P = (np.eye(4) - gain) @ self.P
        self.P = (self.P + self.P.T) / 2
        return True
