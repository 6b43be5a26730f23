"""Project 4: the gap in images. This is the file to work in; no flight is in it.

Images are (H, W) or (H, W, 3). A camera looks along +z, x to the right, y down; its axis goes through the image's
middle. Pixels are continuous: (0, 0) is the outer corner of the top-left one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


class Gap(NamedTuple):
    """Where the greatest circle that fits into the gap lies."""

    u_px: float
    v_px: float
    """Its middle in the image: the safe point. [px]"""
    wall_m: float
    """The wall's depth there, along the camera's axis. [m]"""
    room_m: float
    """Its radius. [m]"""


def by_depth(depth_m: npt.NDArray[np.floating], focal_px: float) -> Gap | None:
    """Finds the gap in an image of depth (H, W) along the camera's axis [m]; 0 is no return. None if there is none.

    `ug`. The wall need not be straight ahead: the camera may be turned.
    """
    # So far: the image's middle, in which no room is known.
    rows, columns = depth_m.shape
    return Gap(columns / 2, rows / 2, float(depth_m[rows // 2, columns // 2]), 0.0)


def level(image: npt.NDArray[np.uint8], focal_px: float, level_from_cam: F64) -> F64:
    """Returns what a camera at the same place would show that is turned by `level_from_cam`, in grey.

    `g`. `image` is (H, W, 3); `level_from_cam` (3, 3) turns directions from the camera's axes into those of the camera
    asked for. Returned is (H, W), 0 to 255, NaN where `image` does not show it.
    """
    # So far: the turn is not taken away.
    return image @ np.array([0.299, 0.587, 0.114])


def by_motion(images: Sequence[F64], right_m: Sequence[float], focal_px: float) -> Gap | None:
    """Finds the gap in grey images (H, W), 0 to 255, of level cameras beside each other that look ahead.

    `g`. There are two or more; `right_m` says how far to the right each was taken [m], all at one height and distance.
    A pixel may be NaN: nothing is known there. The gap's place is that in the first image. None if there is none.
    """
    # So far: the image's middle, in which no room is known.
    rows, columns = images[0].shape
    return Gap(columns / 2, rows / 2, 0.0, 0.0)
