"""Project 3: a window's corners in its mask, its pose from corners, a filter over images. This is the file to work in.

No flight is in it, and no network.

Pixels are continuous: (0, 0) is the outer corner of the top-left one, and a camera's axis goes through the image's
middle. The camera's axes are x right, y down, z ahead. *Level* axes begin at the camera, z up; where x points is the
caller's choice, and `level_from_cam` (3, 3) turns the camera's directions into them. Corners stand in the order upper
left, upper right, lower right, lower left, as one sees them who flies through; NaN is a corner that is not known.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]

# How wide a frame's bars are. [m]
BAR_M = 0.16


class Corners(NamedTuple):
    """The corners of a window in an image, (4, 2) each, NaN where not known. [px]"""

    hole: F64
    outline: F64


class Seen(NamedTuple):
    """A window as one image shows it."""

    p_m: F64
    """The middle of its opening, (3,). [m, level]"""
    heading_rad: float
    """Where its passage leads, counter-clockwise about up from x. [rad, level]"""
    side_m: float
    """The side of its opening. [m]"""
    off_px: float
    """What its corners are off those found, root mean square. [px]"""


def corners_of(mask: npt.NDArray[np.bool_], focal_px: float, level_from_cam: F64) -> Corners | None:
    """Finds the corners of one window's frame in its mask (H, W); None if too little of it is seen.

    Specks are not of the frame. A corner is where two neighbouring sides meet, also where something hides it. What is
    known of a frame that leaves the image is right, and the rest NaN. `focal_px` and `level_from_cam` tell which lines
    are upright in the world; you may do without.
    """
    # So far: nothing is found.
    return None


def square_pose(
    corners_px: F64, side_m: float, focal_px: float, size_px: tuple[int, int], level_from_cam: F64
) -> Seen:
    """Returns where an upright square of a known side is, from its corners (4, 2) in an image of this size (W, H).

    Equations (2) and (3), with four numbers free.
    """
    # So far: it is taken to be straight ahead, 3 m away, and to lead along x.
    return Seen(level_from_cam @ np.array([0.0, 0.0, 3.0]), 0.0, side_m, float("inf"))


def side_of(hole_px: F64, outline_px: F64) -> float:
    """Returns the side of the opening [m] from the corners of hole and outline, (4, 2) each [px]: equation (5)."""
    # So far: the mean of all windows.
    return 1.175


def noise(p_m: F64, side_m: float, focal_px: float, noise_px: float) -> F64:
    """Returns the covariance (4, 4) of place [m] and heading [rad] of a window that is seen at `p_m` [m, level].

    R of equations (6): (4) for the place, along the line of sight and aside; the heading's is yours to derive.
    """
    # So far: the same from everywhere.
    return np.diag([0.1, 0.1, 0.1, 0.1]) ** 2


class WindowFilter:
    """One window in axes that stand still: x = (p, psi) (4,) [m, m, m, rad], P (4, 4), by equations (6)."""

    def __init__(self, x: F64, P: F64) -> None:
        self.x, self.P = np.array(x, float), np.array(P, float)

    def predict(self, dt_s: float, drift: float) -> None:
        """Lets the own reckoning drift: each number of the place by `drift` m in the first second; squares add up."""
        # So far: it does not drift.

    def update(self, z: F64, R: F64) -> bool:
        """Takes a measurement z (4,) with covariance R (4, 4); returns False, and stays, for what chance cannot be."""
        # So far: the last one counts.
        self.x, self.P = np.array(z, float), np.array(R, float)
        return True
