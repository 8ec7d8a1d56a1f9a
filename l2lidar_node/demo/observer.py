"""Observes the topics of the demo and records them to a bag."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, PointCloud2
from tf2_msgs.msg import TFMessage

from l2lidar_node.programs import held
from l2lidar_node.recording.bag import BagFile
from l2lidar_node.ros.conversions import from_cloud, from_time

_PAIRS: Final = 60


@dataclass(slots=True)
class TopicRecord:
    """Messages observed on one topic.

    Attributes
    ----------
    stamps : list of int
        Header stamps [ns] in the order of arrival.
    ages_s : list of float
        From stamp to arrival [s].
    arrivals : list of float
        Monotonic times of arrival [s].
    frame : str
    """

    stamps: list[int] = field(default_factory=list)
    ages_s: list[float] = field(default_factory=list)
    arrivals: list[float] = field(default_factory=list)
    frame: str = ""

    def add(self, stamp: int, frame: str) -> None:
        """Note one message."""
        self.stamps.append(stamp)
        self.ages_s.append((time.time_ns() - stamp) / 1e9)
        self.arrivals.append(time.monotonic())
        self.frame = frame

    @property
    def rate_hz(self) -> float:
        """Messages per second by arrival; 0 with fewer than two."""
        if len(self.arrivals) < 2:
            return 0.0
        return (len(self.arrivals) - 1) / (self.arrivals[-1] - self.arrivals[0])

    @property
    def backward_steps(self) -> int:
        """Stamps that are not later than the one before."""
        return int((self.intervals_ms <= 0).sum())

    @property
    def intervals_ms(self) -> NDArray[np.float64]:
        """Differences of consecutive stamps [ms]."""
        stamps = np.array(self.stamps, np.int64)
        return (stamps[1:] - stamps[:-1]) / 1e6


class Observer(Node):
    """A node that subscribes to everything the driver publishes."""

    def __init__(self) -> None:
        super().__init__("l2lidar_demo_observer")
        self.clouds = TopicRecord()
        self.imu = TopicRecord()
        self.deskewed = TopicRecord()
        self.odometry = TopicRecord()
        self.positions: list[tuple[float, float, float]] = []
        self.follows = True  # the odometry; not once it has begun anew
        self.pairs: dict[int, list[NDArray[np.void] | None]] = {}
        self.points: list[int] = []
        self.cloud: NDArray[np.void] | None = None
        self.fields: list[str] = []
        self.diagnostics: list[dict[str, dict[str, str]]] = []
        self.transforms: list[tuple[str, str]] = []
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        # Deep, so that only the driver can lose something: rclpy takes one message at a time.
        deep = QoSProfile(depth=500, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(PointCloud2, "/points", self._cloud, deep)
        self.create_subscription(Imu, "/imu/data", self._imu, deep)
        self.create_subscription(PointCloud2, "/points_deskewed", self._deskewed, deep)
        self.create_subscription(Odometry, "/odometry", self._odometry, deep)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._diagnose, 10)
        self.create_subscription(TFMessage, "/tf_static", self._transform, latched)

    def publish_static(self, message: TFMessage) -> None:
        """Publish a mount, as a robot's description would."""
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._mount = self.create_publisher(TFMessage, "/tf_static", latched)
        self._mount.publish(message)

    @property
    def checks(self) -> dict[str, dict[str, str]]:
        """The latest value of every check by name, of all nodes."""
        return {name: check for entry in self.diagnostics for name, check in entry.items()}

    def watch(self, until: float) -> None:
        """Handle messages until a monotonic time [s]."""
        while (left := until - time.monotonic()) > 0:
            with held():
                rclpy.spin_once(self, timeout_sec=min(left, 0.1))

    def _cloud(self, message: PointCloud2) -> None:
        self.clouds.add(from_time(message.header.stamp), message.header.frame_id)
        self.cloud = from_cloud(message)
        self.fields = [item.name for item in message.fields]
        self.points.append(message.width * message.height)
        self._pair(from_time(message.header.stamp), 0, self.cloud)

    def _deskewed(self, message: PointCloud2) -> None:
        stamp = from_time(message.header.stamp)
        self.deskewed.add(stamp, message.header.frame_id)
        self._pair(stamp, 1, from_cloud(message))

    def _odometry(self, message: Odometry) -> None:
        if not self.follows:
            return
        self.odometry.add(from_time(message.header.stamp), message.header.frame_id)
        place = message.pose.pose.position
        self.positions.append((place.x, place.y, place.z))

    def _pair(self, stamp: int, side: int, points: NDArray[np.void]) -> None:
        """Keep the clouds of the last few stamps, raw beside deskewed."""
        self.pairs.setdefault(stamp, [None, None])[side] = points
        for old in sorted(self.pairs)[:-_PAIRS]:
            del self.pairs[old]

    def _imu(self, message: Imu) -> None:
        self.imu.add(from_time(message.header.stamp), message.header.frame_id)

    def _diagnose(self, message: DiagnosticArray) -> None:
        self.diagnostics.append(
            {
                status.name.rpartition(": ")[2]: {
                    "level": str(status.level[0]),
                    "message": status.message,
                    **{item.key: item.value for item in status.values},
                }
                for status in message.status
            }
        )

    def _transform(self, message: TFMessage) -> None:
        self.transforms += [
            (item.header.frame_id, item.child_frame_id) for item in message.transforms
        ]


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
    """Records during a ``with`` statement, while its node is spun.

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
