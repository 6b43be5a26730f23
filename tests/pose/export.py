"""Reads the output of `vizflyt export` with other projects' packages: evo, Pillow, PyYAML, pandas with pyarrow, pypcd4.

    export.py VIZFLYT

A graded flight in lock-step is logged with all images, so that the pose of each rendered image is known exactly. Its
project is p2 with a LiDAR, a range finder, and a camera with the noise of a Raspberry Pi's.
"""

import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
import pandas as pd
import yaml
from evo.core import sync
from evo.tools import file_interface
from PIL import Image
from pypcd4 import PointCloud

PROJECTS = pathlib.Path(__file__).parents[2] / "render-server/scenes/projects"
SENSED = """
[levels.ug.cameras.imaging]
sensor = "imx219"
illuminance_lx = 100.0
binning = 1

[[levels.ug.cameras]]
name = "truth"
width_px = 160
height_px = 120
horizontal_fov_deg = 80.0
position_m = [0.0, 0.0, -0.03]
tilt_deg = -90.0
rate_hz = 20.0

[[levels.ug.sensors]]
name = "top"
model = "os1-16"
position_m = [0.0, 0.0, 0.1]

[[levels.ug.sensors]]
name = "below"
model = "tfmini"
position_m = [0.0, 0.0, -0.05]
tilt_deg = -90.0
"""


def run(*command):
    return subprocess.run([str(part) for part in command], check=True, capture_output=True, text=True).stdout


def check_tum(vizflyt: str, log: pathlib.Path, folder: pathlib.Path) -> None:
    run(vizflyt, "export", log, "--format", "tum", "-o", folder)
    truth = file_interface.read_tum_trajectory_file(folder / "groundtruth.txt")
    shown = file_interface.read_tum_trajectory_file(folder / "groundtruth_images.txt")
    assert truth.check()[0] and shown.check()[0]
    # Images have the stamps of the instants they show: at these times the camera's trajectory passes through the poses
    # they were rendered from.
    truth_at, shown_at = sync.associate_trajectories(truth, shown, sync_method=sync.SyncMethod.interpolation)
    moving = np.linalg.norm(np.gradient(shown_at.positions_xyz, shown_at.timestamps, axis=0), axis=1) > 0.5
    off = np.linalg.norm(truth_at.positions_xyz - shown_at.positions_xyz, axis=1)[moving]
    assert moving.sum() > 50 and np.median(off) < 0.005, np.median(off)
    # Stamps late by 40 ms, the age of their poses, would give larger errors.
    late = truth.timestamps - 0.040
    wrong = np.stack([np.interp(shown_at.timestamps, late, axis) for axis in truth.positions_xyz.T], axis=1)
    assert np.median(np.linalg.norm(wrong - shown_at.positions_xyz, axis=1)[moving]) > 3 * np.median(off)
    rows = [line.split() for line in (folder / "associations.txt").read_text().splitlines()]
    assert len(rows) > 100
    log_images = pd.read_csv(folder / "images.csv")
    for (rgb_at, rgb, depth_at, depth), row in list(zip(rows, log_images.itertuples()))[::40]:
        assert rgb_at == depth_at and abs(float(rgb_at) * 1e9 - row.timestamp_ns) < 1000
        color, metres = Image.open(folder / rgb), np.asarray(Image.open(folder / depth))
        assert color.mode == "RGB" and color.size == (row.width_px, row.height_px)
        assert metres.dtype == np.uint16 and metres.shape == color.size[::-1]
        # 5000 per metre: whole millimetres are multiples of 5.
        assert (metres % 5 == 0).all() and 0.1 < np.median(metres[metres > 0]) / 5000 < 13.2
    assert np.abs(np.loadtxt(folder / "accelerometer.txt")[:, 3].mean() - 9.8) < 0.5


def check_euroc(vizflyt: str, log: pathlib.Path, folder: pathlib.Path) -> None:
    run(vizflyt, "export", log, "--format", "euroc", "-o", folder)
    mav = folder / "mav0"
    truth_csv = mav / "state_groundtruth_estimate0/data.csv"
    truth = file_interface.read_euroc_csv_trajectory(truth_csv)
    assert truth.check()[0] and truth.num_poses > 500
    info = run(pathlib.Path(sys.executable).with_name("evo_traj"), "euroc", truth_csv)
    assert f"{truth.num_poses} poses" in info, info
    # The result must equal that of `evaluate` on the log itself.
    same = json.loads(run(vizflyt, "evaluate", f"{log}#/pose", truth_csv, "--json"))
    assert same["pairs"] == truth.num_poses and same["ate_max_m"] < 1e-9, same
    sensor = yaml.safe_load((mav / "cam0/sensor.yaml").read_text())
    body_from_cam = np.array(sensor["T_BS"]["data"]).reshape(4, 4)
    assert np.allclose(body_from_cam[:3, :3] @ body_from_cam[:3, :3].T, np.eye(3), atol=1e-9)
    # A forward camera's z is body x.
    assert body_from_cam[0, 2] > 0.9, body_from_cam
    names = pd.read_csv(mav / "cam0/data.csv").iloc[:, 1]
    assert sorted(names) == sorted(path.name for path in (mav / "cam0/data").iterdir())
    assert Image.open(mav / "cam0/data" / names[0]).size == tuple(sensor["resolution"])
    imu = np.loadtxt(mav / "imu0/data.csv", delimiter=",")
    assert imu.shape[1] == 7 and (np.diff(imu[:, 0]) > 0).all()
    # The gyroscope's rate must equal the rotation of the truth.
    yaw = np.unwrap(np.arctan2(*truth_yaw(truth)))
    turned = np.trapezoid(imu[:, 3], imu[:, 0] * 1e-9)
    assert abs(turned - (yaw[-1] - yaw[0])) < 0.1, (turned, yaw[-1] - yaw[0])


def matrices(table, name):
    """Returns the poses NAME_* of a table as 4 x 4 matrices."""
    x, y, z, w = (table[f"{name}_{axis}"].to_numpy() for axis in ("qx", "qy", "qz", "qw"))
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], 1)
    poses[:, 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], 1)
    poses[:, 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], 1)
    poses[:, :3, 3] = table[[f"{name}_{axis}" for axis in "xyz"]]
    return poses


def check_sensors(folder: pathlib.Path) -> None:
    """Compares an exported LiDAR with the depth of a camera, and a range finder with the flown height."""
    mav = folder / "mav0"
    lidar = yaml.safe_load((mav / "top/sensor.yaml").read_text())
    assert lidar["sensor_type"] == "lidar" and 5 < lidar["rate_hz"] < 25, lidar
    body_from_lidar = np.array(lidar["T_BS"]["data"]).reshape(4, 4)
    truth = pd.read_csv(mav / "state_groundtruth_estimate0/data.csv")
    named = ("p_x", "p_y", "p_z", "p_qw", "p_qx", "p_qy", "p_qz")
    truth = truth.rename(columns=dict(zip(truth.columns[1:8], named)))
    stamps, poses = truth.iloc[:, 0].to_numpy(), matrices(truth, "p")
    images = pd.read_csv(folder / "images.csv")
    front = images[images.camera == "front"].reset_index(drop=True)
    world_from_cam = matrices(front, "pose_at_image") @ matrices(front, "body_from_cam")
    sweeps = sorted((mav / "top/data").iterdir())
    assert len(sweeps) > 50 and [path.name for path in sweeps] == list(pd.read_csv(mav / "top/data.csv").iloc[:, 1])
    each = []
    for path in sweeps[20::3]:
        cloud = PointCloud.from_path(path)
        assert cloud.fields == ("x", "y", "z", "before_ns", "intensity", "ring") and cloud.points > 1000
        p_lidar, before = cloud.numpy(("x", "y", "z")).astype(float), cloud.numpy(("before_ns",))[:, 0].astype(np.int64)
        # Each beam starts from the vehicle's pose when it was fired; takes the nearest pose.
        fired = np.clip(np.searchsorted(stamps, int(path.stem) - before), 0, len(stamps) - 1)
        from_lidar = poses[fired] @ body_from_lidar
        p_world = np.einsum("nij,nj->ni", from_lidar[:, :3, :3], p_lidar) + from_lidar[:, :3, 3]
        index = (front.timestamp_ns - int(path.stem)).abs().argmin()
        cam = np.linalg.inv(world_from_cam[index])
        p_cam = p_world @ cam[:3, :3].T + cam[:3, 3]
        p_cam = p_cam[p_cam[:, 2] > 0.3]
        row = front.loc[index]
        u = np.rint(row.fx_px * p_cam[:, 0] / p_cam[:, 2] + row.cx_px).astype(int)
        v = np.rint(row.fy_px * p_cam[:, 1] / p_cam[:, 2] + row.cy_px).astype(int)
        inside = (u >= 0) & (u < row.width_px) & (v >= 0) & (v < row.height_px)
        depth = np.asarray(Image.open(folder / row.depth_file)) / 1000
        seen = depth[v[inside], u[inside]]
        each.append(np.abs(seen - p_cam[inside, 2])[seen > 0])
    off = np.concatenate(each)
    median, most = np.quantile(off, [0.5, 0.8])
    print(f"LiDAR beside a camera's depth: {len(off)} points, median {median:.3f} m, 80 % {most:.3f} m")
    assert len(off) > 5000 and median < 0.04, median
    below = pd.read_csv(mav / "below/data.csv")
    height = np.interp(below.iloc[:, 0], stamps, truth.p_z)
    level = (height > 0.8) & (height < 2.5)
    assert np.nanmedian(np.abs(below.iloc[:, 1] - height + 0.05)[level]) < 0.06


def check_noise(folder: pathlib.Path) -> None:
    """Checks that of two cameras at one place, the one with sensor noise differs from the perfect one in single
    pixels."""
    images = pd.read_csv(folder / "images.csv")
    pairs = images[images.camera == "down"].merge(images[images.camera == "truth"], on="timestamp_ns")
    assert len(pairs) > 50
    for pair in list(pairs.itertuples())[::20]:
        noisy, perfect = (np.asarray(Image.open(folder / file), float) for file in (pair.file_x, pair.file_y))
        # Differences of neighbouring pixels: exposure changes both alike.
        noise = np.std(np.diff(noisy - perfect, axis=1)) / np.sqrt(2)
        assert 1.0 < noise < 30.0, noise


def truth_yaw(truth):
    w, x, y, z = truth.orientations_quat_wxyz.T
    return 2 * (w * z + x * y), 1 - 2 * (y * y + z * z)


def check_parquet(vizflyt: str, log: pathlib.Path, folder: pathlib.Path) -> None:
    run(vizflyt, "export", log, "--format", "parquet", "-o", folder)
    tables = {path.stem: pd.read_parquet(path, engine="pyarrow") for path in folder.glob("*.parquet")}
    assert {"images", "poses", "imu", "setpoints_asked", "setpoints_sent", "odometry"} == set(tables)
    csv = folder.with_name("beside")
    run(vizflyt, "export", log, "--format", "euroc", "-o", csv)
    # For images, only the columns that are not file names.
    for name, first in (("images", 4), ("setpoints_sent", 0), ("setpoints_asked", 0)):
        of_csv = pd.read_csv(csv / f"{name}.csv")
        # CSV writes 1.0 as 1.
        table, of_csv = tables[name].iloc[:, first:], of_csv.iloc[:, first:]
        pd.testing.assert_frame_equal(table, of_csv, check_dtype=False, rtol=1e-12)
    images = tables["images"]
    assert images.timestamp_ns.dtype == np.int64 and set(images.camera) == {"front", "down", "truth"}
    assert (folder / images.file[0]).exists() and (folder / images.depth_file[0]).exists()
    known = images.dropna(subset=["pose_x"])
    assert (known.position_sigma_x > 0).all() and len(known) > 100
    assert json.loads(tables["setpoints_asked"].setpoint[0]) is not None


def check_refusals(vizflyt: str, log: pathlib.Path, folder: pathlib.Path) -> None:
    def refused(*command):
        done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
        assert done.returncode != 0
        return done.stderr

    there = folder / "there"
    there.mkdir()
    assert "nothing is overwritten" in refused(vizflyt, "export", log, "--format", "tum", "-o", there)
    out = folder / "out"
    assert "camera 'nose'" in refused(vizflyt, "export", log, "--format", "tum", "--camera", "nose", "-o", out)
    text = folder / "text.mcap"
    text.write_text("hello")
    assert "not an MCAP file" in refused(vizflyt, "export", text, "--format", "tum", "-o", out)
    # Truncated before its first image, like the log of a flight killed on the ground.
    cut = folder / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:3000])
    assert "no image" in refused(vizflyt, "export", cut, "--format", "euroc", "-o", out) or out.exists() is False
    assert not out.exists() and not out.with_name("out.part").exists()


def main() -> None:
    vizflyt = sys.argv[1]
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        report = folder / "report"
        project = folder / "p2-sensed.toml"
        project.write_text((PROJECTS / "p2.toml").read_text().replace("\n# Graduate:", SENSED + "\n# Graduate:"))
        run(vizflyt, "grade", "avoid", "--project", project, "--seeds", "1", "--log", "full", "--report", report,
            "--keys", folder / "keys")  # fmt: skip
        log = report / "logs/day-1.mcap"
        check_tum(vizflyt, log, folder / "tum")
        check_euroc(vizflyt, log, folder / "euroc")
        check_sensors(folder / "euroc")
        check_noise(folder / "euroc")
        check_parquet(vizflyt, log, folder / "parquet")
        check_refusals(vizflyt, log, folder)
    print("vizflyt export: evo, Pillow, PyYAML, pandas and pypcd4 read what it writes")


main()
