"""Project 2 for graduates: RRT*, and polynomials through its points. Work in this file and in `planner.py`."""

from __future__ import annotations

import math

import numpy as np
from planner import F64, Room

DEGREE = 7


def rrt_star(
    room: Room,
    start_m: F64,
    goal_m: F64,
    low_m: F64,
    high_m: F64,
    *,
    nodes: int = 1500,
    seed: int = 0,
    margin_m: float = 0.3,
    eta_m: float = 1.0,
) -> F64 | None:
    """Grows a tree of `nodes` nodes within the box from `low_m` to `high_m`, with a clearance above `margin_m`.

    Draws all random numbers from `np.random.default_rng(seed)`, so that more nodes with the same seed extend the same
    tree. Returns the best path (N, 3), `start_m` first and `goal_m` last. None if none was found, or if start or goal
    have too little clearance.
    """
    # To do: for now it is the straight line, without regard to obstacles.
    return np.array([start_m, goal_m], float)


def powers(at_s: F64, derivative: int = 0) -> F64:
    """Returns the derivative of 1, t, ..., t^7 at times (N,): shape (N, 8)."""
    found = np.zeros((len(at_s), DEGREE + 1))
    for k in range(derivative, DEGREE + 1):
        found[:, k] = math.perm(k, derivative) * at_s ** (k - derivative)
    return found


def curve(seconds: F64, coefficients: F64, at_s: F64, derivative: int = 0) -> F64:
    """Returns position, or a derivative of it, at times (N,) of the complete curve: shape (N, 3). [m/s^d]"""
    ends_s = np.cumsum(seconds)
    at_s = np.clip(at_s, 0.0, ends_s[-1])
    piece = np.minimum(np.searchsorted(ends_s, at_s, side="right"), len(seconds) - 1)
    in_piece_s = at_s - (ends_s - seconds)[piece]
    return np.einsum("nk,nki->ni", powers(in_piece_s, derivative), coefficients[piece])


def minimum_snap(points_m: F64, seconds: F64) -> F64:
    """Solves (6): polynomials through points (N + 1, 3), at rest at both ends, piece i with duration `seconds[i]`.

    Returns coefficients (N, 8, 3): piece i is the sum of `coefficients[i, k] t^k`, with t from its beginning. [m/s^k]
    """
    # To do: for now they are straight lines, with unlimited acceleration at the corners.
    coefficients = np.zeros((len(seconds), DEGREE + 1, 3))
    coefficients[:, 0] = points_m[:-1]
    coefficients[:, 1] = np.diff(points_m, axis=0) / seconds[:, None]
    return coefficients


def timed(points_m: F64, max_mps: float, max_mps2: float) -> tuple[F64, F64]:
    """Returns times (N,) and coefficients (N, 8, 3) of polynomials through points (N + 1, 3) that keep both limits."""
    # To do: for now the limits are not checked, and nothing is stretched.
    seconds = np.linalg.norm(np.diff(points_m, axis=0), axis=1) / max_mps
    return seconds, minimum_snap(points_m, seconds)


def smooth(room: Room, path_m: F64, *, margin_m: float, max_mps: float, max_mps2: float) -> tuple[F64, F64] | None:
    """Fits polynomials to a path (N, 3), with a clearance above `margin_m` everywhere, within these limits.

    Returns the pieces' times (M,) [s] and coefficients (M, 8, 3) [m/s^k]; None if there is no solution.
    """
    # To do: for now the curve is not checked.
    return timed(path_m, max_mps, max_mps2)
