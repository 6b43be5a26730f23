"""The visual odometries: their mathematics against closed forms, and flights with them."""

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import vizflyt

PLUGINS = Path(__file__).parents[2] / "jetson/plugins/python"
sys.path.insert(0, str(PLUGINS))

import inertial_odometry as inertial  # noqa: E402
import odometry_flight as flight  # noqa: E402
import rgbd_odometry as rgbd  # noqa: E402

# The paper's bound for all trajectories. [m]
BOUND_M = 0.12


def rotations(count):
    random = np.random.default_rng(3)
    return [flight.exp_so3(random.uniform(-3.0, 3.0, 3)) for _ in range(count)]


def test_rotations_are_those_of_the_package():
    for rotation in [*rotations(50), np.diag([-1.0, -1.0, 1.0]), np.diag([1.0, -1.0, -1.0])]:
        pose = vizflyt.Pose("odom", "body", [0, 0, 0], flight.quaternion_xyzw(rotation))
        np.testing.assert_allclose(pose.rotation_matrix, rotation, atol=1e-12)
    quarter = flight.exp_so3(np.array([0, 0, math.pi / 2]))
    np.testing.assert_allclose(quarter @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(flight.exp_so3(np.full(3, 1e-12)), np.eye(3), atol=1e-11)


def test_a_body_at_rest_is_levelled():
    for rotation in rotations(20):
        felt = rotation.T @ [0, 0, 9.8]
        level = flight.level_from_body(felt)
        np.testing.assert_allclose(level @ felt, [0, 0, 9.8], atol=1e-9)
        np.testing.assert_allclose(level @ level.T, np.eye(3), atol=1e-12)
        assert abs(level[1, 0]) < 1e-12 and np.linalg.det(level) > 0


def test_the_imu_carries_a_circle_on():
    # 1.5 m/s on a circle of 2 m, nose along the path: a rate of 0.75 rad/s, and v omega towards the centre.
    v_mps, omega_radps, dt_s = 1.5, 0.75, 0.01
    zero = np.zeros(3)
    bias_g, bias_a = np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.2, -0.1])
    motion = inertial.Motion(0.0, np.eye(3), np.array([v_mps, 0, 0]), zero, bias_g, bias_a)
    accel = np.array([0, v_mps * omega_radps, 9.80665]) + bias_a
    for _ in range(400):
        motion = inertial.moved(motion, accel, np.array([0, 0, omega_radps]) + bias_g, dt_s)
    angle = omega_radps * 4.0
    radius_m = v_mps / omega_radps
    np.testing.assert_allclose(motion.p_m, [radius_m * math.sin(angle), radius_m * (1 - math.cos(angle)), 0], atol=1e-4)
    np.testing.assert_allclose(motion.v_mps, [v_mps * math.cos(angle), v_mps * math.sin(angle), 0], atol=1e-4)
    np.testing.assert_allclose(motion.rotation, flight.exp_so3(np.array([0, 0, angle])), atol=1e-12)


def test_errors_of_the_imu_go_on_as_motions_that_differ_do():
    rotation = rotations(1)[0]
    state = inertial.Motion(
        0.0, rotation, np.array([1.0, 2, 3]), np.array([4.0, 5, 6]), np.array([0.1, 0, 0.2]), np.array([0.3, 0.1, 0])
    )
    accel, gyro, dt_s = np.array([1.0, -2, 9]), np.array([0.5, -0.3, 0.8]), 0.01

    def off_by(change):
        return inertial.Motion(
            0.0,
            state.rotation @ flight.exp_so3(change[inertial.TURN]),
            state.v_mps + change[inertial.V],
            state.p_m + change[inertial.P],
            state.gyro_bias + change[inertial.GYRO],
            state.accel_bias + change[inertial.ACCEL],
        )

    after = inertial.moved(state, accel, gyro, dt_s)
    by_error = inertial.transition(state, accel, gyro, dt_s)
    for index in range(inertial.IMU_SIZE):
        change = np.zeros(inertial.IMU_SIZE)
        change[index] = 1e-6
        other = inertial.moved(off_by(change), accel, gyro, dt_s)
        turn = after.rotation.T @ other.rotation
        turn = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
        found = np.concatenate(
            [turn, other.v_mps - after.v_mps, other.p_m - after.p_m, other.gyro_bias - after.gyro_bias,
             other.accel_bias - after.accel_bias]
        ) / 1e-6
        np.testing.assert_allclose(by_error[:, index], found, atol=1e-4)


def rays(count, views):
    """Returns cameras that look along x from places along y, and true points ahead of them."""
    random = np.random.default_rng(5)
    axes = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    axes = np.broadcast_to(axes, (count, views, 3, 3)).copy()
    from_m = np.zeros((count, views, 3))
    from_m[..., 1] = np.linspace(-0.5, 0.5, views)
    places_m = np.column_stack([random.uniform(1, 6, count), random.uniform(-1, 1, (count, 2))])
    in_cam_m = np.einsum("mnji,mnj->mni", axes, places_m[:, None] - from_m)
    return axes, from_m, in_cam_m[..., :2] / in_cam_m[..., 2:], places_m


def test_rays_meet_where_the_point_is():
    axes, from_m, slopes, places_m = rays(40, 6)
    seen = np.ones((40, 6), bool)
    seen[:20, 3:] = False
    slopes[:20, 3:] = np.nan_to_num(np.inf, posinf=7.0)
    found_m, residual = inertial.triangulate(axes, from_m, slopes, seen)
    np.testing.assert_allclose(found_m, places_m, atol=1e-7)
    np.testing.assert_allclose(residual, 0, atol=1e-8)


def test_parallel_rays_and_points_behind_have_no_place():
    axes, from_m, slopes, _ = rays(2, 5)
    slopes[0] = 0.1
    slopes[1] *= -1
    found_m, _ = inertial.triangulate(axes, from_m, slopes, np.ones((2, 5), bool))
    assert np.isnan(found_m).all()


def test_a_camera_that_stands_places_nothing():
    axes, from_m, slopes, _ = rays(3, 5)
    from_m[...] = 0
    slopes[1:] += np.random.default_rng(6).normal(0, 1e-2, slopes[1:].shape)
    slopes[2] *= 50
    found_m, residual = inertial.triangulate(axes, from_m, slopes, np.ones((3, 5), bool))
    assert np.isnan(found_m[0]).all() and np.isfinite(residual).all()


def test_chi_square_is_that_of_tables():
    for freedom, value in ((1, 3.841), (5, 11.070), (20, 31.410), (37, 52.192)):
        assert inertial.chi_square(freedom) == pytest.approx(value, rel=0.03)


def view(camera, body_from_cam, camera_m):
    focal_px, center_px = np.array([160.0, 160.0]), np.array([159.5, 119.5])
    return flight.View(camera, 0, np.zeros((240, 320), np.uint8), None, focal_px, center_px, body_from_cam, camera_m)


AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
DOWN = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])


def after_key_images(count):
    """Returns an inertial odometry that moves ahead and to the left, with a forward camera."""
    estimator = inertial.InertialOdometry()
    estimator.begin(flight.Standing(0.0, np.array([0.0, 0.0, 9.80665]), np.zeros(3)))
    for k in range(count):
        at_m = np.array([0.1, 0.2, 0.05]) * k
        estimator._motion = estimator._motion._replace(p_m=at_m)
        estimator._covariance += np.diag(np.repeat([1e-7, 0.0, 1e-6, 0.0, 0.0, *[0.0] * (2 * k)], 3))
        estimator._clone()
    estimator._views["front"] = view("front", AHEAD, np.array([0.06, 0.0, 0.02]))
    return estimator


def slopes_of(estimator, rotation, body_m, place_m):
    front = estimator._views["front"]
    in_cam_m = front.body_from_cam.T @ (rotation.T @ (place_m - body_m) - front.camera_m)
    return in_cam_m[:2] / in_cam_m[2]


def test_a_place_in_the_state_is_as_uncertain_as_it_is_off():
    estimator, place_m, name = after_key_images(8), np.array([4.0, 1.0, 0.5]), ("front", 7)
    clones, size = list(estimator._clones), len(estimator._covariance)
    slopes = np.array([slopes_of(estimator, one.rotation, one.p_m, place_m) for one in clones])
    estimator._sights[name] = [inertial.Sight(one.key, slope) for one, slope in zip(clones, slopes)]
    before = estimator._covariance.copy()
    estimator._place([name])
    (placed,) = estimator._places
    np.testing.assert_allclose(placed.p_m, place_m, atol=1e-6)
    at = slice(inertial.IMU_SIZE, inertial.IMU_SIZE + inertial.PLACE_SIZE)
    rest = np.r_[0 : at.start, at.stop : size + inertial.PLACE_SIZE]
    np.testing.assert_array_equal(estimator._covariance[np.ix_(rest, rest)], before)
    # Random errors: the true camera poses differ from those of the state, and corners have errors too.
    random = np.random.default_rng(11)
    drawn = random.multivariate_normal(np.zeros(size), before, 3000)
    seen = np.empty((len(drawn), len(clones), 2))
    for n, error in enumerate(drawn):
        for k, one in enumerate(clones):
            part = error[inertial.IMU_SIZE + inertial.CLONE_SIZE * k :][: inertial.CLONE_SIZE]
            seen[n, k] = slopes_of(estimator, one.rotation @ flight.exp_so3(part[:3]), one.p_m + part[3:], place_m)
    seen += random.normal(0, inertial.SIGMA_PX / 160, seen.shape)
    camera_m = np.array([0.06, 0.0, 0.02])
    axes = np.broadcast_to([one.rotation @ AHEAD for one in clones], (*seen.shape[:2], 3, 3))
    from_m = np.broadcast_to([one.p_m + one.rotation @ camera_m for one in clones], (*seen.shape[:2], 3))
    found_m, _ = inertial.triangulate(axes, from_m, seen, np.ones(seen.shape[:2], bool))
    off_m = place_m - found_m
    sigma_m = np.sqrt(np.diag(estimator._covariance)[at])
    np.testing.assert_allclose(off_m.std(axis=0), sigma_m, rtol=0.08)
    # The error is correlated with that of the body's position.
    sigmas_m = sigma_m[:, None] * np.sqrt(np.diag(before)[inertial.P])
    together = (off_m[:, :, None] * drawn[:, None, inertial.P]).mean(axis=0)
    np.testing.assert_allclose(together / sigmas_m, estimator._covariance[at, inertial.P] / sigmas_m, atol=0.06)


def test_places_in_the_state_tell_where_the_body_is():
    estimator = after_key_images(8)
    random = np.random.default_rng(12)
    clones = estimator._clones
    for number in range(20):
        place_m = np.array([random.uniform(3, 6), random.uniform(-2, 3), random.uniform(-2, 2)])
        slopes = [slopes_of(estimator, one.rotation, one.p_m, place_m) for one in clones]
        estimator._sights["front", number] = [inertial.Sight(one.key, slope) for one, slope in zip(clones, slopes)]
    estimator._place(sorted(estimator._sights))
    places_m = {place.name: place.p_m for place in estimator._places}
    assert len(places_m) == 20
    # The true motion drifts further than the estimate assumes.
    truth, truth_m = estimator._motion.rotation, estimator._motion.p_m
    estimator._covariance[: inertial.IMU_SIZE, : inertial.IMU_SIZE] += np.diag(np.repeat([1e-4, 0, 4e-2, 0, 0], 3))
    turn = flight.exp_so3(np.array([0.01, -0.005, 0.008]))
    estimator._motion = estimator._motion._replace(rotation=truth @ turn, p_m=truth_m + np.array([0.05, -0.08, 0.04]))
    estimator._clone()
    looks = {name: slopes_of(estimator, truth, truth_m, place_m) for name, place_m in places_m.items()}
    looks["front", 3] = looks["front", 3] + 0.3
    estimator._use([], looks)
    assert {place.name for place in estimator._places} == set(places_m) - {("front", 3)}
    # Rotation and sideways motion look alike: a sigma of 1 to 3 cm remains.
    np.testing.assert_allclose(estimator._motion.p_m, truth_m, atol=0.02)
    np.testing.assert_allclose(estimator._motion.rotation, truth, atol=0.004)
    # Places that are no longer tracked leave the state.
    estimator._forget_places({("front", 0), ("front", 5)})
    assert len(estimator._places) == 17
    assert len(estimator._covariance) == inertial.IMU_SIZE + 17 * inertial.PLACE_SIZE + 9 * inertial.CLONE_SIZE


@pytest.mark.parametrize("outliers", [0, 25])
def test_the_pose_is_found_from_places(outliers, monkeypatch):
    # Without a gyroscope, the guess has a large sigma.
    monkeypatch.setattr(rgbd, "SIGMA_TURN_RAD", 0.05)
    random = np.random.default_rng(7)
    rotation, p_m = flight.exp_so3(np.array([0.05, -0.1, 0.4])), np.array([1.0, -0.5, 1.2])
    seen = []
    for one in (view("front", AHEAD, np.array([0.06, 0, 0.02])), view("down", DOWN, np.array([0, 0, -0.03]))):
        in_cam_m = np.column_stack([random.uniform(-1, 1, (60, 2)), np.ones(60)]) * random.uniform(1, 8, (60, 1))
        places_m = (in_cam_m @ one.body_from_cam.T + one.camera_m) @ rotation.T + p_m
        px = one.project(in_cam_m)
        px[:outliers] += random.uniform(-20, 20, (outliers, 2))
        depth_m = in_cam_m[:, 2].copy()
        depth_m[::3] = 0
        seen.append((one, px, places_m, depth_m))
    guess, guess_m = rotation @ flight.exp_so3(np.array([0.02, -0.02, 0.03])), p_m + np.array([0.04, -0.05, 0.03])
    found, found_m, offs = rgbd.solve_pose(guess, guess_m, seen)
    # Gauss-Newton's prior of 5 cm pulls slightly towards the guess.
    np.testing.assert_allclose(found_m, p_m, atol=1e-3 if outliers == 0 else 1e-2)
    np.testing.assert_allclose(found, rotation, atol=1e-3 if outliers == 0 else 1e-2)
    if outliers:
        assert (offs[0][:outliers] > rgbd.DROPPED).mean() > 0.8 and (offs[0][outliers:] < rgbd.DROPPED).all()


@pytest.mark.parametrize(("sigma_rad", "least_rad", "most_rad"), [(0.05, 1e-3, 1e-2), (None, 0.0, 5e-4)])
def test_what_corners_have_in_common_turns_the_pose_less_than_the_gyroscope_says(
    sigma_rad, least_rad, most_rad, monkeypatch
):
    if sigma_rad is not None:
        monkeypatch.setattr(rgbd, "SIGMA_TURN_RAD", sigma_rad)
    random = np.random.default_rng(8)
    seen = []
    for one, off_px in ((view("front", AHEAD, np.zeros(3)), 1.0), (view("down", DOWN, np.zeros(3)), 0.0)):
        in_cam_m = np.column_stack([random.uniform(-1, 1, (90, 2)), np.ones(90)]) * random.uniform(1, 3, (90, 1))
        px = one.project(in_cam_m) + np.array([off_px, 0.0])
        seen.append((one, px, in_cam_m @ one.body_from_cam.T, in_cam_m[:, 2]))
    found, _, _ = rgbd.solve_pose(np.eye(3), np.zeros(3), seen)
    assert least_rad <= abs(found[1, 0]) <= most_rad


def test_contrast_is_spread_alike_everywhere():
    random = np.random.default_rng(4)
    rgb = np.repeat(random.integers(40, 200, (60, 320, 1), dtype=np.uint8), 3, axis=2)
    rgb = np.concatenate([rgb, rgb // 2 + 60, rgb, rgb])
    grey = flight.even_grey(rgb)
    assert grey.std() == pytest.approx(flight.SPREAD, abs=3)
    # The same rows have equal brightness at any position in the image.
    np.testing.assert_array_equal(grey[130:170], grey[190:230])


def test_it_stands_until_it_lifts():
    readings = [flight.Imu(n * 0.01, np.array([0.1, 0, 9.8]), np.array([0.01, 0, -0.02])) for n in range(200)]
    assert flight.stood(readings) is None
    readings += [flight.Imu(2 + n * 0.01, np.array([0.1, 0, 11.0]), np.zeros(3)) for n in range(10)]
    standing = flight.stood(readings)
    assert standing is not None and 1.7 < standing.until_s < 1.8
    np.testing.assert_allclose(standing.gyro_bias, [0.01, 0, -0.02], atol=1e-12)
    np.testing.assert_allclose(standing.accel_mps2, [0.1, 0, 9.8], atol=1e-12)


def test_corners_are_followed_where_the_image_moves():
    random = np.random.default_rng(1)
    noise = random.integers(0, 255, (70, 90), dtype=np.uint8)
    picture = flight.cv2.resize(noise, (360, 280), interpolation=flight.cv2.INTER_CUBIC)
    tracks = flight.Tracks()
    tracks.follow(picture[20:260, 20:340])
    assert tracks.add() > 60
    before = tracks.px.copy()
    for shift in range(1, 7):
        tracks.follow(picture[20:260, 20 + shift : 340 + shift])
    moved = before[np.isin(np.arange(len(before)), tracks.ids)] - tracks.px
    assert len(moved) > 50
    np.testing.assert_allclose(moved, np.broadcast_to([6.0, 0.0], moved.shape), atol=0.1)


@pytest.mark.parametrize(
    ("name", "length_m"),
    # A lemniscate's length is a Gamma(1/4)^2 / sqrt(2 pi).
    [("square", 11.2), ("lemniscate", 2.5 * math.gamma(0.25) ** 2 / math.sqrt(2 * math.pi))],
)
def test_paths_are_as_long_as_their_formulas_say(name, length_m):
    sides = np.linalg.norm(np.diff(flight.path_m(name), axis=0), axis=1)
    assert sides.sum() == pytest.approx(length_m + flight.BEYOND_M, abs=2e-3)


@pytest.mark.parametrize("name", ["square", "spiral", "lemniscate"])
def test_a_vehicle_that_lags_stays_near_the_path(name):
    points_m = flight.path_m(name)
    follower = flight.Follower(points_m)
    p_m, v_mps, seconds = np.array([0.1, -0.1, 0.1]), np.zeros(3), 0.0
    while not follower.is_over:
        # A first-order lag of 0.25 s, as in the autopilot's velocity loop.
        v_mps = v_mps + (follower.velocity(p_m, 1 / 30) - v_mps) / 30 / 0.25
        p_m, seconds = p_m + v_mps / 30, seconds + 1 / 30
        assert seconds < 40
        if seconds > 3:
            assert np.linalg.norm(points_m - p_m, axis=1).min() < 0.2
    assert np.linalg.norm(p_m - points_m[-1]) < 0.15


def test_a_project_without_a_path_is_named():
    with pytest.raises(ValueError, match="the project 'p4' has no path"):
        flight.path_m("p4")


def test_a_folder_that_is_no_data_set_is_named(tmp_path):
    with pytest.raises(ValueError, match="vizflyt export"):
        list(flight.data_set(tmp_path, False))


@pytest.mark.parametrize("kind", [rgbd.Rgbd, inertial.Inertial])
def test_the_plugins_take_observations_and_wait_on_the_ground(kind):
    front = vizflyt.CameraInfo("front", vizflyt.Intrinsics.from_horizontal_fov(64, 48, 1.5))
    buffer = vizflyt.ObservationBuffer([front])
    random = np.random.default_rng(2)
    rgb, depth_mm = random.integers(0, 255, (48, 64, 3), dtype=np.uint8), np.full((48, 64), 2500, np.uint16)
    buffer.set_image("front", rgb, depth_mm, stamp_ns=10**9)
    plugin = kind()
    plugin.on_start(vizflyt.ArenaInfo(name="spiral", cameras=[front]))
    assert plugin.on_image(buffer.observation()).kind == "hold"
    assert plugin.shown_ns == {"front": 10**9}


def run(*command):
    done = subprocess.run([str(part) for part in command], stdout=subprocess.PIPE, text=True, timeout=600)
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.mark.long
@pytest.mark.parametrize(
    ("plugin", "project", "level"),
    [("rgbd_odometry.py", "square", "ug"), ("inertial_odometry.py", "spiral", "g")],
)
def test_flies_by_its_own_odometry_within_the_bound(program, tmp_path, plugin, project, level):
    """Flies in lock-step, and then repeats the estimate on the images exported from the flight's log."""
    grade, data = tmp_path / "grade.json", tmp_path / "data"
    report = tmp_path / "report"
    run(
        program, "grade", PLUGINS / plugin, f"--project={project}", f"--level={level}", "--seeds=1", "--first-seed=3",
        f"--report={report}", "--log=full", f"--keys={tmp_path / 'keys'}", "-o", grade,
    )
    (flown,) = json.loads(grade.read_text())["runs"]
    assert flown["outcome"] == "finished", flown
    assert flown["odometry"]["poses"] > 300 and flown["odometry"]["ate_rmse_m"] < BOUND_M, flown
    log = report / "logs/day-3.mcap"
    run(program, "export", log, "--format=euroc", "-o", data)
    estimate = tmp_path / "estimate.tum"
    run(sys.executable, PLUGINS / plugin, "--dataset", data, "-o", estimate)
    again = json.loads(run(program, "evaluate", log, estimate, "--align=yaw", "--json"))
    # The same images and readings, only one by one.
    assert again["ate_rmse_m"] < BOUND_M, again
