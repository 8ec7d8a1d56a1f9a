"""Converts the messages of a recording to plain values; needs rosbags, not ROS."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection

from l2lidar_node import clouds
from l2lidar_node.recording.bag import (
    CLOUD as CLOUD,
    IMU as IMU,
    TRANSFORMS as TRANSFORMS,
    BagFile as BagFile,
    RecordingError as RecordingError,
    kinds_of as kinds_of,
    messages as messages,
    open_bag as open_bag,
    opened as opened,
    unreadable as unreadable,
)
from l2lidar_node.types import F64, IMU_SAMPLE, HostNs

ODOMETRY: Final = "nav_msgs/msg/Odometry"
TWIST: Final = "geometry_msgs/msg/TwistStamped"
LIVOX: Final = ("livox_ros_driver2/msg/CustomMsg", "livox_ros_driver/msg/CustomMsg")
CLOUDS: Final = (CLOUD, *LIVOX)
"""Types of messages that clouds come in."""


def chosen(kinds: dict[str, str], wanted: str, kind: str | tuple[str, ...], parameter: str) -> str:
    """Return the requested topic, or the only one of its type.

    Parameters
    ----------
    kinds : dict
        Types of the recording's topics, by name.
    wanted : str
    kind : str or tuple of str
        Type or types to look for.
    parameter : str
        What ``wanted`` is the value of, for the message.

    Raises
    ------
    RecordingError
        If there is none, or more than one and none of that name.
    """
    allowed = (kind,) if isinstance(kind, str) else kind
    found = [topic for topic, its in kinds.items() if its in allowed]
    if wanted in found:
        return wanted
    if len(found) == 1:
        return found[0]
    problem = f"no {allowed[0]} on '{wanted}' ({parameter}); there are: "
    if found:
        raise RecordingError(
            f"{problem}{', '.join(found)}: choose with {parameter} in a parameter file "
            "(--params-file)"
        )
    others = ", ".join(f"{topic} ({its})" for topic, its in sorted(kinds.items())) or "none"
    raise RecordingError(f"{problem}none; topics with messages: {others}")


def message_of(reader: AnyReader, connection: Connection, data: bytes) -> Any:
    """Return a message, None if it is damaged."""
    try:
        return reader.deserialize(data, connection.msgtype)
    except Exception:  # whatever bytes that are not this message lead to
        return None


def stamp_of(message: Any) -> HostNs:
    """Return the stamp in a message's header."""
    return HostNs(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)


def points_of(message: Any) -> NDArray[np.void]:
    """Return the points of a cloud message, row by row, shape (N,).

    Raises
    ------
    ValueError
        If fields and sizes do not agree.
    """
    return clouds.points_of(message)


_LIVOX_POINT: Final = np.dtype(
    [
        ("offset_time", "<u4"),  # [ns] after the message's stamp
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("reflectivity", "u1"),
        ("tag", "u1"),
        ("line", "u1"),
    ]
)


def livox_points(data: bytes, *, cdr: bool = True) -> tuple[str, HostNs, NDArray[np.void]]:
    """Return frame, stamp and points (N,) of Livox's CustomMsg, read from its bytes.

    A message holds 20,000 points and more as structures of their own, which a general reader
    makes Python objects of: that takes longer than the odometry.

    Parameters
    ----------
    data : bytes
        A serialized message.
    cdr : bool
        As in ROS 2 (CDR, numbers aligned); False: as in ROS 1 (packed).

    Raises
    ------
    ValueError
        If sizes do not agree.
    """
    if cdr:
        if len(data) < 4 or data[0] != 0 or data[1] not in (1, 0):
            raise ValueError("a Livox message does not begin like CDR")
        if data[1] == 0:
            raise ValueError("a Livox message is big-endian, which is not supported")
        data = data[4:]
    at = 0 if cdr else 4  # ROS 1 begins with a sequence number

    def number(kind: str) -> int:
        nonlocal at
        size = np.dtype(kind).itemsize
        at += -at % size if cdr else 0
        if at + size > len(data):
            raise ValueError("a Livox message is cut off")
        at += size
        return int(np.frombuffer(data, kind, 1, at - size)[0])

    seconds, nanoseconds = number("<u4"), number("<u4")
    length = number("<u4")
    frame = data[at : at + length].rstrip(b"\0").decode("utf-8", "replace")
    at += length
    number("<u8")  # the sensor's own time of the first point
    number("<u4")  # points, which the sequence's length says again
    at += 4  # the unit's number, three bytes of nothing
    count = number("<u4")
    size = _LIVOX_POINT.itemsize
    stride = size + (-size % 4 if cdr else 0)
    if count and at + (count - 1) * stride + size > len(data):
        raise ValueError("a Livox message is cut off")
    whole = np.frombuffer(data[at:].ljust(count * stride, b"\0"), np.uint8, count * stride)
    packed = np.ascontiguousarray(whole.reshape(count, stride)[:, :size])
    stamp = HostNs(seconds * 1_000_000_000 + nanoseconds)
    return frame, stamp, packed.view(_LIVOX_POINT).reshape(-1)


def sample_of(message: Any) -> NDArray[np.void]:
    """Return an IMU message as a sample, shape (1,), dtype IMU_SAMPLE."""
    q, rate, force = message.orientation, message.angular_velocity, message.linear_acceleration
    row = (
        stamp_of(message),
        (q.w, q.x, q.y, q.z),
        (rate.x, rate.y, rate.z),
        (force.x, force.y, force.z),
    )
    return np.array([row], dtype=IMU_SAMPLE)


class Twist(NamedTuple):
    """A velocity as a message gives it.

    Attributes
    ----------
    frame : str
        The body whose velocity it is, and whose axes it is in.
    linear, angular : tuple of float
        [m/s, rad/s].
    covariance : ndarray, shape (3, 3), or None
        Of the velocity, the same axes; None where the message has none.
    """

    frame: str
    linear: tuple[float, float, float]
    angular: tuple[float, float, float]
    covariance: F64 | None


def twist_of(message: Any) -> Twist:
    """Return the velocity in an Odometry or a TwistStamped."""
    is_odometry = hasattr(message, "child_frame_id")
    twist = message.twist.twist if is_odometry else message.twist
    linear, angular = twist.linear, twist.angular
    return Twist(
        str(message.child_frame_id if is_odometry else message.header.frame_id),
        (linear.x, linear.y, linear.z),
        (angular.x, angular.y, angular.z),
        np.reshape(message.twist.covariance, (6, 6))[:3, :3] if is_odometry else None,
    )
