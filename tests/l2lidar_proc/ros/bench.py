"""A bench for the companion's nodes: a node and, in another one, everything it talks to."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Imu, PointCloud2
from tf2_msgs.msg import TFMessage

from l2lidar_node.ros.conversions import to_cloud, to_time
from l2lidar_node.types import HostNs

TIMEOUT_S = 120.0  # generous: only a failure waits that long
FRAME = "l2lidar_link"
IMU_FRAME = "l2lidar_imu"
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Bench:
    """A node, and a peer that sends what nodes of its kind take and hears how they are.

    Both are in one process and turn by turn in one thread, so that nothing is lost between them
    and nothing happens by itself.

    Parameters
    ----------
    make : callable
        Makes the node.
    overrides : sequence of str
        Its parameters, ``NAME:=VALUE``.
    remappings : sequence of str
        Of names in both, ``OLD:=NEW``.
    """

    def __init__(
        self,
        make: Callable[[], Any],
        overrides: tuple[str, ...],
        remappings: tuple[str, ...] = (),
    ) -> None:
        options = [("-p", item) for item in overrides] + [("-r", item) for item in remappings]
        rclpy.init(args=["test", "--ros-args", *(word for option in options for word in option)])
        self.node = make()
        self.peer: Node = rclpy.create_node("peer")
        self.diagnostics: list[DiagnosticStatus] = []
        self.hear(DiagnosticArray, "/diagnostics", lambda m: self.diagnostics.extend(m.status))
        self.clouds_out = self.peer.create_publisher(PointCloud2, "/points", 10)
        self.imu_out = self.peer.create_publisher(Imu, "/imu/data", 500)
        self.tf_out = self.peer.create_publisher(TFMessage, "/tf_static", LATCHED)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.executor.add_node(self.peer)

    def close(self) -> None:
        self.executor.shutdown()
        self.peer.destroy_node()
        self.node.destroy_node()
        rclpy.shutdown()

    def hear(
        self, kind: type, topic: str, take: Callable[..., object], qos: QoSProfile | int = 50
    ) -> None:
        """Have the peer listen to a topic."""
        self.peer.create_subscription(kind, topic, take, qos)

    def until(self, condition: Callable[[], Any]) -> None:
        """Let both do what they have to until a condition holds."""
        deadline = time.monotonic() + TIMEOUT_S
        while not condition():
            assert time.monotonic() < deadline, "nothing came in time"
            self.executor.spin_once(timeout_sec=0.05)

    def send_sample(self, sample: np.void, frame: str = IMU_FRAME) -> None:
        message = Imu()
        message.header.stamp = to_time(HostNs(int(sample["stamp"])))
        message.header.frame_id = frame
        rate, force = message.angular_velocity, message.linear_acceleration
        rate.x, rate.y, rate.z = sample["angular_velocity"].tolist()
        force.x, force.y, force.z = sample["linear_acceleration"].tolist()
        self.imu_out.publish(message)

    def send_cloud(self, points: np.ndarray, stamp: int) -> None:
        self.clouds_out.publish(to_cloud(points, HostNs(stamp), FRAME))
