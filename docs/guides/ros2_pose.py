#!/usr/bin/env python3
"""Sends a ROS 2 pose to VizFlyt: a PoseStamped topic, or a transform of /tf.

    python3 ros2_pose.py --ros-args -p topic:=/vrpn_mocap/drone/pose -p server:=192.168.1.20:51002
    python3 ros2_pose.py --ros-args -p frame:=base_link -p parent:=map

ROS 2's map and base_link frames are VizFlyt's world and body (REP 103: x forward, y left, z up), so
that nothing is turned here. Stamps are the message's own, on ROS's clock; the server relates that
clock to its own.
"""
import json
import socket


def packet(object_name, seq, stamp, position, orientation):
    """Returns the bytes of a pose packet; `stamp` has sec and nanosec."""
    return json.dumps({
        "vizflyt_pose": 1,
        "object": object_name,
        "seq": seq,
        "stamp_ns": stamp.sec * 1_000_000_000 + stamp.nanosec,
        "position_m": [position.x, position.y, position.z],
        "rotation_xyzw": [orientation.x, orientation.y, orientation.z, orientation.w],
    }).encode()


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
                self.create_subscription(PoseStamped, topic, self.on_pose, qos_profile_sensor_data)

        def send(self, stamp, position, orientation):
            self.seq += 1
            self.udp.sendto(packet(self.object, self.seq, stamp, position, orientation), self.to)

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
