"""Compares `vizflyt evaluate` with evo: random trajectories and those of flights, with every alignment."""

import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface

TOLERANCE = 1e-6


def wanted(
    truth: PoseTrajectory3D, estimate: PoseTrajectory3D, align: str, how: str, metres: float
) -> dict[str, float]:
    method = {"nearest": sync.SyncMethod.nearest_time, "interpolate": sync.SyncMethod.interpolation}[how]
    truth, estimate = sync.associate_trajectories(truth, estimate, sync_method=method, max_diff=0.01)
    scale = 1.0
    if align != "none":
        scale = float(estimate.align(truth, correct_scale=align == "sim3")[2]) if align == "sim3" else 1.0
        if align == "se3":
            estimate.align(truth)
    figures: dict[str, float] = {"pairs": truth.num_poses, "scale": scale}
    for name, relation in (("", "translation_part"), ("_rot", "rotation_angle_deg")):
        ape = metrics.APE(metrics.PoseRelation[relation])
        ape.process_data((truth, estimate))
        unit = "deg" if name else "m"
        figures[f"ate{name}_rmse_{unit}"] = float(ape.get_statistic(metrics.StatisticsType.rmse))
        figures[f"ate{name}_max_{unit}"] = float(ape.get_statistic(metrics.StatisticsType.max))
        rpe = metrics.RPE(metrics.PoseRelation[relation], delta=metres, delta_unit=metrics.Unit.meters)
        rpe.process_data((truth, estimate))
        kind = "rot_rmse_deg" if name else "trans_rmse_m"
        figures[f"rpe_{kind}"] = float(rpe.get_statistic(metrics.StatisticsType.rmse))
        figures["rpe_pairs"] = len(rpe.error)
    return figures


def random_flight(random: np.random.Generator, folder: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
    """Writes a smooth truth and an estimate as TUM files; the estimate has its own frame, drift, noise and stamps."""
    count = 600
    stamps = 1.7e9 + np.arange(count) * 0.01
    steps = np.cumsum(random.normal(0, 1, (count, 3)), axis=0) * 0.002
    positions = np.cumsum(steps, axis=0)
    turns = np.cumsum(np.cumsum(random.normal(0, 1e-3, (count, 4)), axis=0), axis=0) + random.normal(0, 1, 4)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    truth = PoseTrajectory3D(positions, turns, stamps)
    kept = np.arange(0, count, int(random.integers(1, 4)))
    noise = random.normal(0, 0.01, (len(kept), 3)) + np.linspace(0, 0.2, len(kept))[:, None]
    scale = random.uniform(0.5, 2.0)
    other = turns[kept] + random.normal(0, 0.01, (len(kept), 4))
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    late = random.choice([0.0, 0.0031])
    estimate = PoseTrajectory3D((positions[kept] + noise) * scale + random.normal(0, 3, 3), other, stamps[kept] + late)
    files = folder / "truth.tum", folder / "estimate.tum"
    for file, trajectory in zip(files, (truth, estimate), strict=True):
        file_interface.write_tum_trajectory_file(file, trajectory)
    return files


def compare(vizflyt: str, truth: pathlib.Path, estimate: pathlib.Path, metres: float) -> int:
    compared = 0
    for align in ("none", "se3", "sim3"):
        for how in ("nearest", "interpolate"):
            read = [file_interface.read_tum_trajectory_file(file) for file in (truth, estimate)]
            expected = wanted(read[0], read[1], align, how, metres)
            command = [vizflyt, "evaluate", str(truth), str(estimate), "--json", "--align", align, "--associate", how]
            printed = subprocess.run([*command, "--delta", f"{metres}m"], check=True, capture_output=True, text=True)
            found = json.loads(printed.stdout)
            for name, value in expected.items():
                off = abs(found[name] - value)
                same = off <= TOLERANCE * max(1.0, abs(value))
                assert same, f"{truth} {align} {how} {name}: {found[name]}, evo {value}"
                compared += 1
    return compared


def main() -> None:
    vizflyt, flights = sys.argv[1], pathlib.Path(sys.argv[2])
    random = np.random.default_rng(7)
    compared = 0
    with tempfile.TemporaryDirectory() as name:
        for _ in range(20):
            compared += compare(vizflyt, *random_flight(random, pathlib.Path(name)), metres=0.2)
    # Both refuse trajectories along a line, which do not determine the rotation.
    for truth in sorted(flights.glob("Eight-*-truth.tum"))[:8]:
        compared += compare(vizflyt, truth, truth.with_name(truth.name.replace("truth", "fused")), metres=1.0)
    assert compared >= 1500, compared
    print(f"vizflyt evaluate: {compared} figures as evo has them")


main()
