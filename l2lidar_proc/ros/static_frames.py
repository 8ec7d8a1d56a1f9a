"""Follows ``/tf_static``, so that a node knows how its frames are mounted."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

from l2lidar_proc.motion.frames import FrameTree
from l2lidar_proc.rotations import F64, normalised, transform


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
    """

    def __init__(self, node: Node) -> None:
        self.version = 0
        self._tree = FrameTree()
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(TFMessage, "/tf_static", self._take, latched)

    def find(self, target: str, source: str) -> F64 | None:
        """Return source coordinates to target coordinates, (4, 4), None if not known."""
        return self._tree.find(target.lstrip("/"), source.lstrip("/"))

    def _take(self, message: TFMessage) -> None:
        for item in message.transforms:
            q, p = item.transform.rotation, item.transform.translation
            T_parent_child = transform(normalised((q.w, q.x, q.y, q.z)), (p.x, p.y, p.z))
            self._tree.add(
                item.header.frame_id.lstrip("/"), item.child_frame_id.lstrip("/"), T_parent_child
            )
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
