#!/usr/bin/env python3
"""Computes the error of an estimated attitude, and its points in a project of the course.

    python score_attitude.py data/mav0/state_groundtruth_estimate0/data.csv my-p0/calibrated.tum --case p0/calibrated
    python score_attitude.py live/FLIGHT.mcap --case p0/live

Tilt is the angle between the estimated and the true up direction. It contains roll and pitch, but no heading. Heading
is the remaining rotation. An IMU does not measure its origin, so the score is the drift: the slope of a line through
the heading error. Only attitudes in the air count, after the filter's time to settle.
"""

import argparse
import csv
import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np


class Bounds(NamedTuple):
    """Points of a case: all points up to the first bound of a figure, half of them up to the second."""

    tilt_points: float
    tilt_deg: tuple[float, float]
    heading_points: float
    heading_deg_per_min: tuple[float, float]
    settle_s: float = 0.0


NEVER = (0.0, 0.0)
# Measured for the seeds and sensors in docs/BENCHMARKS.md, "Attitude filters".
CASES = {
    "p0/calibrated": Bounds(15, (1.5, 1.8), 5, (4.0, 8.0)),
    "p0/uncalibrated": Bounds(20, (1.5, 4.0), 10, (4.0, 8.0)),
    "p0/live": Bounds(10, (1.5, 1.8), 0, NEVER),
    "p1-ug/uncalibrated": Bounds(20, (2.5, 4.0), 5, (4.0, 8.0)),
    "p1-ug/restart": Bounds(20, (4.0, 8.0), 0, NEVER, 15.0),
    "p1-ug/live": Bounds(10, (2.5, 4.0), 0, NEVER),
    "p1-g/madgwick-uncalibrated": Bounds(10, (2.5, 4.0), 0, NEVER),
    "p1-g/madgwick-restart": Bounds(10, (4.0, 8.0), 0, NEVER, 15.0),
    "p1-g/ukf-uncalibrated": Bounds(10, (1.5, 2.0), 5, (4.0, 8.0)),
    "p1-g/ukf-restart": Bounds(15, (2.0, 4.0), 0, NEVER, 15.0),
    "p1-g/live": Bounds(10, (1.5, 2.0), 0, NEVER),
}
# Below this distance from its place on the ground, the vehicle is not in the air. [m]
AIR_M = 0.3
# Maximum time between two true poses for interpolation, and between an attitude and an instant. [s]
GAP_S = 0.2
# Minimum fraction of the flight with an estimate, so that omitting bad estimates gains nothing.
LEAST_TOLD = 0.95


class Trajectory(NamedTuple):
    at_s: np.ndarray
    """Time since the first instant of the log or data set."""
    p_m: np.ndarray
    q_xyzw: np.ndarray


class Figures(NamedTuple):
    tilt_rms_deg: float
    tilt_max_deg: float
    heading_drift_deg_per_min: float
    heading_rms_deg: float
    """Relative to its mean."""
    seconds: float
    poses: int


def read(path, from_ns=0):
    """Returns a trajectory from a CSV file of EuRoC or a text file of TUM; seconds count from `from_ns`."""
    rows = []
    with open(path, newline="") as file:
        for line in file:
            if line.startswith("#") or not line.strip():
                continue
            if "," in line:
                row = next(csv.reader([line]))
                x, y, z, qw, qx, qy, qz = (float(one) for one in row[1:8])
                rows.append((int(row[0]), x, y, z, qx, qy, qz, qw))
            else:
                stamp, *words = line.split()
                # Parsed as integers, because a float cannot represent nanoseconds since 1970.
                seconds, _, part = stamp.partition(".")
                x, y, z, qx, qy, qz, qw = (float(one) for one in words[:7])
                rows.append((int(seconds) * 10**9 + int(part[:9].ljust(9, "0")), x, y, z, qx, qy, qz, qw))
    return trajectory([row[0] for row in rows], np.array([row[1:] for row in rows]).reshape(-1, 7), from_ns)


def trajectory(at_ns, numbers, from_ns):
    seconds = np.array([(int(ns) - from_ns) * 1e-9 for ns in at_ns])
    order = np.argsort(seconds, kind="stable")
    q_xyzw = numbers[order, 3:]
    lengths = np.linalg.norm(q_xyzw, axis=1, keepdims=True)
    if not np.isfinite(numbers).all() or (len(lengths) and abs(lengths - 1).max() > 1e-3):
        raise ValueError("an attitude is no unit quaternion")
    return Trajectory(seconds[order], numbers[order, :3], q_xyzw / lengths)


def read_log(path):
    """Returns the true trajectory and the plugin's estimate from a flight's log."""
    import vizflyt  # Why: files can be scored without the package.

    log = vizflyt.Log(path)
    if len(log.odometry.at_ns) == 0:
        raise ValueError(f"{path} holds no /odometry: the plugin has published no attitude")
    from_ns = int(log.poses.at_ns[0])
    both = (log.poses, log.odometry)
    return [trajectory(one.at_ns, np.hstack([one.p_m, one.q_xyzw]), from_ns) for one in both]


def truth_at(truth, at_s):
    """Returns the true attitudes and heights at some instants, and whether they are known."""
    after = np.clip(np.searchsorted(truth.at_s, at_s), 1, len(truth.at_s) - 1)
    before = after - 1
    gap_s = truth.at_s[after] - truth.at_s[before]
    share = ((at_s - truth.at_s[before]) / np.maximum(gap_s, 1e-9))[:, None]
    a, b = truth.q_xyzw[before], truth.q_xyzw[after]
    b = b * np.where((a * b).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    # Poses are some milliseconds apart, so linear interpolation with normalization is accurate.
    q_xyzw = a + share * (b - a)
    q_xyzw = q_xyzw / np.linalg.norm(q_xyzw, axis=1, keepdims=True)
    height_m = truth.p_m[before, 2] + share[:, 0] * (truth.p_m[after, 2] - truth.p_m[before, 2])
    known = (share[:, 0] >= 0) & (share[:, 0] <= 1) & (gap_s <= GAP_S)
    return q_xyzw, height_m, known


def errors(q_xyzw, true_xyzw):
    """Returns the error of each attitude: tilt, heading, and total. [rad]"""
    (ax, ay, az, aw), (bx, by, bz, bw) = q_xyzw.T, true_xyzw.T
    # Rotation from truth to estimate, in world axes: q conj(true).
    x, y = -aw * bx + ax * bw - ay * bz + az * by, -aw * by + ax * bz + ay * bw - az * bx
    z, w = -aw * bz - ax * by + ay * bx + az * bw, aw * bw + ax * bx + ay * by + az * bz
    # The rotation is a rotation about up followed by a tilt, with these angles (swing and twist).
    tilt = 2 * np.arctan2(np.hypot(x, y), np.hypot(z, w))
    heading = 2 * np.arctan2(z, w)
    whole = 2 * np.arctan2(np.sqrt(x * x + y * y + z * z), abs(w))
    return tilt, np.unwrap(heading), whole


def score(truth, estimate, settle_s=0.0):
    """Returns the figures of an estimate."""
    true_xyzw, height_m, known = truth_at(truth, estimate.at_s)
    # If the data begin in the air, the filter gets time to settle.
    from_s = estimate.at_s[0] + settle_s if settle_s and len(estimate.at_s) else -np.inf
    counted = known & (height_m > truth.p_m[0, 2] + AIR_M) & (estimate.at_s >= from_s)
    at_s = estimate.at_s[counted]
    flown_s = truth.at_s[(truth.p_m[:, 2] > truth.p_m[0, 2] + AIR_M) & (truth.at_s >= from_s)]
    if len(flown_s) < 2 or len(at_s) < 2:
        raise ValueError("there is no attitude of a time in the air whose truth is known")
    after = np.searchsorted(at_s, flown_s).clip(1, len(at_s) - 1)
    away_s = np.minimum(abs(at_s[after] - flown_s), abs(at_s[after - 1] - flown_s))
    told = (away_s <= GAP_S).mean()
    if told < LEAST_TOLD:
        raise ValueError(f"only {told:.0%} of the time in the air has an attitude; {LEAST_TOLD:.0%} are asked for")
    tilt, heading, _ = errors(estimate.q_xyzw[counted], true_xyzw[counted])
    slope, _ = np.polyfit(at_s, heading, 1)
    degrees = np.degrees
    return Figures(
        float(degrees(np.sqrt((tilt**2).mean()))),
        float(degrees(tilt.max())),
        float(degrees(slope) * 60),
        float(degrees(heading.std())),
        float(at_s[-1] - at_s[0]),
        int(counted.sum()),
    )


def points(bounds, figures):
    """Returns the points for tilt and for heading."""

    def share(value, limits):
        return 1.0 if value <= limits[0] else 0.5 if value <= limits[1] else 0.0

    return (
        bounds.tilt_points * share(figures.tilt_rms_deg, bounds.tilt_deg),
        bounds.heading_points * share(abs(figures.heading_drift_deg_per_min), bounds.heading_deg_per_min),
    )


def first_ns(path):
    with open(path) as file:
        line = next((line for line in file if line.strip() and not line.startswith("#")), None)
    if line is None:
        raise ValueError(f"{path} holds no pose")
    stamp = line.split("," if "," in line else None)[0]
    return int(stamp) if "," in line else int(stamp.partition(".")[0]) * 10**9


def main():
    parser = argparse.ArgumentParser(description="Scores an attitude against the truth.")
    parser.add_argument("truth", type=Path, help="EuRoC's CSV or TUM's text; or a flight's log, which holds both")
    parser.add_argument("estimate", type=Path, nargs="?", help="TUM's text; not for a log")
    parser.add_argument("--case", choices=list(CASES), help="says what it is worth there")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    bounds = CASES.get(arguments.case)
    try:
        if arguments.estimate is None:
            truth, estimate = read_log(arguments.truth)
        else:
            from_ns = first_ns(arguments.truth)
            truth, estimate = (read(path, from_ns) for path in (arguments.truth, arguments.estimate))
        figures = score(truth, estimate, bounds.settle_s if bounds else 0.0)
    except (OSError, ValueError, IndexError) as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 1
    got = points(bounds, figures) if bounds else None
    if arguments.json:
        print(json.dumps(figures._asdict() | ({} if got is None else {"points": sum(got)})))
        return 0
    print(f"tilt       rms {figures.tilt_rms_deg:.2f} deg, max {figures.tilt_max_deg:.2f}")
    print(
        f"heading    drift {figures.heading_drift_deg_per_min:+.2f} deg/min, "
        f"rms {figures.heading_rms_deg:.2f} deg about its mean"
    )
    print(f"over       {figures.seconds:.1f} s in the air, {figures.poses} attitudes")
    if bounds and got:
        for what, value, most in zip(("tilt", "heading"), got, (bounds.tilt_points, bounds.heading_points)):
            if most:
                print(f"points     {what} {value:g} of {most:g}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
