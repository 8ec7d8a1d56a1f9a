"""Writes the topics of the demo into a bag; the bag is rosbags', so no rosbag2 is needed."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, PointCloud2
from tf2_msgs.msg import TFMessage

from l2lidar_node.recording.bag import BagFile

_TOPICS: Final[dict[str, tuple[type, str, bool]]] = {
    "/points": (PointCloud2, "sensor_msgs/msg/PointCloud2", False),
    "/points_deskewed": (PointCloud2, "sensor_msgs/msg/PointCloud2", False),
    "/imu/data": (Imu, "sensor_msgs/msg/Imu", False),
    "/odometry": (Odometry, "nav_msgs/msg/Odometry", False),
    "/tf": (TFMessage, "tf2_msgs/msg/TFMessage", False),
    "/tf_static": (TFMessage, "tf2_msgs/msg/TFMessage", True),
    "/diagnostics": (DiagnosticArray, "diagnostic_msgs/msg/DiagnosticArray", False),
}
"""Message class, its name, and whether it is latched, by topic."""
_DEPTH: Final = 1000


class TopicRecorder:
    """Records while a ``with`` statement lasts and its node is spun.

    Parameters
    ----------
    node : Node
        Subscribes.
    path : Path
        A new MCAP file where the name ends in ``.mcap``, else a new rosbag2 folder.

    Attributes
    ----------
    messages : int
        What has been written.

    Raises
    ------
    FileExistsError
        If there is something of that name.
    """

    def __init__(self, node: Node, path: Path) -> None:
        self.messages = 0
        self._node = node
        self._bag = BagFile(path)
        self._subscriptions: list[Any] = []
        self._known: set[str] = set()

    def __enter__(self) -> TopicRecorder:
        """Begin to record."""
        self._bag.__enter__()
        for topic, (message, _, latched) in _TOPICS.items():
            latching = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            passing = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
            qos = latching if latched else passing
            self._subscriptions.append(
                self._node.create_subscription(message, topic, self._keep(topic), qos, raw=True)
            )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End the recording and finish the file."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._bag.__exit__(kind, error, trace)

    def _keep(self, topic: str) -> Callable[[bytes], None]:
        _, kind, latched = _TOPICS[topic]

        def keep(data: bytes) -> None:
            if topic not in self._known:
                self._known.add(topic)
                self._bag.connect(topic, kind, _DEPTH, reliable=latched, latched=latched)
            self._bag.write(topic, time.time_ns(), data)
            self.messages += 1

        return keep
