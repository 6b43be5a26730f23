"""Project 2, of graduates: RRT*, and polynomials through its points. A file to work in, besides `planner.py`."""

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
    """Grows a tree of `nodes` nodes within the box from `low_m` to `high_m`, with more than `margin_m` of room.

    Every number is drawn from `np.random.default_rng(seed)`, so that more nodes from the same seed are the same tree,
    grown further. Returns the best path (N, 3), `start_m` first and `goal_m` last; None if none was found, or if start
    or goal have not so much room.
    """
    # So far it is the straight line, whatever stands there.
    return np.array([start_m, goal_m], float)


def powers(at_s: F64, derivative: int = 0) -> F64:
    """Returns the derivative of 1, t, ..., t^7 at times (N,): shape (N, 8)."""
    found = np.zeros((len(at_s), DEGREE + 1))
    for k in range(derivative, DEGREE + 1):
        found[:, k] = math.perm(k, derivative) * at_s ** (k - derivative)
    return found


def curve(seconds: F64, coefficients: F64, at_s: F64, derivative: int = 0) -> F64:
    """Returns place, or a derivative of it, at times (N,) of the whole curve: shape (N, 3). [m/s^d]"""
    ends_s = np.cumsum(seconds)
    at_s = np.clip(at_s, 0.0, ends_s[-1])
    piece = np.minimum(np.searchsorted(ends_s, at_s, side="right"), len(seconds) - 1)
    in_piece_s = at_s - (ends_s - seconds)[piece]
    return np.einsum("nk,nki->ni", powers(in_piece_s, derivative), coefficients[piece])


def minimum_snap(points_m: F64, seconds: F64) -> F64:
    """Solves (6): polynomials through points (N + 1, 3), at rest at both ends, piece i of `seconds[i]`.

    Returns coefficients (N, 8, 3): piece i is the sum of `coefficients[i, k] t^k`, t from its own beginning. [m/s^k]
    """
    # So far they are straight lines, which ask for any acceleration at their corners.
    coefficients = np.zeros((len(seconds), DEGREE + 1, 3))
    coefficients[:, 0] = points_m[:-1]
    coefficients[:, 1] = np.diff(points_m, axis=0) / seconds[:, None]
    return coefficients


def timed(points_m: F64, max_mps: float, max_mps2: float) -> tuple[F64, F64]:
    """Returns times (N,) and coefficients (N, 8, 3) of polynomials through points (N + 1, 3) that keep both limits."""
    # So far nothing is measured on the curve, and nothing stretched.
    seconds = np.linalg.norm(np.diff(points_m, axis=0), axis=1) / max_mps
    return seconds, minimum_snap(points_m, seconds)


def smooth(room: Room, path_m: F64, *, margin_m: float, max_mps: float, max_mps2: float) -> tuple[F64, F64] | None:
    """Lays polynomials through a path (N, 3), with more than `margin_m` of room all along, within these limits.

    Returns the pieces' times (M,) [s] and coefficients (M, 8, 3) [m/s^k]; None if it does not fit.
    """
    # So far the curve is not tested.
    return timed(path_m, max_mps, max_mps2)
