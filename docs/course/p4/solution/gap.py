"""Project 4: the gap, from one image with depth, or from colour images of a sideways flight.

Images are (H, W) or (H, W, 3). The camera's axes are x right, y down, z forward; its axis goes through the middle of
the image. Pixels are continuous: (0, 0) is the outer corner of the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# Maximum distance of a point from the wall: a constant, and a fraction of its range. [m], [1]
NEAR_M, NEAR_SHARE = 0.04, 0.01
# A ray that ends this far behind the wall's front has passed through it; the wall is 0.12 m thick. [m]
BEHIND_M = 0.35
# Number of tried planes, and minimum cosine between the wall's normal and the camera's axis.
DRAWS, FACING = 150, 0.8
# Size of a cell of the wall. [m]
CELL_M = 0.03
# Minimum radius of a gap: the vehicle's radius plus 5 cm. [m]
LEAST_ROOM_M = 0.17

# Range and number of tried distances of the wall, uniform in 1 / Z. [m]
NEAREST_M, FARTHEST_M, DEPTHS = 0.9, 16.0, 56
# Points with less than this fraction of the wall's 1 / Z are behind the wall. [1]
BEHIND = 0.8
# Half sizes of the windows for comparing images, and for averaging the comparison. [px]
FINE_PX, WIDE_PX = 2, 6
# Maximum shift of an image because of errors in attitude and position. [px]
SLACK_PX = 3
# Upper limit of the difference of two pixels. [grey levels of 255]
UNLIKE = 40.0


class Gap(NamedTuple):
    """The largest circle that fits into the gap."""

    u_px: float
    v_px: float
    """Centre in the image. [px]"""
    wall_m: float
    """Depth of the wall there, along the camera's axis. [m]"""
    room_m: float
    """Radius. [m]"""


def level(image: npt.NDArray[np.uint8], focal_px: float, level_from_cam: F64) -> F64:
    """Returns the grey image of a camera at the same position, rotated by `level_from_cam` (3, 3).

    `image` is (H, W, 3). The result is (H, W), NaN outside the image.
    """
    grey = image @ np.array([0.299, 0.587, 0.114])
    rows, columns = grey.shape
    v, u = np.mgrid[:rows, :columns] + 0.5
    rays = np.stack([(u - columns / 2) / focal_px, (v - rows / 2) / focal_px, np.ones_like(u)], -1) @ level_from_cam
    # Coordinates of the pixels' centres; pixels behind the camera are invalid.
    x = focal_px * rays[..., 0] / rays[..., 2] + columns / 2 - 0.5
    y = focal_px * rays[..., 1] / rays[..., 2] + rows / 2 - 0.5
    inside = (rays[..., 2] > 0) & (x >= 0) & (y >= 0) & (x <= columns - 1) & (y <= rows - 1)
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    left, top = np.minimum(x.astype(int), columns - 2), np.minimum(y.astype(int), rows - 2)
    x, y = x - left, y - top
    upper = (1 - x) * grey[top, left] + x * grey[top, left + 1]
    lower = (1 - x) * grey[top + 1, left] + x * grey[top + 1, left + 1]
    return np.where(inside, (1 - y) * upper + y * lower, np.nan)


def surrounded(free: Mask, solid: Mask) -> Mask:
    """Returns the free cells that are enclosed by solid cells, so that no free path leads to the edge; all (H, W)."""
    outside = np.zeros_like(free)
    outside[[0, -1], :] = ~solid[[0, -1], :]
    outside[:, [0, -1]] |= ~solid[:, [0, -1]]
    before = None
    while before is None or (before != outside).any():
        before = outside.copy()
        outside[1:] |= outside[:-1]
        outside[:-1] |= outside[1:]
        outside[:, 1:] |= outside[:, :-1]
        outside[:, :-1] |= outside[:, 1:]
        outside &= ~solid
    return free & ~outside


def greatest_circle(free: Mask) -> tuple[float, float, float] | None:
    """Returns column, row and radius of the largest circle of free cells, (H, W), in cells from centre to centre.

    The circle stays in the image. None if nothing is free.
    """
    padded = np.pad(free, 1)
    neighbours = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    inner = np.argwhere(neighbours)
    if len(inner) == 0:
        return None
    # The nearest blocked cell of a free cell always has a free neighbour.
    beside = np.zeros_like(padded)
    for axis in (0, 1):
        for step in (1, -1):
            beside |= np.roll(padded, step, axis)
    rim = np.argwhere(beside & ~padded) - 1
    squares = ((inner[:, None] - rim[None]) ** 2).sum(axis=-1).min(axis=1)
    row, column = inner[squares.argmax()]
    return float(column), float(row), float(squares.max() ** 0.5)


def without_specks(mask: Mask, times: int = 1) -> Mask:
    """Returns a mask (H, W) in which each cell has the majority value of its 3 x 3 neighbourhood."""
    for _ in range(times):
        padded = np.pad(mask, 1, mode="edge").astype(np.int32)
        rows = padded[:-2] + padded[1:-1] + padded[2:]
        mask = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:] >= 5
    return mask


def find_wall(points_m: F64, random: np.random.Generator) -> tuple[F64, float] | None:
    """Finds the plane n . p = d with the most points (N, 3) of all planes that face the camera. Returns n, d.

    M. Fischler and R. Bolles, "Random sample consensus", Communications of the ACM 24(6), 1981.
    """
    if len(points_m) < 100:
        return None
    corners = points_m[random.integers(len(points_m), size=(DRAWS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 1e-6] / lengths[lengths > 1e-6, None]
    corners = corners[lengths > 1e-6, 0]
    normals *= np.where(normals[:, 2:] < 0, -1.0, 1.0)
    faces = normals[:, 2] > FACING
    normals, offsets_m = normals[faces], (normals[faces] * corners[faces]).sum(axis=1)
    if len(normals) == 0:
        return None
    allowed_m = NEAR_M + NEAR_SHARE * points_m[:, 2]
    near = abs(points_m @ normals.T - offsets_m) < allowed_m[:, None]
    best = near.sum(axis=0).argmax()
    of_it = points_m[near[:, best]]
    if len(of_it) < 100:
        return None
    middle_m = of_it.mean(axis=0)
    normal = np.linalg.svd(of_it - middle_m, full_matrices=False)[2][2]
    normal *= np.sign(normal[2])
    return normal, float(normal @ middle_m)


def by_depth(depth_m: npt.NDArray[np.floating], focal_px: float) -> Gap | None:
    """Finds the gap in a depth image (H, W) along the camera's axis [m]; 0: no return. None if there is no gap."""
    rows, columns = depth_m.shape
    v, u = np.mgrid[:rows, :columns] + 0.5
    rays = np.stack([(u - columns / 2) / focal_px, (v - rows / 2) / focal_px, np.ones_like(u)], -1)
    points_m = (rays * depth_m[..., None])[1::3, 1::3].reshape(-1, 3)
    wall = find_wall(points_m[points_m[:, 2] > 0], np.random.default_rng(1))
    if wall is None:
        return None
    normal, distance_m = wall

    # Cells of the wall, columns to the right and rows down, around the intersection with the camera's axis.
    right = np.cross([0.0, 1.0, 0.0], normal)
    right /= np.linalg.norm(right)
    down = np.cross(normal, right)
    middle_m = np.array([0.0, 0.0, distance_m / normal[2]])
    cell_m = max(CELL_M, middle_m[2] / focal_px)
    half = np.ceil(middle_m[2] * np.array([rows, columns]) / (2 * focal_px * cell_m)).astype(int)
    below, aside = np.mgrid[-half[0] : half[0] + 1, -half[1] : half[1] + 1] * cell_m
    cells_m = middle_m + aside[..., None] * right + below[..., None] * down

    # State of each cell from its pixel: unknown, in front of the wall, wall, or behind it.
    seen_u = (focal_px * cells_m[..., 0] / cells_m[..., 2] + columns / 2).astype(int)
    seen_v = (focal_px * cells_m[..., 1] / cells_m[..., 2] + rows / 2).astype(int)
    inside = (cells_m[..., 2] > 0) & (seen_u >= 0) & (seen_u < columns) & (seen_v >= 0) & (seen_v < rows)
    seen_m = np.where(inside, depth_m[np.clip(seen_v, 0, rows - 1), np.clip(seen_u, 0, columns - 1)], 0.0)
    solid = abs(seen_m - cells_m[..., 2]) < BEHIND_M
    free = without_specks(seen_m > cells_m[..., 2] + BEHIND_M)
    found = greatest_circle(surrounded(free, without_specks(solid & ~free)))
    if found is None or (found[2] - 0.5) * cell_m < LEAST_ROOM_M:
        return None
    column, row, radius = found
    x_m, y_m, z_m = cells_m[int(row), int(column)]
    return Gap(
        u_px=float(focal_px * x_m / z_m + columns / 2),
        v_px=float(focal_px * y_m / z_m + rows / 2),
        wall_m=float(z_m),
        room_m=(radius - 0.5) * cell_m,
    )


def box_mean(image: F64, half: int) -> F64:
    """Returns the mean over (2 half + 1)^2 pixels around each pixel of an image (H, W), padded at its edges."""
    size = 2 * half + 1
    sums = np.pad(image, ((half + 1, half), (half + 1, half)), mode="edge").cumsum(axis=0).cumsum(axis=1)
    return (sums[size:, size:] - sums[:-size, size:] - sums[size:, :-size] + sums[:-size, :-size]) / size**2


def shifted(image: F64, right_px: float, down_px: int = 0) -> F64:
    """Returns an image (H, W) whose pixel (v, u) is that of (v + down_px, u + right_px); NaN outside of the image."""
    rows, columns = image.shape
    whole = int(np.floor(right_px))
    part = right_px - whole
    v, u = np.arange(rows) + down_px, np.arange(columns) + whole
    seen = ((v >= 0) & (v < rows))[:, None] & ((u >= 0) & (u + 1 < columns))
    v, u = v.clip(0, rows - 1), u.clip(0, columns - 2)
    found = (1 - part) * image[v[:, None], u] + part * image[v[:, None], u + 1]
    return np.where(seen, found, np.nan)


def difference(one: F64, other: F64) -> F64:
    """Returns the bounded difference of two grey images (H, W); pixels missing in one of them have the maximum."""
    # Comparisons with NaN are always false.
    apart = abs(one - other)
    return np.where(apart < UNLIKE, apart, UNLIKE)


class Views:
    """Grey images (H, W) of level cameras side by side; distances are tested on the first one.

    A point at the distance Z moves left by f X / Z in an image taken X further to the right: (2), with V dt = X. Images
    from the left and from the right are evaluated separately, and the better side counts: a part that the gap's edge
    hides from one side is visible from the other (S. B. Kang, R. Szeliski and J. Chai, "Handling occlusions in dense
    multi-view stereo", CVPR 2001). Combination of several images by 1 / Z: M. Okutomi and T. Kanade, "A
    multiple-baseline stereo", IEEE Transactions on Pattern Analysis and Machine Intelligence 15(4), 1993.
    """

    def __init__(self, images: Sequence[F64], right_m: Sequence[float], focal_px: float) -> None:
        self.first = images[0]
        self.others = [(image, focal_px * (x - right_m[0])) for image, x in zip(images[1:], right_m[1:], strict=True)]
        self.widest_px_m = max(abs(step) for _, step in self.others)

    def cost(self, per_m: float, half_px: int) -> F64:
        """Returns the matching cost of the distance 1 / `per_m` [1/m] for each pixel's window, (H, W) [grey levels]."""
        sides: list[list[F64]] = [[], []]
        for image, step in self.others:
            sides[step > 0].append(difference(shifted(image, -step * per_m), self.first))
        means = [box_mean(sum(side[1:], side[0]) / len(side), half_px) for side in sides if side]
        return np.minimum.reduce(means)

    def left_over(self, per_m: float, among: Mask) -> float:
        """Returns the residual of the distance 1 / `per_m` [1/m] in all images, over the pixels `among` (H, W)."""
        moved = [shifted(image, -step * per_m) for image, step in self.others]
        return float(sum(difference(image, self.first)[among].sum() for image in moved))

    def align(self, per_m: float, of_wall: Mask) -> None:
        """Shifts each image by some pixels so that the wall fits best, to correct errors of attitude and position."""
        for index, (image, step) in enumerate(self.others):
            moved = shifted(image, -step * per_m)

            def off(right_px: float, down_px: int, moved: F64 = moved) -> float:
                return float(difference(shifted(moved, right_px, down_px), self.first)[of_wall].sum())

            # Horizontal and vertical shifts in turn, because the wall has edges in both directions.
            right_px, down_px = 0.0, 0
            for _ in range(2):
                right_px = min(np.arange(-SLACK_PX, SLACK_PX + 0.1, 0.5), key=lambda x: off(x, down_px))
                down_px = min(range(-SLACK_PX, SLACK_PX + 1), key=lambda y: off(right_px, y))
            self.others[index] = (shifted(image, right_px, down_px), step)


def by_motion(
    images: Sequence[F64], right_m: Sequence[float], focal_px: float, margin: float = 0.0
) -> Gap | None:
    """Finds the gap in grey images (H, W) of level cameras with the same heading, side by side.

    `right_m` are their positions to the right [m]. The result refers to the first image. None if there is no gap. A
    pixel is behind the wall if that explains the images better by `margin` [grey levels]: for areas of one colour, the
    many distances behind the wall fit a little better by chance.
    """
    views = Views(images, right_m, focal_px)
    rows, columns = images[0].shape
    middle = np.zeros((rows, columns), bool)
    middle[rows // 5 : rows - rows // 5, columns // 5 : columns - columns // 5] = True

    # Find the wall: the distance of most of the middle, first coarsely, in every third row, then finely.
    tried = np.linspace(1 / FARTHEST_M, 1 / NEAREST_M, DEPTHS)
    roughly = Views([image[::3] for image in images], right_m, focal_px)
    best = np.argmin([roughly.cost(per_m, FINE_PX) for per_m in tried], axis=0)
    votes = np.convolve(np.bincount(best[middle[::3]], minlength=DEPTHS), np.ones(3), mode="same")
    wall = int(votes[2:-2].argmax()) + 2
    of_wall = np.repeat(abs(best - wall) <= 1, 3, axis=0)[:rows] & middle
    fine = np.linspace(tried[wall - 2], tried[wall + 2], 33)
    wall_per_m = fine[np.argmin([views.left_over(per_m, of_wall) for per_m in fine])]
    views.align(wall_per_m, of_wall)

    # Two clusters: pixels that move like the wall, and pixels that move less. Test distances behind the wall, one pixel
    # apart.
    count = int(views.widest_px_m * wall_per_m) + 2
    behind = np.min([views.cost(per_m, FINE_PX) for per_m in np.linspace(0.0, BEHIND * wall_per_m, count)], axis=0)
    on_it = np.min([views.cost(wall_per_m * share, FINE_PX) for share in (0.98, 1.0, 1.02)], axis=0)
    # An area of one colour fits all distances, so use its neighbourhood.
    free = without_specks(box_mean(behind - on_it, WIDE_PX) < -margin)
    found = greatest_circle(surrounded(free, ~free))
    if found is None:
        return None
    column, row, radius = found
    room_m = float((radius - 0.5) / (focal_px * wall_per_m))
    return Gap(column + 0.5, row + 0.5, float(1 / wall_per_m), room_m) if room_m > LEAST_ROOM_M else None
