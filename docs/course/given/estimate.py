#!/usr/bin/env python3
"""Runs a filter on a data set, and writes its attitudes. Given; nothing is to be filled in here.

    python estimate.py ../data --filter complementary --case calibrated -o calibrated.tum

Cases determine the samples that the filter receives:

    calibrated     all samples, as measured
    uncalibrated   all samples; each axis of the gyroscope has a bias of +1 or -1 deg/s
    restart        as uncalibrated, but the samples begin in the air, 12 s after the start of the data set
"""

import argparse
import importlib
from pathlib import Path

import numpy as np
from attitude import read_imu, write_tum

# Zero-rate offset of a BMI088 before calibration, from its data sheet. [rad/s]
OFFSET_RADPS = np.radians(np.array([1.0, -1.0, 1.0]))
# At this time the vehicle flies its figures. [s]
RESTART_S = 12.0


def estimate(filter_, at_ns, gyro_radps, accel_mps2):
    """Returns the filter's attitude after each sample, shape (N, 4)."""
    attitudes = []
    for ns, gyro, accel in zip(at_ns, gyro_radps, accel_mps2):
        filter_.update(float(ns - at_ns[0]) * 1e-9, gyro, accel)
        attitudes.append(np.array(filter_.q_xyzw, float))
    return np.array(attitudes)


def seen(imu, case):
    """Returns instants, gyroscope and accelerometer samples of a case."""
    gyro_radps = imu.gyro_radps if case == "calibrated" else imu.gyro_radps + OFFSET_RADPS
    from_ns = imu.at_ns[0] + (int(RESTART_S * 1e9) if case == "restart" else 0)
    kept = imu.at_ns >= from_ns
    return imu.at_ns[kept], gyro_radps[kept], imu.accel_mps2[kept]


def main():
    parser = argparse.ArgumentParser(description="Runs a filter over a data set in EuRoC's form.")
    parser.add_argument("data", type=Path, help="the folder that `vizflyt export --format euroc` has made")
    parser.add_argument("--filter", default="complementary", help="the module whose class Filter runs")
    parser.add_argument("--case", choices=["calibrated", "uncalibrated", "restart"], default="calibrated")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the attitudes, as TUM's text")
    arguments = parser.parse_args()
    at_ns, gyro_radps, accel_mps2 = seen(read_imu(arguments.data), arguments.case)
    filter_ = importlib.import_module(arguments.filter).Filter()
    write_tum(arguments.output, at_ns, estimate(filter_, at_ns, gyro_radps, accel_mps2))


if __name__ == "__main__":
    main()
