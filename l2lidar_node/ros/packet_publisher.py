"""Publishes the raw packets of a device, for bags that replay bit for bit."""

from __future__ import annotations

import array

from rclpy._rclpy_pybind11 import RCLError
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import UInt8MultiArray

from l2lidar_node.config import NetworkConfig
from l2lidar_node.recording.packet_bag import PacketBatch
from l2lidar_node.recording.recording import endpoints
from l2lidar_node.types import HostNs

_DEPTH = 100  # 5 s: a recorder that finds the driver within that has all from its first packet


class PacketPublisher:
    """A session's tap that publishes what it hears, a twentieth of a second per message.

    Parameters
    ----------
    node : Node
    topic : str
    network : NetworkConfig
        Addresses that the captures name.
    """

    def __init__(self, node: Node, topic: str, network: NetworkConfig) -> None:
        self._node = node
        latched = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = node.create_publisher(UInt8MultiArray, topic, latched)
        self._batch = PacketBatch(*endpoints(network))

    def received(self, data: bytes, arrival: HostNs) -> None:
        """Publish bytes that came from the device."""
        self._add("received", data, arrival)

    def sent(self, frame: bytes, at: HostNs) -> None:
        """Publish a frame that goes to the device."""
        self._add("sent", frame, at)

    def waited(self, until: HostNs) -> None:
        """Publish that the driver gave up waiting."""
        self._add("waited", until)

    def stepped(self, by_ns: int, at: HostNs) -> None:
        """Publish that the driver was told that the host's clock was set."""
        self._add("stepped", by_ns, at)

    def slewed(self, by_ns: int, at: HostNs) -> None:
        """Publish how far slewing has moved the host's clock."""
        self._add("slewed", by_ns, at)

    def close(self) -> None:
        """Publish what is left."""
        self._publish()

    def _add(self, kind: str, *arguments: object) -> None:
        now = arguments[-1]
        assert isinstance(now, int)
        if self._batch.is_due(HostNs(now)):
            self._publish()
        try:
            self._batch.add(kind, *arguments)
        except OSError as error:
            text = f"packets not published: {error.strerror}"
            self._node.get_logger().error(text, throttle_duration_sec=10.0)

    def _publish(self) -> None:
        data = self._batch.take()
        if not data:
            return
        try:
            self._publisher.publish(UInt8MultiArray(data=array.array("B", data)))
        except RCLError:
            # A signal ends rclpy while the session still hands out what it holds.
            if self._node.context.ok():
                raise
