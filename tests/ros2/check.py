"""Subscribes to a flight with Cyclone DDS, an independent implementation, and flies it.

First this program takes the runtime's part (`vizflyt.Rehearsal`), so that every pixel is known; then it flies the
simulated lab. Ends with a table of each topic's latency from the image's publication, and its load, together with the
plugin's own path. Exit status 0 only if every check passed.
"""
import io
import itertools
import json
import os
import queue
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from typing import Literal

import messages as ros
import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from PIL import Image

import vizflyt
from vizflyt import Setpoint

WIDTH, HEIGHT = 640, 480
RATE_HZ, IMAGES = 12, 36
FRONT = "vizflyt/front/"
# Offset from this process's monotonic clock to time since 1970, as in the node's stamps. [ns]
UNIX_NS = time.time_ns() - time.monotonic_ns()

CDR1 = Policy.DataRepresentation(use_cdrv0_representation=True)
SENSOR = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(5), CDR1)
RELIABLE = Policy.Reliability.Reliable(duration(milliseconds=100))
DEFAULT = Qos(RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(100), CDR1)
STATIC = Qos(RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1), CDR1)

checks = 0
# Output of the node and of the flight, for diagnosis.
printed: list[str] = []


def check(holds, text):
    """Counts a check, or ends the program with a message."""
    global checks
    if not holds:
        sys.exit("\n".join(["what was printed last:", *printed[-20:], f"tests/ros2: {text}"]))
    checks += 1


def wait_for(what, text, seconds=20.0):
    """Waits until `what` returns something true, and returns that."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if found := what():
            return found
        time.sleep(0.005)
    return check(False, f"{text}: not within {seconds:.0f} s")


class Inbox:
    """A subscriber that keeps each message undecoded, with its time of receipt."""

    def __init__(self, domain, name, kind, qos):
        self.name, self.kind = name, kind
        topic = Topic(domain, f"rt/{name}", kind)
        self.reader = DataReader(domain, topic, qos=qos)
        # Decoding a list of a million numbers takes longer than sending an image: decode only checked messages.
        topic.data_type = AsItCame
        self.found = []

    def poll(self):
        """Takes the waiting messages; returns their number."""
        taken = [sample for sample in self.reader.take(20) if isinstance(sample, Raw)]
        self.found += taken
        return len(taken)

    def is_matched(self):
        """Returns whether the topic has a publisher."""
        return len(self.reader.get_matched_publications()) > 0

    def messages(self):
        """Returns all received messages, decoded."""
        return [sample.decode(self.kind) for sample in self.found]


class AsItCame:
    """Replaces a message's type, and decodes nothing."""

    @staticmethod
    def deserialize(data):
        return Raw(data)

    @staticmethod
    def deserialize_key(data):
        return None


class Raw:
    """An undecoded message."""

    def __init__(self, data):
        self.came_ns, self.data = time.time_ns(), bytes(data)
        self.sample_info = None

    def stamp_ns(self):
        """Returns the stamp of its header, after four bytes of encapsulation. [ns since 1970]"""
        sec, nanosec = struct.unpack_from("<iI", self.data, 4)
        return sec * 1_000_000_000 + nanosec

    def decode(self, kind):
        """Returns it decoded by Cyclone's own code."""
        return kind.deserialize(self.data)

    def tail(self, count, dtype, behind=0):
        """Returns the last `count` numbers before the final `behind` bytes: the pixels of an image."""
        end = len(self.data) - behind
        return np.frombuffer(self.data[end - count * np.dtype(dtype).itemsize:end], dtype)


class Node:
    """The node under test."""

    def __init__(self, command, domain, *options):
        self.lines = queue.Queue()
        line = [*command, "--domain", str(domain), *options]
        self.process = subprocess.Popen(line, stderr=subprocess.PIPE, text=True)
        threading.Thread(target=self.read, daemon=True).start()

    def read(self):
        for line in self.process.stderr:
            self.lines.put(line)
            printed.append(line.rstrip())

    def said(self, words):
        """Returns whether the node has printed these words since the last call."""
        while not self.lines.empty():
            if words in self.lines.get():
                return True
        return False

    def end(self):
        """Stops the node; returns its exit status."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(10)


class Stage:
    """The runtime's part: one camera, one LiDAR, known pixels."""

    def __init__(self):
        # Looks along the nose from 0.1 m ahead: z forward, x right, y down.
        mounting = vizflyt.Pose("body", "cam", [0.1, 0.0, 0.0], [-0.5, 0.5, -0.5, 0.5])
        self.intrinsics = vizflyt.Intrinsics.from_horizontal_fov(WIDTH, HEIGHT, 1.4)
        self.cameras = [vizflyt.CameraInfo("front", self.intrinsics, mounting)]
        self.sensors = [vizflyt.SensorInfo("top", "lidar", most_records=5)]
        self.rehearsal = vizflyt.Rehearsal(self.cameras, waiting=True)
        self.buffer = vizflyt.ObservationBuffer(self.cameras, self.sensors)
        self.imu_ns, self.seq, self.shown, self.own_ns = 0, 0, {}, []
        y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
        self.grid = np.stack([x // 3 % 256, y // 2 % 256, (x + y) // 5 % 256], axis=-1).astype(np.uint8)
        depth = (500 + 7 * x + 3 * y).astype(np.uint16)
        depth[::50, ::50] = 0
        self.depth_mm = depth

    def start(self):
        """Waits for the node and begins."""
        def attached():
            self.rehearsal.receive(timeout_s=0.01)
            return self.rehearsal.is_attached
        wait_for(attached, "the node has not attached")
        self.rehearsal.start(vizflyt.ArenaInfo(name="stage", cameras=self.cameras, sensors=self.sensors))
        ready = self.rehearsal.receive()
        check(ready is not None and ready[0] == "ready", f"instead of ready: {ready}")

    def pose(self, seq):
        """Returns the body's pose at image `seq`: on a line, yawing, pitched."""
        yaw, pitch = 0.02 * seq, 0.2
        (sy, cy), (sp, cp) = ((np.sin(angle / 2), np.cos(angle / 2)) for angle in (yaw, pitch))
        return vizflyt.Pose("world", "body", [0.1 * seq, 1.0, 1.5], [-sy * sp, cy * sp, sy * cp, cy * cp])

    def publish(self):
        """Publishes the next image; returns the node's answer."""
        self.seq += 1
        seq, now_ns = self.seq, time.monotonic_ns()
        rgb = np.roll(self.grid, 11 * seq, axis=1)
        self.buffer.clear(seq)
        self.buffer.set_image("front", rgb, self.depth_mm, seq=seq, stamp_ns=now_ns)
        self.buffer.set_pose_at_image("front", self.pose(seq))
        self.buffer.set_vehicle(vizflyt.Vehicle(self.pose(seq), [0.0, 1.0, 0.0], [0.0, 0.0, 0.3], stamp_ns=now_ns))
        stamps = [now_ns - step * 1_000_000 for step in (20, 10, 0)]
        samples = [vizflyt.ImuSample([0.1, 0.2, 9.8], [0.0, 0.0, 0.3], stamp_ns=stamp) for stamp in stamps]
        self.buffer.set_imu(samples)
        points = np.zeros(4, [("p", "<f4", 3), ("before_ns", "<u4"), ("intensity", "<u2"), ("ring", "<u2")])
        points["p"][:, 0], points["ring"] = np.arange(4) + seq, np.arange(4)
        self.buffer.set_reading("top", points.tobytes(), seq=seq, stamp_ns=now_ns)
        published_ns = time.monotonic_ns()
        self.shown[now_ns + UNIX_NS] = (seq, rgb, published_ns + UNIX_NS)
        self.rehearsal.publish(self.buffer)
        answer = self.rehearsal.receive()
        check(answer is not None and answer[0] == "answer" and answer[1] == seq, f"no answer to image {seq}: {answer}")
        self.own_ns.append(answer[3] - published_ns)
        return answer[2]

    def of(self, stamp_ns):
        """Returns number, colour and publication time of the image with this stamp, within the clock's resolution."""
        nearest = min(self.shown, key=lambda shown: abs(shown - stamp_ns))
        check(abs(nearest - stamp_ns) < 8_000_000, f"no image was of {stamp_ns}")
        return self.shown[nearest]


def subscribe(domain):
    """Returns a subscriber of each topic, by name."""
    kinds = {
        FRONT + "image_raw": (ros.Image, SENSOR),
        FRONT + "camera_info": (ros.CameraInfo, SENSOR),
        FRONT + "depth/image_raw": (ros.Image, SENSOR),
        FRONT + "depth/camera_info": (ros.CameraInfo, SENSOR),
        "vizflyt/top/points": (ros.PointCloud2, SENSOR),
        "vizflyt/imu": (ros.Imu, SENSOR),
        "vizflyt/pose": (ros.PoseStamped, DEFAULT),
        "vizflyt/odom": (ros.Odometry, DEFAULT),
        "tf": (ros.TFMessage, DEFAULT),
        "tf_static": (ros.TFMessage, STATIC),
    }
    return {name: Inbox(domain, name, kind, qos) for name, (kind, qos) in kinds.items()}


def poll(inboxes, seconds):
    """Takes messages for this time."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if not sum(inbox.poll() for inbox in inboxes.values()):
            time.sleep(0.0005)


def grow(stamps):
    """Returns whether each stamp is later than the one before."""
    return all(later > stamp for stamp, later in itertools.pairwise(stamps))


def check_images(stage, inboxes):
    """Checks every pixel, number and stamp of the received images."""
    images = inboxes[FRONT + "image_raw"].found
    # Best effort: a busy computer loses some.
    check(len(images) >= IMAGES / 2, f"{len(images)} of {IMAGES} images came")
    stamps = [image.stamp_ns() for image in images]
    check(grow(stamps), "the stamps of images do not grow")
    for image in images:
        found = image.tail(WIDTH * HEIGHT * 3, np.uint8).reshape(HEIGHT, WIDTH, 3)
        check(np.array_equal(found, stage.of(image.stamp_ns())[1]), "pixels differ from those that the plugin has")
    first = images[0].decode(ros.Image)
    form = (first.header.frame_id, first.encoding, first.width, first.height, first.step, len(first.data))
    expected = ("front_optical_frame", "rgb8", WIDTH, HEIGHT, 3 * WIDTH, 3 * WIDTH * HEIGHT)
    check(form == expected, f"an image is {form}")

    depths = inboxes[FRONT + "depth/image_raw"].found
    check(len(depths) >= IMAGES / 2, f"{len(depths)} of {IMAGES} depth images came")
    truth_m = np.where(stage.depth_mm == 0, np.nan, stage.depth_mm / 1000).astype(np.float32)
    for depth in depths:
        found_m = depth.tail(WIDTH * HEIGHT, "<f4").reshape(HEIGHT, WIDTH)
        check(np.array_equal(found_m, truth_m, equal_nan=True), "depth differs from that of the plugin")
    first = depths[0].decode(ros.Image)
    check((first.encoding, first.step) == ("32FC1", 4 * WIDTH), f"depth is {first.encoding}, {first.step} bytes a row")

    for name in (FRONT + "camera_info", FRONT + "depth/camera_info"):
        info = inboxes[name].messages()[0]
        matrix = np.reshape(info.k, (3, 3))
        check(np.allclose(matrix, stage.intrinsics.opencv_matrix, atol=1e-12), f"{name}: K is {matrix}")
        check((info.width, info.height, len(info.d)) == (WIDTH, HEIGHT, 5), f"{name}: {info}")
        # Best effort, as images are: a busy machine loses some of either, but they have the same stamps.
        found = {found.stamp_ns() for found in inboxes[name].found}
        check(all(stage.of(stamp) for stamp in found), f"{name} has a stamp of no image")
        check(found & set(stamps), f"{name} has none of the stamps of {len(stamps)} images")


def turn(q):
    """Returns the matrix (3, 3) of a quaternion message."""
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def check_motion(stage, inboxes):
    """Checks frames, poses, inertial readings, points."""
    fixed = {part.child_frame_id: part for part in inboxes["tf_static"].messages()[-1].transforms}
    parents = {child: part.header.frame_id for child, part in fixed.items()}
    tree = {"odom": "map", "front_optical_frame": "base_link", "top": "base_link"}
    check(parents == tree, f"fixed frames: {parents}")
    optical = fixed["front_optical_frame"].transform
    axes = turn(optical.rotation)
    check(np.allclose(axes, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), f"the optical frame's axes in the body: {axes}")
    check(optical.translation == ros.Vector3(0.1, 0.0, 0.0), f"the camera is at {optical.translation}")

    images = {image.stamp_ns() for image in inboxes[FRONT + "image_raw"].found}
    transforms = [message.transforms for message in inboxes["tf"].messages()]
    stamps = {parts[0].header.stamp.ns() for parts in transforms}
    check(images <= stamps, f"{len(images - stamps)} images have no transform of their stamp")
    for base, level in transforms:
        chain = [(part.header.frame_id, part.child_frame_id) for part in (base, level)]
        check(chain == [("odom", "base_link"), ("base_link", "base_stabilized")], f"moving frames: {chain}")
        seq = stage.of(base.header.stamp.ns())[0]
        place = base.transform.translation
        check(np.allclose([place.x, place.y, place.z], [0.1 * seq, 1.0, 1.5]), f"image {seq} is from {place}")
        up = turn(base.transform.rotation) @ turn(level.transform.rotation) @ [0, 0, 1]
        check(np.allclose(up, [0, 0, 1]), f"base_stabilized is not level: {up}")

    for odometry in inboxes["vizflyt/odom"].messages():
        frames = (odometry.header.frame_id, odometry.child_frame_id)
        check(frames == ("odom", "base_link"), f"odometry is of {frames}")
        linear = odometry.twist.twist.linear
        in_map = turn(odometry.pose.pose.orientation) @ [linear.x, linear.y, linear.z]
        check(np.allclose(in_map, [0, 1, 0]), f"the velocity in the map is {in_map}")
    check(inboxes["vizflyt/pose"].messages()[0].header.frame_id == "map", "poses are not in the map")

    readings = inboxes["vizflyt/imu"].messages()
    times = [reading.header.stamp.ns() for reading in readings]
    check(len(times) >= 2 * IMAGES, f"{len(times)} IMU readings of {IMAGES} images")
    check(grow(times), "IMU: stamps do not grow")
    force = readings[0].linear_acceleration
    check((round(force.x, 5), round(force.z, 5)) == (0.1, 9.8), f"IMU: {force}")
    check(readings[0].orientation_covariance[0] == -1, "IMU: an orientation that nobody measured")

    sweep = inboxes["vizflyt/top/points"].messages()[-1]
    layout = [(field.name, field.offset, field.datatype, field.count) for field in sweep.fields]
    check(layout == [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("before_ns", 12, 6, 1), ("intensity", 16, 4, 1),
                     ("ring", 18, 4, 1)], f"a LiDAR's point is {layout}")
    form = (sweep.header.frame_id, sweep.height, sweep.width, sweep.point_step, sweep.row_step, len(sweep.data))
    check(form == ("top", 1, 4, 20, 80, 80), f"a sweep is {form}")


def check_on_demand(stage, domain):
    """Checks topics that are computed only for subscribers: JPEG and points of depth. Returns their subscribers."""
    jpegs = Inbox(domain, FRONT + "image_raw/compressed", ros.CompressedImage, SENSOR)
    clouds = Inbox(domain, FRONT + "depth/points", ros.PointCloud2, SENSOR)
    both = {inbox.name: inbox for inbox in (jpegs, clouds)}
    wait_for(lambda: jpegs.is_matched() and clouds.is_matched(), "nobody sends JPEG and points")
    # Best effort: a busy computer loses some.
    for image in range(40):
        stage.publish()
        poll(both, 0.2)
        counts = len(jpegs.found), len(clouds.found)
        if image >= 7 and min(counts) >= 2:
            break
    check(min(counts) >= 2, f"JPEGs and clouds of 40 images: {counts}")
    jpeg = jpegs.messages()[-1]
    pixels = np.asarray(Image.open(io.BytesIO(bytes(jpeg.data)))).astype(int)
    check(jpeg.format == "jpeg" and pixels.shape == (HEIGHT, WIDTH, 3), f"a JPEG of {pixels.shape}")
    error = np.abs(pixels - stage.of(jpegs.found[-1].stamp_ns())[1]).mean()
    check(error < 4, f"JPEG is off by {error:.1f} on average")
    # One byte follows the points: whether all are finite; then padding to four bytes.
    raw = clouds.found[-1]
    head = raw.data[:raw.data.index(b"rgb\0") + 256]
    count = WIDTH * HEIGHT
    begin = head.index(struct.pack("<I", 16 * count)) + 4
    check(head.rindex(struct.pack("<I", 16 * WIDTH)) < begin, "a cloud's row has another length")
    points = np.frombuffer(raw.data[begin:begin + 16 * count], "<f4").reshape(HEIGHT, WIDTH, 4)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    z_m = np.where(stage.depth_mm == 0, np.nan, stage.depth_mm / 1000)
    (fx, _, cx), (_, fy, cy), _ = stage.intrinsics.opencv_matrix
    expected = np.stack([(x - cx) / fx * z_m, (y - cy) / fy * z_m, z_m], axis=-1)
    check(np.allclose(points[..., :3], expected, atol=1e-4, equal_nan=True), "points lie beside their rays")
    return both


def twist(frame, x, turn=0.0):
    """Returns a velocity along x and a rate about z. [m/s, rad/s]"""
    header = ros.Header(ros.Time(0, 0), frame)
    return ros.TwistStamped(header, ros.Twist(ros.Vector3(x, 0.0, 0.0), ros.Vector3(0.0, 0.0, turn)))


def writers(domain):
    """Returns publishers of velocity, path and landing, as `ros2 topic pub` makes them."""
    kinds = {"cmd_vel": ros.TwistStamped, "path": ros.Path, "land": ros.Empty}
    topics = {name: Topic(domain, f"rt/vizflyt/{name}", kind) for name, kind in kinds.items()}
    made = {name: DataWriter(domain, topic, qos=DEFAULT) for name, topic in topics.items()}
    for name, writer in made.items():
        wait_for(lambda writer=writer: len(writer.get_matched_subscriptions()) > 0, f"nobody takes {name}")
    return made


def answer_of(stage, expected, send=lambda: None, seconds=5.0):
    """Publishes images until the node answers as expected. Calls `send` before each, because a command expires."""
    last = []

    def asked():
        send()
        last[:] = [stage.publish()]
        return last[0] == expected
    deadline = time.monotonic() + seconds
    while not asked():
        check(time.monotonic() < deadline, f"the node answers {last[0]!r}, not {expected!r}")
        time.sleep(0.02)
    check(True, "")


def check_commands(stage, sent, node):
    """Checks velocities by frame and deadline, a path, a landing; and invalid commands."""
    check(stage.publish() == Setpoint.hold(), "without a command the node does not hold")
    known: list[tuple[str, Literal["world", "heading", "body"]]] = [
        ("map", "world"), ("odom", "world"), ("base_stabilized", "heading"), ("base_link", "body")]
    began = 0.0
    for frame, axes in known:
        def send(frame=frame):
            nonlocal began
            began = time.monotonic()
            sent["cmd_vel"].write(twist(frame, 0.5, 0.25))
        answer_of(stage, Setpoint.velocity([0.5, 0, 0], axes=axes, yaw_rate=0.25), send)
    answer_of(stage, Setpoint.hold())
    check(time.monotonic() - began > 0.3, "a velocity ran out early")
    sent["cmd_vel"].write(twist("world", 1.0))
    wait_for(lambda: [stage.publish(), node.said("unknown frame 'world'; give one of map, odom")][1],
             "an unknown frame is not reported")
    sent["cmd_vel"].write(twist("map", float("nan")))
    wait_for(lambda: [stage.publish(), node.said("a number is not finite")][1], "NaN is not reported")
    check(stage.publish() == Setpoint.hold(), "what is not understood flies")

    header = ros.Header(ros.Time(0, 0), "map")
    still = ros.Quaternion(0.0, 0.0, 0.0, 1.0)
    poses = [ros.PoseStamped(header, ros.Pose(ros.Point(x, 1.0, 1.5), still)) for x in (1.0, 2.0)]
    sent["path"].write(ros.Path(header, poses))
    wait_for(lambda: stage.publish().kind == "trajectory", "a path is not flown")
    sent["land"].write(ros.Empty(0))
    answer_of(stage, Setpoint.land())


def check_restart(seq, inboxes):
    """Restarts the runtime: the same node continues, and the landing of the previous flight has no effect."""
    stage = Stage()
    stage.seq = seq
    stage.start()
    images = inboxes[FRONT + "image_raw"]
    known = len(images.found)
    deadline = time.monotonic() + 20
    while len(images.found) == known:
        check(time.monotonic() < deadline, "no images after a restart")
        check(stage.publish() == Setpoint.hold(), "a landing outlives its flight")
        poll(inboxes, 0.05)
    stage.rehearsal.stop()


def fly(vizflyt_program, command, domain_id, domain):
    """Flies the simulated lab: takes off, flies by velocities, lands. Reliable transport; depth in millimetres."""
    inboxes = {inbox.name: inbox for inbox in (
        Inbox(domain, FRONT + "image_raw", ros.Image, DEFAULT),
        Inbox(domain, FRONT + "depth/image_raw", ros.Image, DEFAULT),
        Inbox(domain, "vizflyt/odom", ros.Odometry, DEFAULT),
        Inbox(domain, "vizflyt/imu", ros.Imu, DEFAULT),
    )}
    node = Node(command, domain_id, "--once", "--reliable", "--depth", "16uc1")
    logs = tempfile.TemporaryDirectory()
    flight = subprocess.Popen(
        [vizflyt_program, "fly", "--attach", "--sim", "--no-config", "--headless", "--json", "--scene", "room",
         "--max-rate", "20", "--log-dir", logs.name],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    phases = []

    def read():
        for line in flight.stdout:
            if "event" in (said := json.loads(line)):
                printed.append(line.rstrip())
                phases.append(said["event"]["kind"])
    threading.Thread(target=read, daemon=True).start()
    try:
        sent = writers(domain)
        odometry = inboxes["vizflyt/odom"]

        def at():
            poll(inboxes, 0.02)
            found = odometry.found[-1].decode(ros.Odometry).pose.pose.position if odometry.found else None
            return np.array([found.x, found.y, found.z]) if found else None
        wait_for(lambda: at() is not None and {"phase": "flying"} in phases, "no take-off", 40)
        start = at()
        until = time.monotonic() + 2.0
        while time.monotonic() < until:
            sent["cmd_vel"].write(twist("base_stabilized", 0.4))
            at()
        moved = at() - start
        check(0.3 < np.linalg.norm(moved[:2]) < 1.5, f"at 0.4 m/s for 2 s it moved by {moved} m")
        depth = inboxes[FRONT + "depth/image_raw"].found[-1].decode(ros.Image)
        sent["land"].write(ros.Empty(0))
        wait_for(lambda: [at(), flight.poll() is not None][1], "it does not land", 30)
    finally:
        if flight.poll() is None:
            flight.send_signal(signal.SIGINT)
            flight.wait(20)
        if node.process.poll() is None:
            node.end()
        logs.cleanup()
    check(flight.returncode == 0, f"the flight ended with status {flight.returncode}")
    check((depth.encoding, depth.step) == ("16UC1", 2 * depth.width), f"depth is {depth.encoding}")
    millimetres = np.frombuffer(bytes(depth.data), "<u2")
    near, far = np.percentile(millimetres[millimetres > 0], [5, 95]) / 1000
    check(0.1 < near < far < 30, f"depth in the room is {near} to {far} m")
    readings = [reading.linear_acceleration.z for reading in inboxes["vizflyt/imu"].messages()]
    check(8 < np.median(readings) < 12, f"the IMU feels {np.median(readings)} m/s^2")
    return len(inboxes[FRONT + "image_raw"].found), float(np.linalg.norm(moved))


def rows(stage, inboxes, seconds):
    """Returns latency and load of the messages within this time, a line for each topic; a plugin's own images first."""
    row = "{:<36} {:>5} {:>8} {:>6.1f} {:>7.2f} {:>7.2f}".format
    own_ms, size = np.array(stage.own_ns) / 1e6, stage.grid.nbytes + stage.depth_mm.nbytes
    lines = [row("(a plugin's own, in shared memory)", len(own_ms), size, size * len(own_ms) / seconds / 1e6,
                 *np.percentile(own_ms, [50, 95]))]
    for name, inbox in inboxes.items():
        # No latency for topics without an image's stamp.
        if not inbox.found or name.startswith("tf") or name == "vizflyt/imu":
            continue
        late_ns = [raw.came_ns - stage.of(raw.stamp_ns())[2] for raw in inbox.found]
        total = sum(len(raw.data) for raw in inbox.found)
        lines.append(row(name, len(inbox.found), len(inbox.found[0].data), total / seconds / 1e6,
                         *np.percentile(late_ns, [50, 95]) / 1e6))
    return lines


def main():
    program, command = sys.argv[1], sys.argv[2:]
    domain_id = 20 + os.getpid() % 80
    domain = DomainParticipant(domain_id)
    began = time.monotonic()
    node = Node(command, domain_id)
    try:
        stage = Stage()
        inboxes = subscribe(domain)
        stage.start()
        wait_for(lambda: all(inbox.is_matched() for inbox in inboxes.values()), "a topic is missing")
        # The node learns of its subscribers between images.
        for _ in range(5):
            stage.publish()
            poll(inboxes, 0.1)
        for inbox in inboxes.values():
            inbox.found = inbox.found if inbox.name == "tf_static" else []
        stage.own_ns.clear()
        first = time.monotonic()
        pictures = [inboxes[FRONT + name] for name in ("image_raw", "depth/image_raw")]
        for at in range(10 * IMAGES):
            # A busy machine loses some, and gets more.
            if at >= IMAGES and all(len(inbox.found) >= IMAGES / 2 for inbox in pictures):
                break
            stage.publish()
            poll(inboxes, max(0.0, first + (at + 1) / RATE_HZ - time.monotonic()))
        poll(inboxes, 0.3)
        seconds = time.monotonic() - first
        check_images(stage, inboxes)
        check_motion(stage, inboxes)
        lines = rows(stage, inboxes, seconds)
        stage.own_ns.clear()
        first = time.monotonic()
        on_demand = check_on_demand(stage, domain)
        lines += rows(stage, on_demand, time.monotonic() - first)[1:]
        sent = writers(domain)
        check_commands(stage, sent, node)

        stage.rehearsal.stop()
        # Withdraws its service.
        del stage.rehearsal
        check_restart(stage.seq, inboxes)
        check(node.end() == 0, "the node did not end cleanly")
        # Clouds are still in flight: the unsubscription waits for them.
        deadline = time.monotonic() + 5
        while (left := [name for name, inbox in inboxes.items() if inbox.is_matched()]):
            check(time.monotonic() < deadline, f"the node left without a goodbye on {', '.join(left)}")
            time.sleep(0.005)
    finally:
        node.process.kill()
    images, moved_m = fly(program, command, domain_id, domain)
    print(f"{'topic':<36} {'came':>5} {'bytes':>8} {'MB/s':>6} {'p50 ms':>7} {'p95 ms':>7}")
    print("\n".join(lines))
    print(f"flown: {images} images, {moved_m:.2f} m by velocities; {checks} checks in {time.monotonic() - began:.0f} s")


main()
