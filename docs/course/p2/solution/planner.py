"""Project 2, reference solution: a path through a known map with A*. Uses neither the vehicle nor `vizflyt`."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from itertools import product

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
# Clearance of the body's centre: points (N, 3) [m] to (N,) [m]; (1) of the assignment.
Room = Callable[[F64], F64]

# Parts of a segment shorter than this that are not proven to be free count as blocked. [m]
SHORTEST_M = 0.005


def are_free(room: Room, from_m: F64, to_m: F64, margin_m: float = 0.0) -> npt.NDArray[np.bool_]:
    """Returns which segments from points (N, 3) to points (N, 3) have a clearance above `margin_m` everywhere: (N,).

    Clearance changes by at most 1 m per metre. A segment is free if the clearance at its middle, minus the margin, is
    more than half of its length. Otherwise both halves are checked.
    """
    free = np.ones(len(from_m), bool)
    of = np.arange(len(from_m))
    while len(of):
        middle_m = 0.5 * (from_m + to_m)
        half_m = 0.5 * np.linalg.norm(to_m - from_m, axis=1)
        left_m = room(middle_m) - margin_m
        free[of[(left_m <= 0) | ((left_m <= half_m) & (half_m < SHORTEST_M))]] = False
        again = (left_m <= half_m) & free[of]
        of = np.concatenate([of[again], of[again]])
        from_m, middle_m, to_m = from_m[again], middle_m[again], to_m[again]
        from_m, to_m = np.concatenate([from_m, middle_m]), np.concatenate([middle_m, to_m])
    return free


def is_free(room: Room, from_m: F64, to_m: F64, margin_m: float = 0.0) -> bool:
    """Returns whether a segment between points (3,) has a clearance above `margin_m` everywhere."""
    return bool(are_free(room, np.asarray(from_m)[None], np.asarray(to_m)[None], margin_m)[0])


def length_m(path_m: F64) -> float:
    """Returns the length of a path (N, 3). [m]"""
    return float(np.linalg.norm(np.diff(path_m, axis=0), axis=1).sum())


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
    little clearance. [m, world]
    """
    start_m, goal_m = np.asarray(start_m, float), np.asarray(goal_m, float)
    # The start is a node. A border of blocked nodes makes bounds checks unnecessary.
    before = np.floor((start_m - low_m) / spacing_m).astype(int) + 1
    after = np.floor((high_m - start_m) / spacing_m).astype(int) + 1
    shape = before + after + 1
    if (before < 1).any() or (after < 1).any():
        return None
    axes = [start_m[i] + spacing_m * np.arange(-before[i], after[i] + 1) for i in range(3)]
    nodes_m = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    room_m = room(nodes_m)
    inside = np.zeros(shape, bool)
    inside[1:-1, 1:-1, 1:-1] = True
    room_m[~inside.ravel()] = -np.inf

    start = int(np.ravel_multi_index(tuple(before), tuple(shape)))
    ends = np.argsort(np.linalg.norm(nodes_m - goal_m, axis=1))[:8]
    ends = ends[(room_m[ends] > margin_m) & are_free(room, nodes_m[ends], np.tile(goal_m, (len(ends), 1)), margin_m)]
    if room_m[start] <= margin_m or len(ends) == 0:
        return None
    end = int(ends[0])

    steps = np.array([step for step in product((-1, 0, 1), repeat=3) if any(step)])
    offsets = steps @ np.array([shape[1] * shape[2], shape[2], 1])
    edges_m = spacing_m * np.linalg.norm(steps, axis=1)
    apart = np.sort(np.abs(nodes_m - nodes_m[end]), axis=1)
    guess_m = apart @ np.array([3**0.5 - 2**0.5, 2**0.5 - 1, 1.0])  # (3): the smallest difference first

    cost_m = np.full(len(nodes_m), np.inf)
    parent = np.full(len(nodes_m), -1)
    closed = np.zeros(len(nodes_m), bool)
    cost_m[start] = 0.0
    queue = [(guess_m[start], start)]
    while queue:
        here = heapq.heappop(queue)[1]
        if here == end:
            break
        if closed[here]:
            continue
        closed[here] = True
        there = here + offsets
        # Lower bound of the clearance on an edge: half of the sum of its ends, minus half of its length.
        least_m = 0.5 * (room_m[here] + room_m[there] - edges_m)
        through_m = cost_m[here] + edges_m
        better = (least_m > margin_m) & (through_m < cost_m[there]) & ~closed[there]
        there = there[better]
        cost_m[there] = through_m[better]
        parent[there] = here
        for total_m, node in zip((cost_m[there] + guess_m[there]).tolist(), there.tolist()):
            heapq.heappush(queue, (total_m, node))
    else:
        return None
    way = [end]
    while way[-1] != start:
        way.append(int(parent[way[-1]]))
    path_m = nodes_m[way[::-1]]
    return path_m if end == start or np.allclose(path_m[-1], goal_m) else np.concatenate([path_m, [goal_m]])


def shorten(room: Room, path_m: F64, margin_m: float = 0.3) -> F64:
    """Removes unnecessary points of a path (N, 3): connects each point with the last one that is freely visible."""
    kept = [0]
    while kept[-1] < len(path_m) - 1:
        here = kept[-1]
        later = np.arange(here + 1, len(path_m))
        seen = are_free(room, np.tile(path_m[here], (len(later), 1)), path_m[later], margin_m)
        # The path's next edge is always free, in spite of rounding.
        kept.append(int(later[seen].max(initial=here + 1)))
    return path_m[kept]
