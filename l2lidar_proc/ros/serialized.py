"""Parser of serialized (CDR) messages: IMU samples in batches, clouds without a copy.

rclpy converts a message field by field, which at 250 IMU samples a second costs more than the
odometry. Both messages have a fixed layout behind the frame's name: many samples are read with one
``numpy.frombuffer``. A message with another layout takes the ordinary path through rclpy.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu, PointCloud2

from l2lidar_node.clouds import Field, points_of
from l2lidar_node.ros.conversions import NS, STAMP, from_time
from l2lidar_node.types import IMU_SAMPLE, HostNs
from l2lidar_proc.motion.imu_buffer import Samples

_LITTLE_ENDIAN: Final = b"\x00\x01"  # encapsulation of plain CDR; two bytes of options follow
_BODY: Final = 4  # alignment counts from the end of the encapsulation
_LENGTH: Final = struct.Struct("<I")
_FRAME: Final = 12  # offset of the frame's length in the message
_NUMBERS: Final = 37  # doubles of an Imu: quaternion, rate, force, and a covariance after each
_MAX_FIELDS: Final = 256


class ImuBatch(NamedTuple):
    """Samples of one frame in arrival order."""

    samples: Samples
    frame: str


class Cloud(NamedTuple):
    """A cloud message.

    Attributes
    ----------
    points : ndarray, shape (N,)
        A view of the message's memory where its rows have no gaps.
    stamp : HostNs
    frame : str
    """

    points: NDArray[np.void]
    stamp: HostNs
    frame: str


def imu_batches(messages: Sequence[bytes]) -> Iterator[ImuBatch]:
    """Yield the samples of serialized ``sensor_msgs/Imu`` messages.

    Parameters
    ----------
    messages : sequence of bytes
        Oldest first. Those that cannot be read are left out.
    """
    for _, group in groupby(messages, key=_head):
        some = list(group)
        layout = _imu_layout(len(some[0]), some[0][_FRAME : _FRAME + 4])
        if layout is None or some[0][:2] != _LITTLE_ENDIAN:
            yield from (found for found in map(_imu_by_rclpy, some) if found is not None)
            continue
        raw = np.frombuffer(b"".join(some), dtype=layout)
        samples = np.empty(len(raw), IMU_SAMPLE)
        numbers = raw["numbers"]
        samples["stamp"] = raw["seconds"].astype(np.int64) * NS + raw["nanoseconds"]
        samples["orientation_wxyz"] = numbers[:, [3, 0, 1, 2]]
        samples["angular_velocity"] = numbers[:, 13:16]
        samples["linear_acceleration"] = numbers[:, 25:28]
        yield ImuBatch(samples, bytes(raw["frame"][0]).rstrip(b"\0").decode(errors="replace"))


def _head(message: bytes) -> tuple[int, bytes, bytes]:
    """Return the parts common to messages of one layout and frame."""
    (length,) = _LENGTH.unpack_from(message, _FRAME) if len(message) >= _FRAME + 4 else (0,)
    end = min(_FRAME + 4 + length, len(message))
    return len(message), message[:2], message[_FRAME:end]


@lru_cache(maxsize=64)
def _imu_layout(size: int, length: bytes) -> np.dtype[np.void] | None:
    """Return the dtype of Imu messages of a size and length of the frame, None if impossible."""
    if len(length) < 4:
        return None
    count = _LENGTH.unpack(length)[0]
    end = _FRAME + 4 + count
    numbers = _BODY + -(-(end - _BODY) // 8) * 8
    if not count or numbers + 8 * _NUMBERS != size:
        return None
    return np.dtype(
        {
            "names": ["seconds", "nanoseconds", "frame", "numbers"],
            "formats": ["<i4", "<u4", f"S{count}", ("<f8", (_NUMBERS,))],
            "offsets": [4, 8, _FRAME + 4, numbers],
            "itemsize": size,
        }
    )


def _imu_by_rclpy(message: bytes) -> ImuBatch | None:
    try:
        found = deserialize_message(message, Imu)
    except Exception:  # whatever the middleware raises for bytes that are not this message
        return None
    q, rate, force = found.orientation, found.angular_velocity, found.linear_acceleration
    row = (
        from_time(found.header.stamp),
        (q.w, q.x, q.y, q.z),
        (rate.x, rate.y, rate.z),
        (force.x, force.y, force.z),
    )
    return ImuBatch(np.array([row], dtype=IMU_SAMPLE), found.header.frame_id)


@dataclass(frozen=True, slots=True)
class _CloudMessage:
    """The parts of a PointCloud2 needed to read its points."""

    height: int
    width: int
    fields: list[Field]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: memoryview


def cloud(message: bytes) -> Cloud:
    """Return a serialized ``sensor_msgs/PointCloud2``.

    Raises
    ------
    ValueError
        If it cannot be read, or sizes and data do not agree, or a field is impossible.
    """
    try:
        parsed, stamp, frame = _parse_cloud(message)
    except (struct.error, UnicodeDecodeError, IndexError):
        return _cloud_by_rclpy(message)
    return Cloud(points_of(parsed), stamp, frame)


def _parse_cloud(message: bytes) -> tuple[_CloudMessage, HostNs, str]:
    if message[:2] != _LITTLE_ENDIAN:
        raise struct.error("another encapsulation")
    seconds, nanoseconds = STAMP.unpack_from(message, 4)
    reader = _Reader(message, _FRAME)
    frame = reader.string()
    height, width, count = reader.number(), reader.number(), reader.number()
    if count > _MAX_FIELDS:
        raise struct.error("too many fields")
    fields = [
        Field(reader.string(), reader.number(), reader.byte(), reader.number())
        for _ in range(count)
    ]
    is_bigendian = bool(reader.byte())
    point_step, row_step, size = reader.number(), reader.number(), reader.number()
    data = memoryview(message)[reader.place : reader.place + size]
    if len(data) < size:
        raise struct.error("cut short")
    parsed = _CloudMessage(height, width, fields, is_bigendian, point_step, row_step, data)
    return parsed, HostNs(seconds * NS + nanoseconds), frame


class _Reader:
    """Reads strings, numbers and bytes of a CDR body in sequence."""

    def __init__(self, message: bytes, place: int) -> None:
        self._message = message
        self.place = place

    def number(self) -> int:
        self.place = _BODY + -(-(self.place - _BODY) // 4) * 4
        (value,) = _LENGTH.unpack_from(self._message, self.place)
        self.place += 4
        return int(value)

    def byte(self) -> int:
        self.place += 1
        return self._message[self.place - 1]

    def string(self) -> str:
        count = self.number()
        text = self._message[self.place : self.place + count]
        if len(text) < count:
            raise struct.error("cut short")
        self.place += count
        return text.rstrip(b"\0").decode()


def _cloud_by_rclpy(message: bytes) -> Cloud:
    try:
        found: Any = deserialize_message(message, PointCloud2)
    except Exception as error:  # whatever the middleware raises for bytes that are not a cloud
        raise ValueError(f"the message is not a PointCloud2: {error}") from None
    return Cloud(points_of(found), from_time(found.header.stamp), found.header.frame_id)
