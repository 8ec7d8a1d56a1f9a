"""Publishes the transform from the odometry frame to the map periodically."""

from __future__ import annotations

import time
from typing import Final

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile
from tf2_msgs.msg import TFMessage

from l2lidar_node.ros.conversions import from_time
from l2lidar_node.types import F64, HostNs
from l2lidar_proc.ros import odometry_messages as messages
from l2lidar_proc.slam.config import SlamTopics
from l2lidar_proc.slam.se3 import interpolated, inverse

AHEAD_NS: Final = 2_000_000_000
"""How far beyond the newest odometry message the transform is carried on at most [ns].

Dead reckoning ends 1 s after a sweep, whose message is some 0.3 s old when it comes.
"""

FARTHEST_NS: Final = 10_000_000_000
"""How far transforms from the odometry frame may be ahead of its newest message [ns].

The IMU carries them on while the sweeps of a busy machine wait. tf2 keeps 10 s; what is farther
ahead is of another clock.
"""

_OTHER_PARENT_S: Final = 3.0  # for which one message makes another parent be believed in
_SAME_TIME_NS: Final = 2_000_000_000  # a stamp that goes back by more begins a new time line


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
        self._odometry_until = 0  # stamp of the newest transform from odom to the body
        self._blend = Blend()

    def watch(self, message: TFMessage, topics: SlamTopics, odom_frame: str) -> None:
        """Note how far the odometry's transforms reach, and whether odom has another parent."""
        for transform in message.transforms:
            parent = transform.header.frame_id
            if parent == odom_frame:
                self._odometry_until = from_time(transform.header.stamp)
            elif transform.child_frame_id == odom_frame and parent != topics.map_frame:
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
        """Publish the transform, stamped ``transform_tolerance`` ahead of the newest odometry.

        That is the later one of the newest transform from odom to the body and the newest
        odometry message, carried on to the present. So whatever is stamped up to now can be
        transformed into the map at once; a correction takes so long to reach those who look up
        the present.

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
        covered = reach(stamp, now - arrival_ns, self._odometry_until)
        stamped = covered + round(topics.transform_tolerance * 1e9)
        if self._stamped - _SAME_TIME_NS < stamped <= self._stamped:
            return  # a transform of that instant is out already
        self._stamped = stamped
        made = messages.transform(shown, HostNs(stamped), topics.map_frame, odom_frame)
        self._publisher.publish(made)


def reach(stamp: HostNs, waited_ns: int, transforms_until: int) -> int:
    """Return the newest time for which the transform may be requested [ns].

    Parameters
    ----------
    stamp : HostNs
        Of the newest odometry message.
    waited_ns : int
        How long ago that came.
    transforms_until : int
        Stamp of the newest transform from the odometry frame to the body, 0 if there is none.
    """
    carried = stamp + min(waited_ns, AHEAD_NS)
    if transforms_until <= stamp + FARTHEST_NS:
        return max(carried, transforms_until)
    return carried


class Blend:
    """Blends corrections of a transform over some time."""

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
