"""Obstacles from depth images, kept on a map of the complete course, seen from above. No flight code.

Obstacles outside the image are kept, as in P. Florence, J. Carter, J. Ware and R. Tedrake, "NanoMap: fast,
uncertainty-aware proximity queries with lazy search over local 3D data" (ICRA 2018). Here the fence bounds a grid, and
trunks are vertical. Distances by two passes, along one axis, then along the other: P. Felzenszwalb and
D. Huttenlocher, "Distance transforms of sampled functions" (Theory of Computing 8, 2012).
"""

import numpy as np

CELL_M = 0.1  # a trunk is two to five cells wide
FAR_M = 18.0  # maximum range, where a column of pixels is 11 cm wide
SUPPORT = 3  # the third nearest pixel of a column counts, because two pixels may be noise
REACH = 12  # maximum distance [cells]
MOST_HITS = 6  # limit, so that a few images that see through a cell remove it
THROUGH_M = 0.4  # a surface this much further away means that the cell is free


class Rays:
    """Directions of a camera's pixels in every second row: shape (3, H / 2, W), with 1 along the axis. [cam]"""

    def __init__(self, intrinsics):
        v, u = np.meshgrid(np.arange(0, intrinsics.height_px, 2), np.arange(intrinsics.width_px), indexing="ij")
        x = (u + 0.5 - intrinsics.cx_px) / intrinsics.fx_px
        y = (v + 0.5 - intrinsics.cy_px) / intrinsics.fy_px
        self.cam = np.stack([x, y, np.ones_like(x)]).astype(np.float32)


def obstacles(depth_mm, rays, world_from_cam, camera_m, low_m, high_m):
    """Returns the nearest obstacle of each column of a depth image: shape (N, 2), from above. [m, world]

    `depth_mm` has shape (H, W), where 0 means no return; `world_from_cam` is a rotation (3, 3), `camera_m` (3,) the
    position of the camera. Points below `low_m` or above `high_m` are not obstacles. [m, world]
    """
    depth_m = depth_mm[::2].astype(np.float32) * np.float32(1e-3)
    turned = world_from_cam.astype(np.float32) @ rays.cam.reshape(3, -1)
    x_m, y_m, z_m = turned.reshape(rays.cam.shape) * depth_m
    range_m = np.hypot(x_m, y_m)
    height_m = z_m + np.float32(camera_m[2])
    is_none = (depth_m == 0) | (range_m > FAR_M) | (height_m < low_m) | (height_m > high_m)
    range_m[is_none] = np.inf
    row = np.argpartition(range_m, SUPPORT - 1, axis=0)[SUPPORT - 1]
    column = np.nonzero(np.isfinite(np.take_along_axis(range_m, row[None], axis=0)[0]))[0]
    row = row[column]
    return np.stack([x_m[row, column], y_m[row, column]], axis=1) + camera_m[:2]


class Map:
    """Observations on a grid from above: hits of each cell, minus the times that the camera saw through it."""

    def __init__(self, low_m, high_m):
        """Covers `low_m` (2,) to `high_m` (2,). [m, world]"""
        self.low_m = np.asarray(low_m, float)
        self.shape = tuple(np.ceil((np.asarray(high_m) - self.low_m) / CELL_M).astype(int))
        self.hits = np.zeros(self.shape, np.int8)
        self.from_m = np.zeros(2, int)
        self.distance_m = np.full(self.shape, REACH * CELL_M, np.float32)

    def cells(self, p_m):
        """Returns the cells of points (..., 2) [m, world], clipped to the grid."""
        cell = np.floor((p_m - self.low_m) / CELL_M).astype(np.intp)
        return np.clip(cell, 0, np.array(self.shape) - 1)

    def add(self, points_m):
        """Adds obstacles (N, 2), each cell once. [m, world]"""
        at = np.unique(np.ravel_multi_index(self.cells(points_m).T, self.shape))
        self.hits.flat[at] = np.minimum(self.hits.flat[at] + 1, MOST_HITS)

    def see_through(self, depth_mm, intrinsics, world_from_cam, camera_m, height_m):
        """Reduces cells at the flight height if the image shows a surface well behind them. [m, world]"""
        cell = np.argwhere(self.hits > 0)
        p_m = np.column_stack([self.low_m + (cell + 0.5) * CELL_M, np.full(len(cell), height_m)])
        p_cam_m = (p_m - camera_m) @ world_from_cam
        z_m = np.maximum(p_cam_m[:, 2], 1e-3)
        u = intrinsics.fx_px * p_cam_m[:, 0] / z_m + intrinsics.cx_px
        v = intrinsics.fy_px * p_cam_m[:, 1] / z_m + intrinsics.cy_px
        rows, columns = depth_mm.shape
        ahead = (p_cam_m[:, 2] > 0.3) & (u >= 3) & (v >= 0) & (u < columns - 3) & (v < rows)
        cell, z_m, u, v = cell[ahead], z_m[ahead], u[ahead].astype(int), v[ahead].astype(int)
        through = np.ones(len(cell), bool)
        for beside in (-3, 0, 3):  # one pixel next to a trunk's edge proves nothing
            through &= depth_mm[v, u + beside] * 1e-3 > z_m + THROUGH_M
        at = cell[through]
        self.hits[at[:, 0], at[:, 1]] -= 1

    def measure(self, p_m, ahead_m):
        """Computes the distance to the nearest obstacle in all cells from 2 m before `p_m` (2,) along x to `ahead_m`
        beyond. [m, world]"""
        first, last = self.cells(np.array([[p_m[0] - 2.0, 0.0], [p_m[0] + ahead_m, 0.0]]))[:, 0]
        first = max(first - REACH, 0)
        solid = self.hits[first : last + 1] > 0
        most = float(REACH * REACH)
        square = np.where(solid, np.float32(0), np.float32(most))
        for _ in range(2):  # along one axis, then along the other
            padded = np.pad(square, ((REACH, REACH), (0, 0)), constant_values=most)
            steps = range(-REACH, REACH + 1)
            shifted = [padded[REACH + n : REACH + n + len(square)] + np.float32(n * n) for n in steps]
            square = np.minimum(np.min(shifted, axis=0), most).T
        self.distance_m = np.full(self.shape, REACH * CELL_M, np.float32)
        self.distance_m[first : last + 1] = np.sqrt(square) * CELL_M

    def room_m(self, p_m):
        """Returns the distance from points (..., 2) [m, world] to the nearest obstacle's cell, up to 1.2 m. [m]"""
        cell = self.cells(p_m)
        return self.distance_m[cell[..., 0], cell[..., 1]]
