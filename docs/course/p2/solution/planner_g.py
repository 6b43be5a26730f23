"""Project 2, reference solution for graduates: RRT*, and polynomials through its points. No vehicle, no `vizflyt`."""

from __future__ import annotations

import math

import numpy as np
from planner import F64, Room, are_free

DEGREE = 7
# Iterations for the durations of the pieces.
ROUNDS = 20


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

    More nodes with the same seed extend the same tree. Returns the best path (N, 3), `start_m` first and `goal_m` last.
    None if none was found in ten draws per node, or if start or goal have too little clearance. [m, world]
    """
    random = np.random.default_rng(seed)
    start_m, goal_m = np.asarray(start_m, float), np.asarray(goal_m, float)
    if (room(np.stack([start_m, goal_m])) <= margin_m).any():
        return None
    free_m3 = float(np.prod(high_m - low_m)) * (room(random.uniform(low_m, high_m, (2000, 3))) > margin_m).mean()
    gamma_m = 2 * (4 / 3) ** (1 / 3) * (free_m3 / (4 * math.pi / 3)) ** (1 / 3)

    points_m = np.empty((nodes, 3))
    cost_m = np.zeros(nodes)
    parent = np.full(nodes, -1)
    children: list[list[int]] = [[] for _ in range(nodes)]
    points_m[0], count, goal = start_m, 1, -1
    for _ in range(10 * nodes):
        if count == nodes:
            break
        # Draw the goal from time to time, until it is a node.
        drawn_m = goal_m if goal < 0 and random.random() < 0.05 else random.uniform(low_m, high_m)
        apart_m = np.linalg.norm(points_m[:count] - drawn_m, axis=1)
        nearest = int(apart_m.argmin())
        if apart_m[nearest] < 1e-9:
            continue
        is_goal = drawn_m is goal_m and apart_m[nearest] <= eta_m
        new_m = drawn_m
        if apart_m[nearest] > eta_m:
            new_m = points_m[nearest] + (drawn_m - points_m[nearest]) * (eta_m / apart_m[nearest])

        apart_m = np.linalg.norm(points_m[:count] - new_m, axis=1)
        radius_m = min(eta_m, gamma_m * (math.log(count + 1) / (count + 1)) ** (1 / 3))
        near = np.union1d(np.flatnonzero(apart_m <= radius_m), [nearest])
        near = near[are_free(room, points_m[near], np.tile(new_m, (len(near), 1)), margin_m)]
        if len(near) == 0:
            continue
        new, through_m = count, cost_m[near] + apart_m[near]
        count += 1
        best = int(through_m.argmin())
        points_m[new], cost_m[new], parent[new] = new_m, through_m[best], near[best]
        children[near[best]].append(new)
        goal = new if is_goal else goal
        # Rewire nodes that are cheaper to reach over the new node, and reduce the cost of all nodes below them.
        for other in near[cost_m[near] > cost_m[new] + apart_m[near] + 1e-9].tolist():
            children[parent[other]].remove(other)
            children[new].append(other)
            parent[other] = new
            gain_m = cost_m[other] - cost_m[new] - apart_m[other]
            below = [other]
            while below:
                node = below.pop()
                cost_m[node] -= gain_m
                below += children[node]
    if goal < 0:
        return None
    way = [goal]
    while way[-1] != 0:
        way.append(int(parent[way[-1]]))
    return points_m[way[::-1]]


def powers(at_s: F64, derivative: int = 0) -> F64:
    """Returns the derivative of 1, t, ..., t^7 at times (N,): shape (N, 8)."""
    found = np.zeros((len(at_s), DEGREE + 1))
    for k in range(derivative, DEGREE + 1):
        found[:, k] = math.perm(k, derivative) * at_s ** (k - derivative)
    return found


def minimum_snap(points_m: F64, seconds: F64) -> F64:
    """Solves (6): polynomials through points (N + 1, 3), at rest at both ends, piece i with duration `seconds[i]`.

    Returns coefficients (N, 8, 3): piece i is the sum of `coefficients[i, k] t^k`, with t from its beginning. [m/s^k]
    """
    pieces, width = len(seconds), DEGREE + 1
    snap = np.zeros((pieces * width, pieces * width))
    for piece, last_s in enumerate(seconds):
        for k in range(4, width):
            for m in range(4, width):
                power = k + m - 7
                value = math.perm(k, 4) * math.perm(m, 4) * last_s**power / power
                snap[piece * width + k, piece * width + m] = value
    rows, values = [], []

    def ask(parts: list[tuple[int, F64]], value_m: F64) -> None:
        row = np.zeros(pieces * width)
        for piece, part in parts:
            row[piece * width : (piece + 1) * width] = part
        rows.append(row)
        values.append(value_m)

    begin = [powers(np.zeros(1), derivative)[0] for derivative in range(5)]
    for piece, last_s in enumerate(seconds):
        end = [powers(np.array([last_s]), derivative)[0] for derivative in range(5)]
        ask([(piece, begin[0])], points_m[piece])
        ask([(piece, end[0])], points_m[piece + 1])
        for derivative in range(1, 5):
            if piece + 1 < pieces:
                ask([(piece, end[derivative]), (piece + 1, -begin[derivative])], np.zeros(3))
            elif derivative < 4:
                ask([(piece, end[derivative])], np.zeros(3))
    for derivative in range(1, 4):
        ask([(0, begin[derivative])], np.zeros(3))

    ties = np.array(rows)
    system = np.block([[snap, ties.T], [ties, np.zeros((len(ties), len(ties)))]])
    right = np.concatenate([np.zeros((pieces * width, 3)), np.array(values)])
    return np.linalg.solve(system, right)[: pieces * width].reshape(pieces, width, 3)


def curve(seconds: F64, coefficients: F64, at_s: F64, derivative: int = 0) -> F64:
    """Returns position, or a derivative of it, at times (N,) of the complete curve: shape (N, 3). [m/s^d]"""
    ends_s = np.cumsum(seconds)
    at_s = np.clip(at_s, 0.0, ends_s[-1])
    piece = np.minimum(np.searchsorted(ends_s, at_s, side="right"), len(seconds) - 1)
    in_piece_s = at_s - (ends_s - seconds)[piece]
    return np.einsum("nk,nki->ni", powers(in_piece_s, derivative), coefficients[piece])


def stretch(seconds: F64, coefficients: F64, factor: float) -> tuple[F64, F64]:
    """Returns the same curve, slower by `factor`."""
    return seconds * factor, coefficients / factor ** np.arange(DEGREE + 1)[None, :, None]


def share_of_limits(seconds: F64, coefficients: F64, max_mps: float, max_mps2: float) -> F64:
    """Returns the factor by which to stretch each piece to keep the limits of speed and acceleration: shape (N,)."""
    shares = np.linspace(0.0, 1.0, 20)
    piece = np.arange(len(seconds))
    greatest = []
    for derivative in (1, 2):
        basis = np.stack([powers(shares * last_s, derivative) for last_s in seconds])
        values = np.einsum("nsk,nki->nsi", basis, coefficients[piece])
        greatest.append(np.linalg.norm(values, axis=2).max(axis=1))
    return np.maximum(greatest[0] / max_mps, (greatest[1] / max_mps2) ** 0.5)


def timed(points_m: F64, max_mps: float, max_mps2: float) -> tuple[F64, F64]:
    """Returns times (N,) and coefficients (N, 8, 3) of polynomials through points (N + 1, 3) that keep the limits.

    Starts with length over speed. Extends pieces that are too fast, and shortens the others, so that all reach a limit.
    Returns the fastest of the tried curves, stretched until no piece exceeds the limits.
    """
    seconds = np.linalg.norm(np.diff(points_m, axis=0), axis=1) / max_mps
    best_s, best = np.inf, (seconds, np.zeros((len(seconds), DEGREE + 1, 3)))
    for _ in range(ROUNDS):
        coefficients = minimum_snap(points_m, seconds)
        share = share_of_limits(seconds, coefficients, max_mps, max_mps2)
        if share.max() * seconds.sum() < best_s:
            best_s, best = share.max() * seconds.sum(), stretch(seconds, coefficients, share.max())
        seconds = seconds * np.clip(share, 0.5, 2.0) ** 0.5
    return best


def smooth(
    room: Room, path_m: F64, *, margin_m: float, max_mps: float, max_mps2: float, most_pieces: int = 40
) -> tuple[F64, F64] | None:
    """Fits polynomials to a path (N, 3), with a clearance above `margin_m` everywhere, within these limits.

    If the curve has too little clearance, the line there gets a point in its middle. Returns the pieces' times (M,) [s]
    and coefficients (M, 8, 3) [m/s^k]; None if `most_pieces` are not enough.
    """
    while len(path_m) - 1 <= most_pieces:
        seconds, coefficients = timed(path_m, max_mps, max_mps2)
        tight = too_tight(room, seconds, coefficients, margin_m, max_mps)
        if len(tight) == 0:
            return seconds, coefficients
        middles_m = 0.5 * (path_m[tight] + path_m[tight + 1])
        path_m = np.insert(path_m, tight + 1, middles_m, axis=0)
    return None


def too_tight(room: Room, seconds: F64, coefficients: F64, margin_m: float, max_mps: float) -> np.ndarray:
    """Returns the pieces with a clearance of at most `margin_m` somewhere. None is missed: between two samples less
    than `step_m` apart, clearance is at most half of that below the clearance at the nearer one."""
    step_m = 0.02
    at_s = np.arange(0.0, float(seconds.sum()) + step_m / max_mps, step_m / max_mps)
    tight = room(curve(seconds, coefficients, at_s)) - 0.5 * step_m <= margin_m
    piece = np.searchsorted(np.cumsum(seconds), at_s, side="right")
    return np.unique(np.minimum(piece[tight], len(seconds) - 1))
