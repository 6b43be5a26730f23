#!/usr/bin/env python3
"""Measures the error of every filter on many data sets: the basis of the bounds of projects 0 and 1. For instructors.

    python measure.py sets/*/data            starters and solutions of this folder
    python measure.py sets/*/data --ahrs     also the filters of the Python package `ahrs` (pip install ahrs)

Each row is a filter in a case of `given/estimate.py`: median and maximum over all data sets.
"""

import argparse
import importlib.util
import sys
from pathlib import Path

import numpy as np
from score_attitude import CASES, first_ns, read, score, trajectory

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "given"))

import attitude  # noqa: E402
import estimate  # noqa: E402

OURS = [
    ("gyroscope alone", "p0/starter/complementary.py"),
    ("complementary", "p0/solution/complementary.py"),
    ("Madgwick", "p1/solution/madgwick.py"),
    ("UKF", "p1/solution/ukf.py"),
]
SETTLE_S = {"calibrated": 0.0, "uncalibrated": 0.0, "restart": CASES["p1-g/ukf-restart"].settle_s}
# Minimum time at rest at the beginning. [s]
STANDS_S = 2.0


def ours(path):
    """Returns a function from samples to attitudes."""
    spec = importlib.util.spec_from_file_location(f"filter_{path.parts[-3]}_{path.parts[-2]}_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return lambda case, *readings: estimate.estimate(module.Filter(), *readings)


def theirs(kind, **gains):
    """Returns such a function for a filter of `ahrs`. It has no calibration at rest, so the gyroscope is calibrated."""
    import ahrs

    def run(case, at_ns, gyro_radps, accel_mps2):
        if case != "restart":
            stands = at_ns < at_ns[0] + STANDS_S * 1e9
            gyro_radps = gyro_radps - gyro_radps[stands].mean(axis=0)
        first = attitude.level(accel_mps2[0])[[3, 0, 1, 2]]
        made = getattr(ahrs.filters, kind)(gyr=gyro_radps, acc=accel_mps2, frequency=100.0, q0=first, **gains)
        return np.asarray(made.Q)[:, [1, 2, 3, 0]]

    return run


def main():
    parser = argparse.ArgumentParser(description="Measures every filter on many data sets.")
    parser.add_argument("data", nargs="+", type=Path, help="folders of `vizflyt export --format euroc`")
    parser.add_argument("--ahrs", action="store_true", help="the filters of the package ahrs, too")
    arguments = parser.parse_args()
    filters = [(name, ours(HERE / path)) for name, path in OURS]
    if arguments.ahrs:
        filters += [
            ("ahrs Madgwick, its gain of 0.033", theirs("Madgwick")),
            ("ahrs Madgwick, our gain of 0.004", theirs("Madgwick", gain=0.004)),
            ("ahrs Mahony, its gains of 1 and 0.3", theirs("Mahony")),
            ("ahrs Mahony, our gains", theirs("Mahony", k_P=0.05, k_I=0.000625)),
            ("ahrs Complementary, its gain of 0.9", theirs("Complementary")),
            ("ahrs UKF, its covariances", theirs("UKF")),
        ]
    print(f"{len(arguments.data)} data sets: median / worst of tilt rms [deg]; of |heading drift| [deg/min]")
    for name, run in filters:
        for case, settle_s in SETTLE_S.items():
            found = []
            for data in arguments.data:
                true_file = data / "mav0/state_groundtruth_estimate0/data.csv"
                from_ns = first_ns(true_file)
                at_ns, *readings = estimate.seen(attitude.read_imu(data), case)
                q_xyzw = run(case, at_ns, *readings)
                estimated = trajectory(at_ns, np.hstack([np.zeros((len(q_xyzw), 3)), q_xyzw]), from_ns)
                figures = score(read(true_file, from_ns), estimated, settle_s)
                found.append([figures.tilt_rms_deg, abs(figures.heading_drift_deg_per_min)])
            (tilt, drift), (most_tilt, most_drift) = np.median(found, axis=0), np.max(found, axis=0)
            print(f"{name:36} {case:13} {tilt:6.2f} /{most_tilt:6.2f}   {drift:6.1f} /{most_drift:6.1f}", flush=True)


if __name__ == "__main__":
    main()
