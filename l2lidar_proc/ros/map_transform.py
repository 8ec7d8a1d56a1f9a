"""Publishes the transform from the odometry frame to the map, again and again."""

from __future__ import annotations

import time
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile
from tf2_msgs.msg import TFMessage

from l2lidar_node.types import HostNs
from l2lidar_proc.ros import odometry_messages as messages
from l2lidar_proc.slam.config import SlamTopics
from l2lidar_proc.slam.se3 import interpolated, inverse

F64 = NDArray[np.float64]

_OTHER_PARENT_S: Final = 3.0  # for which one message makes another parent be believed in
_AHEAD_S: Final = 1.0  # the transform is carried on so long after the last odometry


class MapTransform:
    """The broadcaster of ``map`` to ``odom``.

    Parameters
    ----------
    node : Node

    Attributes
    ----------
    other_parent : str
        Of the odometry frame, if it had one a moment ago: then nothing is published.
    """

    def __init__(self, node: Node) -> None:
        self.other_parent = ""
        self._other_parent_s = 0.0
        self._publisher = node.create_publisher(TFMessage, "/tf", QoSProfile(depth=100))
        self._stamped = 0
        self._blend = Blend()

    def watch(self, message: TFMessage, topics: SlamTopics, odom_frame: str) -> None:
        """Notice whether somebody else is the parent of the odometry frame already."""
        for transform in message.transforms:
            parent = transform.header.frame_id
            if transform.child_frame_id == odom_frame and parent != topics.map_frame:
                self.other_parent, self._other_parent_s = parent, time.monotonic()

    def publish(
        self,
        T_map_odom: F64 | None,
        T_odom_body: F64,
        stamp: HostNs,
        arrival_ns: int,
        odom_frame: str,
        topics: SlamTopics,
    ) -> None:
        """Publish the transform, stamped a bit ahead of the newest odometry.

        Parameters
        ----------
        T_map_odom : ndarray, shape (4, 4), or None
            None while it is not known: nothing is published.
        T_odom_body : ndarray, shape (4, 4)
            Newest odometry.
        stamp : HostNs
            Of that.
        arrival_ns : int
            When it came, ``time.monotonic_ns()``.
        odom_frame : str
        topics : SlamTopics
        """
        now = time.monotonic_ns()
        if now * 1e-9 - self._other_parent_s > _OTHER_PARENT_S:
            self.other_parent = ""
        shown = self._blend.toward(T_map_odom, T_odom_body, now * 1e-9, topics.blend_s)
        if shown is None or not topics.publish_tf or self.other_parent:
            return
        ahead = min(now - arrival_ns, round(_AHEAD_S * 1e9))
        stamped = stamp + ahead + round(topics.tf_tolerance_s * 1e9)
        if self._stamped - round(2e9 * _AHEAD_S) < stamped <= self._stamped:
            return  # a transform of that instant is out already
        self._stamped = stamped
        made = messages.transform(shown, HostNs(stamped), topics.map_frame, odom_frame)
        self._publisher.publish(TFMessage(transforms=[made]))


class Blend:
    """Lets a transform follow its corrections over some time instead of at once."""

    def __init__(self) -> None:
        self._from: F64 | None = None
        self._target: F64 | None = None
        self._shown: F64 | None = None
        self._began_s = 0.0

    def toward(
        self, target: F64 | None, T_odom_body: F64, now_s: float, blend_s: float
    ) -> F64 | None:
        """Return the transform to show now.

        Parameters
        ----------
        target : ndarray, shape (4, 4), or None
            ``T_map_odom`` as it should be; an object that is replaced, not changed.
        T_odom_body : ndarray, shape (4, 4)
            The correction is blended where the body is: about the origin of the odometry a small
            turn would swing it far out.
        now_s : float
            Any clock that ascends.
        blend_s : float
        """
        if target is not self._target:
            # Where nothing was known there is nothing to come from.
            self._from = self._shown if target is not None else None
            self._target, self._began_s = target, now_s
        share = min((now_s - self._began_s) / blend_s, 1.0) if blend_s > 0.0 else 1.0
        if target is None or self._from is None or share >= 1.0:
            self._shown = target
            return target
        at = np.eye(4)
        at[:3, 3] = T_odom_body[:3, 3]
        (blended,) = interpolated(self._from @ at, target @ at, np.array([share])) @ inverse(at)
        self._shown = blended
        return self._shown
