#!/usr/bin/env python3
"""Sends a ROS 2 pose to VizFlyt: a PoseStamped or PoseWithCovarianceStamped topic, or a transform of /tf.

    python3 ros2_pose.py --ros-args -p topic:=/vrpn_mocap/drone/pose -p server:=192.168.1.20:51002
    python3 ros2_pose.py --ros-args -p topic:=/drone/pose -p covariance:=true
    python3 ros2_pose.py --ros-args -p frame:=base_link -p parent:=map

ROS 2's map and base_link frames are VizFlyt's world and body (REP 103: x forward, y left, z up), so
that nothing is turned here. Stamps are the message's own, on ROS's clock; the server relates that
clock to its own. A pose that is not a number, or has a quaternion of zeros, is sent as not tracked.
"""
import json
import math
import socket


def packet(object_name, seq, stamp, position, orientation, covariance=None):
    """Returns the bytes of a pose packet; `stamp` has sec and nanosec, `covariance` is ROS's 6x6 matrix by rows."""
    p = [position.x, position.y, position.z]
    q = [orientation.x, orientation.y, orientation.z, orientation.w]
    tracked = all(map(math.isfinite, p + q)) and any(q)
    data = {
        "vizflyt_pose": 1,
        "object": object_name,
        "seq": seq,
        "stamp_ns": stamp.sec * 1_000_000_000 + stamp.nanosec,
        "position_m": p if tracked else [0.0, 0.0, 0.0],
        "rotation_xyzw": q if tracked else [0.0, 0.0, 0.0, 1.0],
    }
    if not tracked:
        data["tracked"] = False
    variances = [covariance[7 * axis] for axis in range(6)] if covariance is not None else [0.0]
    # Zeros or -1 mean that the covariance is unknown.
    if all(math.isfinite(value) and value > 0 for value in variances):
        sigmas = [math.sqrt(value) for value in variances]
        data["position_sigma_m"] = sigmas[:3]
        # ROS's are about the axes of the world: the largest holds for all axes of the body.
        data["rotation_sigma_rad"] = [max(sigmas[3:])] * 3
    return json.dumps(data).encode()


def address(text):
    """Returns (host, port) of HOST:PORT."""
    host, _, port = text.rpartition(":")
    return host or "127.0.0.1", int(port)


def main():
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data

    class PoseSender(Node):
        """Listens to one topic or one transform."""

        def __init__(self):
            super().__init__("vizflyt_pose")
            say = lambda name, default: self.declare_parameter(name, default).value
            self.object = say("object", "vizflyt")
            self.to = address(say("server", "127.0.0.1:51002"))
            self.frame, self.parent = say("frame", ""), say("parent", "map")
            self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.seq = 0
            if self.frame:
                from tf2_msgs.msg import TFMessage
                self.create_subscription(TFMessage, "/tf", self.on_tf, 100)
            else:
                topic = say("topic", "/pose")
                if say("covariance", False):
                    from geometry_msgs.msg import PoseWithCovarianceStamped
                    kind, callback = PoseWithCovarianceStamped, self.on_pose_with_covariance
                else:
                    kind, callback = PoseStamped, self.on_pose
                self.create_subscription(kind, topic, callback, qos_profile_sensor_data)

        def send(self, stamp, position, orientation, covariance=None):
            self.seq += 1
            data = packet(self.object, self.seq, stamp, position, orientation, covariance)
            self.udp.sendto(data, self.to)

        def on_pose_with_covariance(self, message):
            pose = message.pose.pose
            self.send(message.header.stamp, pose.position, pose.orientation, message.pose.covariance)

        def on_pose(self, message):
            self.send(message.header.stamp, message.pose.position, message.pose.orientation)

        def on_tf(self, message):
            for transform in message.transforms:
                # Direct children of the parent only: a chain has no single stamp.
                names = (transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/"))
                if names == (self.parent.lstrip("/"), self.frame.lstrip("/")):
                    pose = transform.transform
                    self.send(transform.header.stamp, pose.translation, pose.rotation)

    rclpy.init()
    try:
        rclpy.spin(PoseSender())
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
