"""Images: their memory, their contents, and their lifetime when a plugin keeps them."""

import gc
import warnings

import cv2
import numpy as np
import pytest
from conftest import Stage, camera, pattern

import vizflyt


def mapping_of(address):
    """Returns the file mapped at an address of this process, as listed by the kernel."""
    with open("/proc/self/maps") as maps:
        for line in maps:
            place, _, _, _, _, *file = line.split(maxsplit=5)
            low, high = (int(part, 16) for part in place.split("-"))
            if low <= address < high:
                return file[0].strip() if file else "private memory"
    return "nothing"


def observation():
    rgb, depth_mm = pattern(48, 64, 1)
    buffer = vizflyt.ObservationBuffer([camera(), camera("rear")])
    buffer.set_image("front", rgb, depth_mm, seq=7, stamp_ns=5, ready_ns=9)
    return buffer.observation(), rgb, depth_mm


def test_images_are_what_was_put_in():
    obs, rgb, depth_mm = observation()
    front = obs.camera("front")
    assert (front.rgb.shape, front.rgb.dtype) == ((48, 64, 3), np.uint8)
    assert (front.depth_mm.shape, front.depth_mm.dtype) == ((48, 64), np.uint16)
    assert (front.depth.shape, front.depth.dtype) == ((48, 64), np.float32)
    assert (front.rgb == rgb).all() and (front.depth_mm == depth_mm).all()
    assert (front.depth == depth_mm.astype(np.float32) / 1000).all()
    y, x = np.argwhere(depth_mm > 0)[0]
    assert front.depth_m(x, y) == pytest.approx(depth_mm[y, x] / 1000)
    assert (front.seq, front.stamp_ns, front.ready_ns, obs.stamp_ns) == (7, 5, 9, 5)
    assert front.rgb.flags.c_contiguous and front.depth_mm.flags.c_contiguous


def test_the_vehicle_is_known_as_far_as_the_course_lets_it():
    buffer = vizflyt.ObservationBuffer([camera()])
    obs = buffer.observation()
    assert obs.vehicle is None and obs.imu == [] and obs.battery.fraction is None
    half = 0.5**0.5
    buffer.set_vehicle(vizflyt.Vehicle(attitude_xyzw=[0, 0, half, half], omega_body_radps=[0, 0, 1]))
    buffer.set_battery(vizflyt.Battery(0.5, 11.1))
    obs = buffer.observation()
    assert obs.vehicle.yaw_rad == pytest.approx(np.pi / 2)
    assert (obs.vehicle.omega_body_radps == [0, 0, 1]).all()
    assert (obs.vehicle.world_from_body, obs.vehicle.p_world_m, obs.vehicle.v_world_mps) == (None,) * 3
    assert (obs.battery.fraction, obs.battery.voltage_v) == (0.5, 11.1)
    pose = vizflyt.Pose("world", "body", [1, 2, 3])
    buffer.set_vehicle(vizflyt.Vehicle(pose, [4, 5, 6], stamp_ns=7))
    vehicle = buffer.observation().vehicle
    assert vehicle.world_from_body == pose and vehicle.stamp_ns == 7
    assert (vehicle.p_world_m == [1, 2, 3]).all() and (vehicle.v_world_mps == [4, 5, 6]).all()


def test_every_imu_sample_comes_once():
    stage, seen = Stage(), []

    class Listen(vizflyt.Plugin):
        def on_image(self, obs):
            seen.append([(s.stamp_ns, *s.accel_mps2, *s.gyro_radps) for s in obs.imu])

    runner = stage.attach(Listen)
    samples = [vizflyt.ImuSample([0, 0, n], [n, 0, 0], stamp_ns=n) for n in range(1, 8)]
    for newest in (3, 5, 7):
        stage.buffer.clear(newest)
        # The newest four are always included: a reader that skips an observation misses none.
        stage.buffer.set_imu(samples[max(newest - 4, 0) : newest])
        stage.rehearsal.publish(stage.buffer)
        assert stage.rehearsal.receive()[0] == "answer"
    stage.rehearsal.stop()
    assert runner.ended() is None
    assert [[stamp for stamp, *_ in image] for image in seen] == [[1, 2, 3], [4, 5], [6, 7]]
    assert seen[0][2] == (3, 0, 0, 3, 3, 0, 0)


def test_a_camera_without_an_image_is_none_and_an_unknown_one_a_sentence():
    obs, *_ = observation()
    assert obs.camera("rear") is None
    assert [image.name for image in obs.cameras] == ["front"]
    with pytest.raises(LookupError, match="there is no camera 'fornt'; this vehicle has 'front', 'rear'"):
        obs.camera("fornt")
    with pytest.raises(IndexError, match="x 64, y 0 lies outside the image of 64 x 48"):
        obs.camera("front").depth_m(64, 0)


def test_images_cannot_be_written_to():
    obs, *_ = observation()
    front = obs.camera("front")
    for array in (front.rgb, front.depth_mm, front.depth):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
    with pytest.raises(ValueError):
        front.rgb.flags.writeable = True


def test_no_pixel_is_copied_between_the_decoder_and_numpy():
    stage, seen = Stage(width=640, height=480), []

    class Look(vizflyt.Plugin):
        def on_image(self, obs):
            front = obs.camera("front")
            for array in (front.rgb, front.depth_mm, front.rgb[10:20, :, ::-1]):
                seen.append(mapping_of(array.__array_interface__["data"][0]))
            # The same memory for every access.
            assert np.shares_memory(front.rgb, obs.camera("front").rgb)
            assert not obs.is_copy

    runner = stage.attach(Look)
    assert stage.answer(1)[0] == "answer"
    stage.rehearsal.stop()
    assert runner.ended() is None
    assert len(seen) == 3
    for file in seen:
        assert file.startswith("/memfd:vizflyt-observation"), seen


def test_kept_images_never_change_and_later_ones_are_copied_with_a_warning():
    kept = []

    class Keep(vizflyt.Plugin):
        def on_image(self, obs):
            front = obs.camera("front")
            kept.append((obs.seq, obs.is_copy, front.rgb[1:, ::2], front.depth_mm))

    stage = Stage()
    truth = {}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        runner = stage.attach(Keep)
        for seq in range(1, 41):
            truth[seq] = stage.publish(seq)
            what, answered, *_ = stage.rehearsal.receive()
            assert (what, answered) == ("answer", seq)
        warned = [w for w in caught if w.category is vizflyt.HeldImagesWarning]
    assert len(warned) == 1 and "keep what you need with .copy()" in str(warned[0].message)
    # The first two stay in place; all others are copies.
    assert [is_copy for _, is_copy, *_ in kept] == [False, False] + [True] * 38
    for seq, _, rgb, depth_mm in kept:
        assert (rgb == truth[seq][0][1:, ::2]).all() and (depth_mm == truth[seq][1]).all()
    # A reader that releases its images gets views again.
    kept.clear()
    gc.collect()
    assert stage.answer(41)[0] == "answer"
    assert kept[0][1] is False
    stage.rehearsal.stop()
    assert runner.ended() is None
    del stage, runner
    gc.collect()
    assert (kept[0][2] == pattern(48, 64, 41)[0][1:, ::2]).all(), "views outlive the flight"


def test_keeping_the_image_before_costs_no_copy():
    copies = []

    class Flow(vizflyt.Plugin):
        before = None

        def on_image(self, obs):
            now = obs.camera("front").rgb
            if self.before is not None:
                np.abs(now.astype(np.int16) - self.before)
            self.before = now
            copies.append(obs.is_copy)

    stage = Stage()
    runner = stage.attach(Flow)
    for seq in range(1, 20):
        assert stage.answer(seq)[0] == "answer"
    stage.rehearsal.stop()
    assert runner.ended() is None
    assert copies == [False] * 19


def test_opencv_takes_the_arrays_as_they_are():
    obs, rgb, _ = observation()
    front = obs.camera("front")
    grey = cv2.cvtColor(front.rgb, cv2.COLOR_RGB2GRAY)
    assert (grey == cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)).all()
    assert cv2.resize(front.depth, (32, 24), interpolation=cv2.INTER_NEAREST).shape == (24, 32)
    assert cv2.Canny(front.rgb, 50, 150).shape == (48, 64)
    corners = cv2.goodFeaturesToTrack(grey, 10, 0.01, 5)
    flat = corners.reshape(-1, 2)
    undistorted = cv2.undistortPoints(corners, front.intrinsics.opencv_matrix, None)
    # OpenCV's pixels have their centres at whole numbers, this project's at halves.
    k = front.intrinsics
    slopes = (flat + 0.5 - [k.cx_px, k.cy_px]) / [k.fx_px, k.fy_px]
    assert np.allclose(undistorted.reshape(-1, 2), slopes, atol=1e-6)
    # Drawing into it raises an error; a copy is writable.
    with pytest.raises(cv2.error, match="readonly"):
        cv2.rectangle(front.rgb, (1, 1), (5, 5), (255, 0, 0))
    assert (cv2.rectangle(front.rgb.copy(), (1, 1), (5, 5), (255, 0, 0))[1, 1] == [255, 0, 0]).all()


def test_other_libraries_read_the_arrays_in_place():
    """Checks the protocols by which torch, jax and cupy take arrays."""
    obs, *_ = observation()
    front = obs.camera("front")
    address = front.depth.__array_interface__["data"][0]
    shared = np.from_dlpack(front.depth)
    assert shared.__array_interface__["data"][0] == address
    assert memoryview(front.rgb).shape == (48, 64, 3) and memoryview(front.rgb).readonly
    assert np.asarray(front.rgb) is not None and np.shares_memory(np.asarray(front.rgb), front.rgb)


def test_wrong_arrays_for_a_buffer_are_a_sentence():
    buffer = vizflyt.ObservationBuffer([camera()])
    with pytest.raises(
        TypeError,
        match=r"rgb must be a uint8 array of shape \(48, 64, 3\), not a numpy.ndarray of shape "
        r"\(48, 64, 3\) and dtype float64",
    ):
        buffer.set_image("front", rgb=np.zeros((48, 64, 3)))
    with pytest.raises(TypeError, match=r"depth_mm must be a uint16 array .*not a numpy.ndarray of shape \(64, 48\)"):
        buffer.set_image("front", depth_mm=np.zeros((64, 48), np.uint16))
