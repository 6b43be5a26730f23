"""Project 5: racing windows in colour images: pixels with a window's colour, and the pose of its frame.

Axes are level: x forward, y left, z up. A camera looks along +z, x to the right, y down. Pixels are continuous: (0, 0)
is the outer corner of the top-left pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# Ranges of the hues of bars and hand in daylight. [deg]
HUES = {"red": (345.0, 369.0), "blue": (208.0, 240.0), "orange": (22.0, 45.0), "teal": (162.0, 190.0)}
# Darker pixels have no reliable hue; less saturated pixels are brick, mats, paint. [of 255], [1]
DARKEST, SATURATION = 40, 0.68
# Width of a bar, pale border of the bar, half of its thickness. [m]
BAR_M, PALE_M, HALF_THICK_M = 0.16, 0.02, 0.045
# Width of the bands beside a bar without its colour. [m]
BESIDE_M = 0.08
# Period of stripes and gaps along a bar, with an arrowhead after two stripes. [m]
STRIPE_M = 0.11
# Random search: draws per round, rounds, number of kept frames, and reduction of the spread per round.
DRAWS, ROUNDS, KEPT, NEARER = 64, 20, 8, 0.8
# Initial spread: distance [1], left, up [m], facing [rad], width, height [m].
SPREAD = np.array([0.2, 0.1, 0.1, 0.2, 0.1, 0.05])
# Minimum number of pixels of a window, minimum score, maximum distance. [px], [1], [m]
LEAST_PX, LEAST_SCORE, FARTHEST_M = 60, 0.3, 5.0


# Pixels in the same or neighbouring cells of this size belong together; a window is in one of the largest groups. [px]
CELL_PX, GROUPS = 12, 3


class Window(NamedTuple):
    """Pose and size of a frame."""

    middle_m: F64
    """Middle of the opening relative to the camera, (3,). [m, level]"""
    facing_rad: float
    """Direction of passage, from x towards y. [rad]"""
    size_m: F64
    """Width and height of the opening, (2,). [m]"""
    score: float
    """Quality of the fit: 0 for none, 0.7 for a completely visible frame."""


def of_colour(rgb: npt.NDArray[np.uint8], name: str) -> Mask:
    """Returns the pixels of an image (H, W, 3) with one of the colours of `HUES`, (H, W)."""
    red, green, blue = np.moveaxis(rgb.astype(np.float32), -1, 0)
    most, least = rgb.max(axis=-1).astype(np.float32), rgb.min(axis=-1).astype(np.float32)
    chroma = np.maximum(most - least, 1.0)
    hue = np.where(most == blue, 240 + 60 * (red - green) / chroma, 120 + 60 * (blue - red) / chroma)
    hue = np.where(most == red, 60 * (green - blue) / chroma, hue)
    low, high = HUES[name]
    return ((hue - low) % 360 < high - low) & (most > DARKEST) & (chroma > SATURATION * most)


def frame_samples() -> tuple[F64, F64, F64]:
    """Returns sample points on a frame and beside it: the corner that each refers to, (N, 2) of -1 to 1; the offset
    outwards from there, (N, 2) [m]; and the kind: 1 on a bar, 0 in a corner, -1 beside a bar, (N,)."""
    along = np.linspace(-0.96, 0.96, 31)
    corners, outwards, kinds = [], [], []
    on = np.linspace(0.01, BAR_M - PALE_M - 0.01, 6)
    beside = np.linspace(0.01, BESIDE_M, 4)
    for side in (-1.0, 1.0):
        for offsets, kind in ((on, 1.0), (-beside, -1.0), (BAR_M - PALE_M + beside, -1.0)):
            a, o = (grid.ravel() for grid in np.meshgrid(along, offsets))
            edge = np.full_like(a, side)
            corners += [np.stack([edge, a], 1), np.stack([a, edge], 1)]
            outwards += [np.stack([side * o, 0 * o], 1), np.stack([0 * o, side * o], 1)]
            kinds += [np.full(2 * len(a), kind)]
        for other in (-1.0, 1.0):
            a, o = (grid.ravel() for grid in np.meshgrid(on, on))
            corners.append(np.tile([side, other], (len(a), 1)))
            outwards.append(np.stack([side * a, other * o], 1))
            kinds.append(np.zeros(len(a)))
    return np.concatenate(corners), np.concatenate(outwards), np.concatenate(kinds)


CORNERS, OUTWARDS, KINDS = frame_samples()
# For points on a bar: whether the bar is vertical.
UPRIGHT = abs(CORNERS[:, 0]) == 1.0


def weights(coloured: Mask) -> F64:
    """Returns the weight of colour at each point, (..., N): the sum is one over points that must be `coloured`, and
    minus one over points that must not."""
    positive = coloured / coloured.sum(axis=-1, keepdims=True)
    return positive - ~coloured / (~coloured).sum(axis=-1, keepdims=True)


ON_BARS = weights(KINDS == 1.0)


def striped_weights(size_m: F64) -> F64:
    """Returns these weights for frames with openings (K, 2) [m], with arrowheads as not coloured, (K, N)."""
    # Arrowheads point to the middle of each bar.
    at_m = abs(CORNERS * size_m[:, None] / 2 + OUTWARDS)
    along = np.where(UPRIGHT, at_m[..., 1], at_m[..., 0])
    out = np.where(UPRIGHT, abs(OUTWARDS[:, 0]), abs(OUTWARDS[:, 1]))
    in_stripe = np.floor((along + abs(out - BAR_M / 2)) / STRIPE_M) % 3 != 0
    return weights((KINDS == 1.0) & in_stripe)


def scores(mask: Mask, cam_from_level: F64, focal_px: float, candidates: F64, striped: bool) -> F64:
    """Returns the score of each frame for a colour's pixels, (K,).

    A frame is (6,): middle (3,) [m, level], facing [rad], width and height of the opening [m].
    """
    rows, columns = mask.shape
    facing = candidates[:, 3]
    zero = np.zeros_like(facing)
    normal = np.stack([np.cos(facing), np.sin(facing), zero], 1)
    right = np.stack([np.sin(facing), -np.cos(facing), zero], 1)
    off_m = CORNERS * candidates[:, None, 4:6] / 2 + OUTWARDS
    at_m = (candidates[:, :3] - HALF_THICK_M * normal)[:, None] + off_m[..., :1] * right[:, None]
    at_m[..., 2] += off_m[..., 1]
    seen = at_m @ cam_from_level.T
    ahead = np.maximum(seen[..., 2], 0.05)
    u = (focal_px * seen[..., 0] / ahead + columns / 2).astype(int)
    v = (focal_px * seen[..., 1] / ahead + rows / 2).astype(int)
    inside = (seen[..., 2] > 0.05) & (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    coloured = mask[v.clip(0, rows - 1), u.clip(0, columns - 1)] & inside
    return (coloured * striped_weights(candidates[:, 4:6])).sum(axis=1) if striped else coloured @ ON_BARS


def groups(mask: Mask) -> list[Mask]:
    """Returns connected groups of a mask's pixels (H, W), across gaps of a corner's size, the largest first."""
    rows, columns = (-(-side // CELL_PX) for side in mask.shape)
    padded = np.zeros((rows * CELL_PX, columns * CELL_PX), bool)
    padded[: mask.shape[0], : mask.shape[1]] = mask
    cells = padded.reshape(rows, CELL_PX, columns, CELL_PX).sum(axis=(1, 3))
    left = {(int(row), int(column)) for row, column in np.argwhere(cells > CELL_PX // 4)}
    found = []
    while left:
        group, new = set(), {left.pop()}
        while new:
            group |= new
            near = {(r + i, c + j) for r, c in new for i in range(-2, 3) for j in range(-2, 3)}
            new = near & left
            left -= new
        member = np.zeros((rows, columns), bool)
        member[tuple(np.array(sorted(group)).T)] = True
        grown = member.repeat(CELL_PX, axis=0).repeat(CELL_PX, axis=1)
        found.append(mask & grown[: mask.shape[0], : mask.shape[1]])
    return sorted(found, key=lambda group: -int(group.sum()))


def starts(mask: Mask, cam_from_level: F64, focal_px: float, size_m: F64) -> list[list[float]]:
    """Returns initial frames for a fit to the pixels of a mask (H, W): as in `scores`."""
    rows, columns = mask.shape
    v, u = np.nonzero(mask)
    pixels = np.stack([u + 0.5 - columns / 2, v + 0.5 - rows / 2, np.full(len(u), focal_px)], 1) / focal_px
    level = pixels @ cam_from_level
    level = level[level[:, 0] > 0.1]
    if len(level) < LEAST_PX:
        return []
    aside, up = level[:, 1] / level[:, 0], level[:, 2] / level[:, 0]
    low, high = np.percentile([aside, up], [2, 98], axis=1)
    outer_m = size_m + 2 * BAR_M
    # The frame may be completely visible, or cut by the image's edge: then one side or one corner is known.
    found = []
    whole_m = float((outer_m / np.maximum(high - low, 1e-3)).min())
    for ahead_m in whole_m * np.array([0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1]):
        half = outer_m / 2 / ahead_m
        for a in (low[0] + half[0], (low[0] + high[0]) / 2, high[0] - half[0]):
            for b in (low[1] + half[1], (low[1] + high[1]) / 2, high[1] - half[1]):
                found += [[ahead_m, a * ahead_m, b * ahead_m, facing, *size_m] for facing in (-0.2, 0.0, 0.2)]
    return found


def find_window(
    mask: Mask, cam_from_level: F64, focal_px: float, square: bool, size_m: tuple[float, float]
) -> Window | None:
    """Finds the frame whose bars are the pixels of a mask (H, W). None if there is no frame.

    `cam_from_level` (3, 3) rotates directions from level axes to the camera's. `size_m` is the usual width and height
    of the opening; a `square` frame has only one size.
    """
    begins = [
        start
        for group in (mask, *groups(mask)[:GROUPS])
        for start in starts(group, cam_from_level, focal_px, np.array(size_m))
    ]
    if not begins:
        return None
    kept = np.array(begins)
    random = np.random.default_rng(1)
    kept = kept[scores(mask, cam_from_level, focal_px, kept, False).argsort()[::-1][:KEPT]]
    spread = SPREAD
    for turn in range(ROUNDS):
        drawn = kept[random.integers(len(kept), size=DRAWS)]
        step = random.normal(0.0, 1.0, drawn.shape) * spread
        # Larger moves along the line of sight, where the score changes less, than across it.
        moved = drawn + np.concatenate([0 * step[:, :1], step[:, 1:]], 1)
        moved[:, :3] *= np.exp(step[:, :1])
        if square:
            moved[:, 5] = moved[:, 4]
        moved[:, 3] = moved[:, 3].clip(-0.5, 0.5)
        moved[:, 4:] = moved[:, 4:].clip(np.array(size_m) - 0.2, np.array(size_m) + 0.2)
        everyone = np.concatenate([kept, moved])
        points = scores(mask, cam_from_level, focal_px, everyone, turn >= ROUNDS // 2)
        order = points.argsort()[::-1][:KEPT]
        kept, spread = everyone[order], spread * NEARER
    # Many frames are as good as the best one, and their mean is better than each.
    score = float(points[order[0]])
    mean = kept.mean(axis=0)
    if score < LEAST_SCORE or mean[0] > FARTHEST_M:
        return None
    return Window(mean[:3], float(mean[3]), mean[4:6], score)
