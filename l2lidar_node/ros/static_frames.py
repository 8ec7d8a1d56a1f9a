"""Static frames: how a node's frames are mounted, from ``/tf_static``."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

from l2lidar_node.frames import FrameTree
from l2lidar_node.types import F64


class StaticFrames:
    """The static transforms that have been published.

    Parameters
    ----------
    node : Node
        Whose subscription it is.

    Attributes
    ----------
    version : int
        Counts messages: what was looked up before the newest one may have changed.
    refused : str
        The last transform that could not be used, and why; empty if all could.
    """

    def __init__(self, node: Node) -> None:
        self.version = 0
        self.refused = ""
        self._node = node
        self._tree = FrameTree()
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(TFMessage, "/tf_static", self._take, latched)

    def find(self, target: str, source: str) -> F64 | None:
        """Return source coordinates to target coordinates, (4, 4), None if not known."""
        return self._tree.find(target, source)

    def root(self, frame: str) -> tuple[str, F64]:
        """Return the topmost frame above a frame, and what takes its coordinates there, (4, 4)."""
        return self._tree.root(frame)

    def _take(self, message: TFMessage) -> None:
        problems = self._tree.take(message)
        if problems:
            self.refused = f"/tf_static: {problems[-1]}"
            self._node.get_logger().warning(self.refused, throttle_duration_sec=5.0)
        if len(problems) < len(message.transforms):
            self.version += 1


def untied(frames: StaticFrames | None, target: str, source: str) -> str:
    """Return in words why a transform is not known, without frames as well; empty if it is."""
    if target == source:
        return ""
    if frames is None:
        return f"use_tf is false, so nothing tells how '{source}' is mounted"
    if frames.find(target, source) is not None:
        return ""
    return (
        f"'{source}' is not tied to '{target}' on /tf_static; what comes on /tf alone does not "
        "count, since it may move: give a mount as a fixed joint or by static_transform_publisher"
    )
