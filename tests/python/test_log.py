"""`vizflyt.Log`: the contents of a flight's log as arrays."""

import json
import re
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

import vizflyt
from vizflyt import _mcap
from vizflyt._vizflyt import PROTOCOL_VERSION


def text(value):
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def record(opcode, data):
    return struct.pack("<BQ", opcode, len(data)) + data


def varint(value):
    found = b""
    while value >= 0x80:
        found, value = found + bytes([value & 0x7F | 0x80]), value >> 7
    return found + bytes([value])


def field(number, value):
    if isinstance(value, bytes):
        return varint(number << 3 | 2) + varint(len(value)) + value
    return varint(number << 3) + varint(value)


def doubles(*values):
    return b"".join(varint(n << 3 | 1) + struct.pack("<d", value) for n, value in enumerate(values, 1))


def pose_in_frame(at_ns, place, turn=(0, 0, 0, 1)):
    stamp = field(1, at_ns // 10**9) + field(2, at_ns % 10**9)
    return field(1, stamp) + field(2, b"world") + field(3, field(1, doubles(*place)) + field(2, doubles(*turn)))


def write_log(path, messages, flight=None):
    """Writes messages (topic, log time, bytes) as the runtime does: uncompressed chunks, without a summary."""
    topics = list(dict.fromkeys(topic for topic, _, _ in messages))
    channels = b"".join(
        record(0x04, struct.pack("<HH", n, 0) + text(topic) + text("x") + struct.pack("<I", 0))
        for n, topic in enumerate(topics)
    )
    body = b"".join(
        record(0x05, struct.pack("<HIQQ", topics.index(topic), 0, at_ns, at_ns) + data)
        for topic, at_ns, data in messages
    )
    records = channels + body
    chunk = struct.pack("<QQQI", 0, 0, len(records), 0) + text("") + struct.pack("<Q", len(records)) + records
    pairs = b"".join(text(key) + text(value) for key, value in (flight or {}).items())
    metadata = text("vizflyt.flight") + struct.pack("<I", len(pairs)) + pairs
    path.write_bytes(
        _mcap.MAGIC
        + record(0x01, text("") + text("test"))
        + record(0x0C, metadata)
        + record(0x06, chunk)
        + record(0x0F, struct.pack("<I", 0))
        + _mcap.MAGIC
    )
    return path


PROTOCOL = 13


def header(place, width=64, height=48):
    """Returns the ImageHeader of a camera at `place` that looks along body x, at the body's origin."""
    forward = (-0.5, 0.5, -0.5, 0.5)
    numbers = (*place, *forward, 0, 0, 0, *forward, 50, 50, 32, 24, 0, 0, 0, 0, 0)
    return b"VZIM" + struct.pack("<HBB5Q23dIIdI", PROTOCOL, 0, 0, 9, 0, 0, 0, 0, *numbers, width, height, 0.001, 0)


def test_images_have_the_instants_that_they_show(tmp_path):
    offset, messages = 1_700_000_000 * 10**9, []
    for n in range(1, 20):
        pose_ns, published = n * 33_000_000, n * 33_000_000 + 20_000_000
        image = field(1, 0) + field(2, b"front") + field(3, header((0.033 * n + 0.048, 0, 1))) + field(5, b"x")
        image += field(7, pose_ns) + field(8, pose_ns + 48_000_000)
        observation = field(1, n) + field(2, PROTOCOL) + field(3, published) + field(5, image)
        messages.append(("/observation", offset + published, observation))
    log = vizflyt.Log(write_log(tmp_path / "flight.mcap", messages))
    assert not log.is_cut
    assert log.cameras == ["front"]
    images = log.images()
    assert (images.shown_ns == offset + np.arange(1, 20) * 33_000_000 + 48_000_000).all()
    with pytest.raises(ValueError, match="does not decode"):
        images[0]


def test_what_is_no_log_is_refused_in_a_sentence(tmp_path):
    path = tmp_path / "x.mcap"
    path.write_bytes(b"")
    with pytest.raises(ValueError, match="is empty"):
        vizflyt.Log(path)
    path.write_bytes(b"hello" * 9)
    with pytest.raises(ValueError, match="not an MCAP file"):
        vizflyt.Log(path)
    write_log(path, [])
    with pytest.raises(LookupError, match="fly with --log full"):
        vizflyt.Log(path).images()
    write_log(path, [("/observation", 1, field(1, 1) + field(2, 99))])
    with pytest.raises(ValueError, match="is of protocol 99"):
        vizflyt.Log(path)
    with pytest.raises(FileNotFoundError):
        vizflyt.Log(tmp_path / "none.mcap")


def test_a_damaged_log_is_read_as_far_as_it_goes(tmp_path):
    image = field(2, b"front") + field(3, header((0, 0, 1))) + field(5, b"x") + field(7, 1) + field(8, 2)
    observation = field(1, 1) + field(2, PROTOCOL_VERSION) + field(3, 3) + field(4, bytes(5000)) + field(5, image)
    messages = [("/pose", 10**9, pose_in_frame(10**9, (1, 2, 3))), ("/observation", 10**9, observation)]
    messages += [("/imu", 10**9, json.dumps({"accel_mps2": [0, 0, 1], "gyro_radps": [0, 0, 0]}).encode())]
    whole = write_log(tmp_path / "whole.mcap", messages, {"log_form": "2"}).read_bytes()
    random = np.random.default_rng(5)
    read = 0
    for trial in range(400):
        data = bytearray(whole)
        for _ in range(random.integers(0, 6)):
            data[random.integers(8, len(data))] = random.integers(0, 256)
        path = tmp_path / f"{trial}.mcap"
        path.write_bytes(data[: random.integers(9, len(data) + 1)])
        try:
            log = vizflyt.Log(path)
            _ = log.poses, log.imu, log.motion, log.sent, log.asked, log.odometry, log.pose_at_image
            read += len(log.poses.at_ns)
        except ValueError:
            pass
        path.unlink()
    assert read > 20


@pytest.fixture(scope="module")
def graded(request, tmp_path_factory):
    """Returns the log of a graded flight of the built-in plugin."""
    program = request.config.getoption("--vizflyt")
    if program is None:
        pytest.skip("no --vizflyt given")
    folder = tmp_path_factory.mktemp("graded")
    command = [program, "grade", "avoid", "--project", "p2", "--seeds", "1", "--log", "full", "--report", folder / "r"]
    subprocess.run([*command, "--keys", folder / "keys"], check=True, capture_output=True)
    return folder / "r/logs/day-1.mcap"


def test_a_graded_flight_is_read_in_five_lines(graded):
    log = vizflyt.Log(graded)
    images = log.images("front")
    assert len(images) > 100
    off = []
    for image in images[::20]:
        assert image.rgb.dtype == np.uint8 and image.rgb.shape[:2] == image.depth.shape
        assert 0.1 < np.median(image.depth[image.depth > 0]) < 100
        truth = log.poses.at(image.shown_ns)
        if truth is not None:
            off.append(np.linalg.norm(truth.translation_m - image.world_from_body.translation_m))
        at_image = log.pose_at_image.at(image.shown_ns)
        np.testing.assert_allclose(at_image.translation_m, image.world_from_body.translation_m)
    # Error of a forecast over 30 ms; with the pose's stamp it would be centimetres.
    assert np.median(off) < 0.01, off
    assert abs(np.median(log.imu.accel_mps2[:, 2]) - 9.8) < 0.5
    assert len(log.imu.at_ns) > 500 and (np.diff(log.imu.at_ns) > 0).all()
    assert len(log.asked) > 100 and np.isfinite(log.sent.v_world_mps).all()


def test_the_guides_lines_run(graded, capsys):
    guide = (Path(__file__).parents[2] / "docs/guides/logs.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```$", guide, re.M | re.S)
    [block] = [block for block in blocks if "vizflyt.Log" in block]
    exec(compile(block.replace("flight.mcap", str(graded)), "logs.md", "exec"), {})
    assert len(capsys.readouterr().out.splitlines()) > 100


def test_the_lag_between_images_and_the_way_flown_is_none(graded):
    """The time shift of the images that fits the flown path best is 0, not the age of their pose."""
    log = vizflyt.Log(graded)
    shown, poses = log.pose_at_image, log.poses
    speed = np.linalg.norm(np.gradient(shown.p_m, axis=0), axis=1)
    moving = speed > 0.01
    lags = np.arange(-100, 101, 2)
    errors = []
    for lag_ms in lags:
        at = shown.at_ns[moving] + lag_ms * 1_000_000
        truth = np.stack([np.interp(at, poses.at_ns, poses.p_m[:, axis]) for axis in range(3)], axis=1)
        errors.append(np.sqrt(np.mean(np.sum((truth - shown.p_m[moving]) ** 2, axis=1))))
    best = lags[int(np.argmin(errors))]
    assert abs(best) <= 4, f"images are off by {best} ms"


@pytest.mark.long
def test_a_published_estimate_is_logged_and_graded(request, tmp_path):
    program = request.config.getoption("--vizflyt")
    if program is None:
        pytest.skip("no --vizflyt given")
    tmp_path.chmod(0o755)
    plugin = tmp_path / "plugin"
    plugin.mkdir()
    # Estimates its position in its own frame, and drifts by 5 cm a second to the side.
    (plugin / "drifts.py").write_text(
        "import numpy as np\n"
        "import vizflyt\n"
        "\n"
        "\n"
        "class Drifts(vizflyt.Plugin):\n"
        "    start_ns = None\n"
        "    def on_image(self, obs):\n"
        "        front, pose = obs.camera('front'), obs.pose_at_image\n"
        "        if front is None or pose is None:\n"
        "            return None\n"
        "        self.start_ns = self.start_ns or front.shown_ns\n"
        "        odom_from_world = vizflyt.Pose('odom', 'world', [3, 1, 0], [0, 0, 0.6, 0.8])\n"
        "        odom_from_body = odom_from_world @ pose\n"
        "        drift = np.array([0, 0, 0.05]) * (front.shown_ns - self.start_ns) * 1e-9\n"
        "        p_odom_m = odom_from_body.translation_m + drift\n"
        "        vizflyt.publish_odometry(front.shown_ns, p_odom_m, odom_from_body.rotation_xyzw)\n"
        "        return vizflyt.Setpoint.velocity([1.0, 0, 0], axes='heading')\n"
        "\n"
        "\n"
        "if __name__ == '__main__':\n"
        "    vizflyt.run(Drifts)\n"
    )
    command = [program, "grade", plugin / "drifts.py", "--project", "p2", "--seeds", "1", "--json"]
    command += ["--log", "full", "--report", tmp_path / "r", "--keys", tmp_path / "keys"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    odometry = json.loads(done.stdout)["runs"][0]["odometry"]
    assert odometry["poses"] > 50, odometry
    assert 0.01 < odometry["ate_rmse_m"] < 0.5, odometry
    assert abs(odometry["rpe_trans_rmse_m"] - 0.05) < 0.02, odometry
    log = tmp_path / "r/logs/day-1.mcap"
    published = vizflyt.Log(log).odometry
    assert published.frame == "odom" and len(published.at_ns) >= odometry["poses"]
    command = [program, "evaluate", f"{log}#/pose", f"{log}#/odometry", "--align", "yaw", "--delta", "1s", "--json"]
    found = json.loads(subprocess.run(command, capture_output=True, check=True, text=True).stdout)
    assert abs(found["ate_rmse_m"] - odometry["ate_rmse_m"]) < 0.01, found
    assert "its odometry was off by" in (tmp_path / "r/index.html").read_text()


def test_an_estimate_that_is_no_pose_is_refused():
    with pytest.raises(vizflyt.NotFiniteError):
        vizflyt.publish_odometry(1, [0, float("nan"), 0], [0, 0, 0, 1])
    with pytest.raises(ValueError):
        vizflyt.publish_odometry(1, [0, 0, 0], [0, 0, 0, 2])
    with pytest.raises(ValueError, match="within 100 km"):
        vizflyt.publish_odometry(1, [1e7, 0, 0], [0, 0, 0, 1])


def test_an_estimate_leaves_with_the_answer_and_a_fifth_is_refused(stage):
    faults = []

    class Publishes(vizflyt.Plugin):
        def on_image(self, obs):
            shown_ns = obs.camera("front").shown_ns
            assert obs.pose_at_image.translation_m.tolist() == [1, 2, 3]
            for n in range(5):
                try:
                    vizflyt.publish_odometry(shown_ns + n, [n, 0, 0], [0, 0, 0, 1])
                except ValueError as error:
                    faults.append(str(error))
            return vizflyt.Setpoint.hold()

    runner = stage.attach(Publishes)
    stage.buffer.clear(1)
    stage.buffer.set_image("front", seq=1, stamp_ns=100)
    stage.buffer.set_pose_at_image("front", vizflyt.Pose("world", "body", [1, 2, 3]))
    stage.rehearsal.publish(stage.buffer)
    received = [stage.rehearsal.receive() for _ in range(5)]
    assert [what for what, *_ in received] == ["odometry"] * 4 + ["answer"]
    assert [stamp_ns for *_, stamp_ns in received[:4]] == [100, 101, 102, 103]
    assert received[2][2].translation_m.tolist() == [2, 0, 0]
    assert len(faults) == 1 and "more than 4 estimates" in faults[0]
    stage.rehearsal.stop()
    assert runner.ended() is None
