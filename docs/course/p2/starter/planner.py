"""Project 2: a path through a known map. Work in this file; it uses neither the vehicle nor `vizflyt`.

`room` is a function: it takes points (N, 3) [m, world] and returns the clearance of the body's centre there, (N,) [m]:
(1) of the assignment. All points are float64, in the world frame.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
Room = Callable[[F64], F64]


def length_m(path_m: F64) -> float:
    """Returns the length of a path (N, 3). [m]"""
    return float(np.linalg.norm(np.diff(path_m, axis=0), axis=1).sum())


def is_free(room: Room, from_m: F64, to_m: F64, margin_m: float = 0.0) -> bool:
    """Returns whether a segment between points (3,) has a clearance above `margin_m` everywhere."""
    # To do: for now it checks only the ends.
    return bool((room(np.stack([from_m, to_m])) > margin_m).all())


def astar(
    room: Room,
    start_m: F64,
    goal_m: F64,
    low_m: F64,
    high_m: F64,
    *,
    spacing_m: float = 0.1,
    margin_m: float = 0.3,
) -> F64 | None:
    """Finds a path on a grid within the box from `low_m` to `high_m`, with a clearance above `margin_m` everywhere.

    Returns its points (N, 3), `start_m` first and `goal_m` last. None if there is no path, or if start or goal have too
    little clearance.
    """
    # To do: for now it is the straight line, without regard to obstacles.
    return np.array([start_m, goal_m], float)


def shorten(room: Room, path_m: F64, margin_m: float = 0.3) -> F64:
    """Removes unnecessary points of a path (N, 3), so that it stays free. Keeps the first and the last point."""
    # To do: for now all points are kept.
    return path_m
