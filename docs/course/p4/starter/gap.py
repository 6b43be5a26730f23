"""Project 4: the gap in images. Work in this file; it contains no flight code.

Images are (H, W) or (H, W, 3). The camera's axes are x right, y down, z forward; its axis goes through the middle of
the image. Pixels are continuous: (0, 0) is the outer corner of the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


class Gap(NamedTuple):
    """The largest circle that fits into the gap."""

    u_px: float
    v_px: float
    """Centre in the image: the safe point. [px]"""
    wall_m: float
    """Depth of the wall there, along the camera's axis. [m]"""
    room_m: float
    """Radius. [m]"""


def by_depth(depth_m: npt.NDArray[np.floating], focal_px: float) -> Gap | None:
    """Finds the gap in a depth image (H, W) along the camera's axis [m]; 0: no return. None if there is no gap.

    `ug`. The camera may be rotated, so that it does not look straight at the wall.
    """
    # To do: for now the middle of the image, with radius 0.
    rows, columns = depth_m.shape
    return Gap(columns / 2, rows / 2, float(depth_m[rows // 2, columns // 2]), 0.0)


def level(image: npt.NDArray[np.uint8], focal_px: float, level_from_cam: F64) -> F64:
    """Returns the grey image of a camera at the same position, rotated by `level_from_cam`.

    `g`. `image` is (H, W, 3); `level_from_cam` (3, 3) rotates directions from the camera's axes to those of the new
    camera. The result is (H, W), 0 to 255, NaN outside of `image`.
    """
    # To do: for now the rotation is ignored.
    return image @ np.array([0.299, 0.587, 0.114])


def by_motion(images: Sequence[F64], right_m: Sequence[float], focal_px: float) -> Gap | None:
    """Finds the gap in grey images (H, W), 0 to 255, of level cameras side by side that look forward.

    `g`. There are at least two. `right_m` are their positions to the right [m], all at the same height and distance. A
    pixel may be NaN, which means unknown. The result refers to the first image. None if there is no gap.
    """
    # To do: for now the middle of the image, with radius 0.
    rows, columns = images[0].shape
    return Gap(columns / 2, rows / 2, 0.0, 0.0)
