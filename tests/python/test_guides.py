"""The scripts of docs/guides that send poses: their conversions, and the ROS 2 node with a fake rclpy."""
import importlib.util
import json
import math
import re
import socket
import sys
import types
from pathlib import Path
from types import SimpleNamespace as Record
from typing import Any

GUIDES = Path(__file__).resolve().parents[2] / "docs" / "guides"


def load(name):
    spec = importlib.util.spec_from_file_location(name, GUIDES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def xyz(x, y, z, **more):
    return Record(x=x, y=y, z=z, **more)


def listener():
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.bind(("127.0.0.1", 0))
    udp.settimeout(30)
    return udp, f"127.0.0.1:{udp.getsockname()[1]}"


def test_a_ros_pose_becomes_a_packet():
    node = load("ros2_pose")
    stamp = Record(sec=12, nanosec=34)
    data = json.loads(node.packet("bee", 7, stamp, xyz(1.0, 2.0, 3.0), xyz(0.0, 0.0, 0.6, w=0.8)))
    assert data == {
        "vizflyt_pose": 1, "object": "bee", "seq": 7, "stamp_ns": 12_000_000_034,
        "position_m": [1.0, 2.0, 3.0], "rotation_xyzw": [0.0, 0.0, 0.6, 0.8],
    }
    covariance = [0.0] * 36
    covariance[0::7] = [1e-4, 4e-4, 9e-4, 1e-4, 1e-4, 4e-4]
    pose = xyz(1.0, 2.0, 3.0), xyz(0.0, 0.0, 0.6, w=0.8)
    data = json.loads(node.packet("bee", 7, stamp, *pose, covariance))
    sigmas = data["position_sigma_m"] + data["rotation_sigma_rad"]
    assert all(abs(a - b) < 1e-12 for a, b in zip(sigmas, [0.01, 0.02, 0.03, 0.02, 0.02, 0.02]))
    for unknown in ([0.0] * 36, [-1.0] + [0.0] * 35):
        assert "position_sigma_m" not in json.loads(node.packet("bee", 7, stamp, *pose, unknown))
    assert node.address("10.0.0.1:51002") == ("10.0.0.1", 51002)


def test_invalid_ros_poses_are_marked():
    node = load("ros2_pose")
    stamp = Record(sec=12, nanosec=34)
    for position, rotation in (
        (xyz(math.nan, 2.0, 3.0), xyz(0.0, 0.0, 0.0, w=1.0)),
        (xyz(1.0, 2.0, 3.0), xyz(0.0, 0.0, 0.0, w=0.0)),
    ):
        data = json.loads(node.packet("bee", 7, stamp, position, rotation))
        assert (data["tracked"], data["rotation_xyzw"]) == (False, [0.0, 0.0, 0.0, 1.0])


def run_node(monkeypatch, parameters, topic, message):
    """Runs the node's main on a fake ROS with one message; returns the packet that it sends."""
    subscribed = {}

    class Node:
        def __init__(self, name):
            assert name == "vizflyt_pose"

        def declare_parameter(self, name, default):
            return Record(value=parameters.get(name, default))

        def create_subscription(self, kind, name, callback, qos):
            subscribed[name] = (kind, callback)

    def spin(node):
        kind, callback = subscribed[topic]
        callback(kind(**message))
        node.udp.close()

    def module(name, **attributes):
        made = types.ModuleType(name)
        vars(made).update(attributes)
        monkeypatch.setitem(sys.modules, name, made)

    pose_stamped, tf = type("PoseStamped", (Record,), {}), type("TFMessage", (Record,), {})
    module("rclpy", init=lambda: None, spin=spin)
    module("rclpy.node", Node=Node)
    module("rclpy.qos", qos_profile_sensor_data=object())
    module("geometry_msgs")
    module("geometry_msgs.msg", PoseStamped=pose_stamped)
    module("tf2_msgs")
    module("tf2_msgs.msg", TFMessage=tf)
    udp, address = listener()
    parameters["server"] = address
    with udp:
        load("ros2_pose").main()
        return json.loads(udp.recv(2048))


def test_the_node_sends_what_a_topic_says(monkeypatch):
    message = {
        "header": Record(stamp=Record(sec=1, nanosec=2), frame_id="map"),
        "pose": Record(position=xyz(1.0, 2.0, 3.0), orientation=xyz(0.0, 0.0, 0.0, w=1.0)),
    }
    data = run_node(monkeypatch, {"topic": "/drone/pose", "object": "bee"}, "/drone/pose", message)
    assert (data["object"], data["position_m"], data["stamp_ns"]) == ("bee", [1.0, 2.0, 3.0], 1_000_000_002)


def test_the_node_sends_the_transform_that_it_is_asked_for(monkeypatch):
    def transform(parent, child, x):
        return Record(
            header=Record(stamp=Record(sec=1, nanosec=2), frame_id=parent), child_frame_id=child,
            transform=Record(translation=xyz(x, 2.0, 3.0), rotation=xyz(0.0, 0.0, 0.0, w=1.0)))

    transforms = [transform("map", "wand", 9.0), transform("/map", "base_link", 1.0)]
    data = run_node(monkeypatch, {"frame": "base_link"}, "/tf", {"transforms": transforms})
    assert (data["object"], data["position_m"]) == ("vizflyt", [1.0, 2.0, 3.0])


def packed(q):
    """Packs x, y, z, w as documented for the Crazyflie's firmware."""
    largest = max(range(4), key=lambda index: abs(q[index]))
    bits = largest
    for index in range(4):
        if index != largest:
            negative = (q[index] < 0) != (q[largest] < 0)
            bits = bits << 10 | negative << 9 | round(0x1FF * abs(q[index]) * math.sqrt(2))
    return bits


def test_a_crazyflie_s_quaternion_is_unpacked():
    script = load("crazyflie_pose")
    for q in ([0, 0, 0, 1], [0, 0, 0.6, 0.8], [0.5, -0.5, 0.5, -0.5], [0.1, -0.7, 0.3, math.sqrt(0.41)]):
        found = script.unpacked(packed(q))
        assert abs(abs(sum(a * b for a, b in zip(found, q))) - 1) < 1e-5, (q, found)
    record = {"stateEstimateZ.x": 1500, "stateEstimateZ.y": -20, "stateEstimateZ.z": 333,
              "stateEstimateZ.quat": packed([0, 0, 0, 1])}
    data = json.loads(script.packet("bee", 3, 77, record))
    assert (data["position_m"], data["stamp_ns"]) == ([1.5, -0.02, 0.333], 77_000_000)
    assert abs(data["rotation_xyzw"][3] - 1) < 1e-9
    variances = {"kalman.varX": 1e-4, "kalman.varY": 4e-4, "kalman.varZ": 1e-4}
    data = json.loads(script.packet("bee", 3, 77, record | variances))
    assert data["tracked"] and [round(s, 6) for s in data["position_sigma_m"]] == [0.01, 0.02, 0.01]
    assert len(data["rotation_sigma_rad"]) == 3
    for lost in (1.0, -1.0, math.nan):
        data = json.loads(script.packet("bee", 3, 77, record | variances | {"kalman.varX": lost}))
        assert not data["tracked"] and "position_sigma_m" not in data


def test_the_ten_lines_of_the_guide_send_a_packet():
    text = (GUIDES / "localization.md").read_text()
    code = re.search(r"```python\n(.*?)```", text, re.S)[1]
    udp, address = listener()
    host, port = address.split(":")
    code = code.replace('"192.168.1.20", 51002', f'"{host}", {port}').replace("while True:", "while seq < 1:")
    system = Record(read=lambda: (1.0, 2.0, 3.0, (0.0, 0.0, 0.0, 1.0)))
    names: dict[str, Any] = {"your_system": system}
    exec(compile(code, "localization.md", "exec"), names)
    with udp, names["udp"]:
        data = json.loads(udp.recv(2048))
    assert (data["vizflyt_pose"], data["seq"], data["position_m"]) == (1, 1, [1.0, 2.0, 3.0])
