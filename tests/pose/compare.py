"""Computes the absolute trajectory errors of a folder's fused trajectories with evo, and compares them with this
project's."""

import csv
import pathlib
import sys

from evo.core import metrics, sync
from evo.tools import file_interface


def ate_m(folder: pathlib.Path, name: str) -> float:
    """Returns the absolute trajectory error, unaligned, root mean square. [m]"""
    files = (folder / f"{name}-{kind}.tum" for kind in ("truth", "fused"))
    truth, fused = map(file_interface.read_tum_trajectory_file, files)
    assert truth.num_poses == fused.num_poses > 300, f"{name}: {fused.num_poses} poses"
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data(sync.associate_trajectories(truth, fused, max_diff=1e-4))
    return float(error.get_statistic(metrics.StatisticsType.rmse))


def main() -> None:
    folder = pathlib.Path(sys.argv[1])
    found: dict[str, float] = {}
    print("| flight | poses Hz | noise mm | IMU | ATE mm | with outliers mm | outliers | accepted | true left out |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name, ours_m, *counts in csv.reader((folder / "ate.csv").open()):
        found[name] = ate_m(folder, name)
        assert abs(found[name] - float(ours_m)) < 1e-6, f"{name}: {found[name]} m by evo, {ours_m} m by us"
        if not name.endswith("-outliers"):
            continue
        flight = name.removesuffix("-outliers")
        clean_m, with_outliers_m = found[f"{flight}-clean"], found[name]
        row = [*flight.split("-"), f"{1e3 * clean_m:.2f}", f"{1e3 * with_outliers_m:.2f}", *counts]
        print(f"| {' | '.join(row)} |")
        assert int(counts[0]) > 5, f"{name}: too few outliers"
        assert with_outliers_m <= 1.3 * clean_m, f"{name}: {with_outliers_m} m, without them {clean_m} m"
    assert len(found) >= 40, "too few to compare"


main()
