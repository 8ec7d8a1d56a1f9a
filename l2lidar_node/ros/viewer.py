"""Feeds the viewer with live topics."""

from __future__ import annotations

import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu, PointCloud2

from l2lidar_node.programs import held
from l2lidar_node.viewing import ROLES, Viewer


class ViewerNode(Node):
    """Hands every message to the viewer.

    Parameters
    ----------
    viewer : Viewer
    topics : dict
        Topic names by role: those of :data:`l2lidar_node.viewing.ROLES`, ``imu``, ``odometry``.
    """

    def __init__(self, viewer: Viewer, topics: dict[str, str]) -> None:
        super().__init__("l2lidar_viewer")
        sensor_data = qos_profile_sensor_data
        for role in ROLES:
            self.create_subscription(
                PointCloud2,
                topics[role],
                lambda message, role=role: viewer.cloud(message, role),
                sensor_data,
            )
        self.create_subscription(Imu, topics["imu"], viewer.imu, sensor_data)
        self.create_subscription(Odometry, topics["odometry"], viewer.odometry, sensor_data)
        self.create_subscription(DiagnosticArray, "/diagnostics", viewer.diagnostics, 10)


def view(rerun: Any, topics: dict[str, str], seconds: float | None) -> int:
    """Show topics until interrupted or for some seconds; return how many messages were shown.

    rclpy has to be initialised, without handlers of signals.
    """
    viewer = Viewer(rerun)
    node = ViewerNode(viewer, topics)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    end = None if seconds is None else time.monotonic() + seconds
    try:
        while executor.context.ok() and (end is None or time.monotonic() < end):
            with held():
                executor.spin_once(timeout_sec=0.1)
    finally:
        node.destroy_node()
    return viewer.messages
