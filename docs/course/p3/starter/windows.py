"""Project 3: window corners from a mask, window pose from corners, and a filter over images. Work in this file.

It contains neither flight code nor a network.

Pixels are continuous: (0, 0) is the outer corner of the top-left pixel, and the camera's axis goes through the middle
of the image. The camera's axes are x right, y down, z forward. *Level* axes have their origin at the camera, with z up;
the caller chooses the direction of x, and `level_from_cam` (3, 3) rotates the camera's directions into them. The order
of corners is upper left, upper right, lower right, lower left in the direction of passage; NaN is an unknown corner.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]

# Width of a frame's bars. [m]
BAR_M = 0.16


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
    """Side of the opening. [m]"""
    off_px: float
    """Root mean square of the corners' residuals. [px]"""


def corners_of(mask: npt.NDArray[np.bool_], focal_px: float, level_from_cam: F64) -> Corners | None:
    """Finds the corners of one window's frame in its mask (H, W); None if too little of it is visible.

    Ignores single pixels. A corner is the intersection of two neighbouring sides, even if it is hidden. Corners of a
    frame that leaves the image are correct or NaN. With `focal_px` and `level_from_cam` you can find the lines that are
    vertical in the world; they are optional.
    """
    # To do: for now nothing is found.
    return None


def square_pose(
    corners_px: F64, side_m: float, focal_px: float, size_px: tuple[int, int], level_from_cam: F64
) -> Seen:
    """Returns the pose of a vertical square with a known side, from its corners (4, 2) in an image of size (W, H).

    Equations (2) and (3), with four unknowns.
    """
    # To do: for now the result is straight ahead, 3 m away, with passage along x.
    return Seen(level_from_cam @ np.array([0.0, 0.0, 3.0]), 0.0, side_m, float("inf"))


def side_of(hole_px: F64, outline_px: F64) -> float:
    """Returns the side of the opening [m] from the corners of hole and outline, (4, 2) each [px]: equation (5)."""
    # To do: for now the mean of all windows.
    return 1.175


def noise(p_m: F64, side_m: float, focal_px: float, noise_px: float) -> F64:
    """Returns the covariance (4, 4) of position [m] and heading [rad] of a window detected at `p_m` [m, level].

    R of equations (6): (4) for the position, along the line of sight and sideways; derive that of the heading.
    """
    # To do: for now constant.
    return np.diag([0.1, 0.1, 0.1, 0.1]) ** 2


class WindowFilter:
    """One window in fixed axes: x = (p, psi) (4,) [m, m, m, rad], P (4, 4), by equations (6)."""

    def __init__(self, x: F64, P: F64) -> None:
        self.x, self.P = np.array(x, float), np.array(P, float)

    def predict(self, dt_s: float, drift: float) -> None:
        """Adds the drift of the dead reckoning: each coordinate by `drift` m in the first second; squares add up."""
        # To do: for now there is no drift.

    def update(self, z: F64, R: F64) -> bool:
        """Applies a measurement z (4,) with covariance R (4, 4). Returns False and ignores it if it is an outlier."""
        # To do: for now the last measurement is the result.
        self.x, self.P = np.array(z, float), np.array(R, float)
        return True
