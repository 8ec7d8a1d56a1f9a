"""Conversions between plain values and ROS messages.

Clouds and IMU samples are published hundreds of times a second, so both are made as serialized
(CDR) messages: a template lets rclpy serialize one message and then only replaces what changes.
"""

from __future__ import annotations

import array
import struct
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu, PointCloud2, PointField

from l2lidar_node.clouds import DATATYPES, points_of
from l2lidar_node.config import FrameConfig, ImuConfig
from l2lidar_node.protocol import wire
from l2lidar_node.types import FIRST_STAMP, LAST_STAMP, Check, HostNs, ImuSample, split_stamp

_NUMBERS: Final = {code: number for number, code in DATATYPES.items()}

NS: Final = 1_000_000_000

_FIRST_S: Final = FIRST_STAMP // NS
_LAST_S: Final = LAST_STAMP // NS
_STAMP_AT: Final = 4  # in a serialized message, after its encapsulation
STAMP: Final = struct.Struct("<iI")
"""A stamp in a serialized message: seconds, nanoseconds."""
_QUATERNION: Final = struct.Struct("<4d")
_VECTOR: Final = struct.Struct("<3d")


def to_time(stamp: HostNs) -> Time:
    """Return a stamp as a message.

    Raises
    ------
    StampError
        If it is not from 1901 to 2038.
    """
    seconds, nanoseconds = split_stamp(stamp)
    return Time(sec=seconds, nanosec=nanoseconds)


def from_time(stamp: Time) -> HostNs:
    """Return a message's stamp [ns]."""
    return HostNs(stamp.sec * NS + stamp.nanosec)


def point_fields(layout: np.dtype[Any]) -> list[PointField]:
    """Return the fields of a structured dtype.

    Raises
    ------
    ValueError
        If a field's type has no counterpart in PointField, naming it.
    """
    fields = []
    for name, (item, offset, *_) in (layout.fields or {}).items():
        base, shape = item.subdtype or (item, (1,))
        code = f"{base.kind}{base.itemsize}"
        if code not in _NUMBERS:
            raise ValueError(f"field '{name}': type {base} has no PointField counterpart")
        fields.append(
            PointField(name=name, offset=offset, datatype=_NUMBERS[code], count=shape[0])
        )
    return fields


def from_cloud(message: PointCloud2) -> NDArray[np.void]:
    """Return the points of a cloud, row by row, as a view of the message's memory.

    Raises
    ------
    ValueError
        If sizes and data do not agree, or a field is impossible.
    """
    return points_of(message)


def to_cloud(points: NDArray[np.void], stamp: HostNs, frame: str) -> PointCloud2:
    """Return points as a message: shape (N,) unorganised, shape (H, W) organised.

    ``is_dense`` says whether every x, y and z is finite.
    """
    message = PointCloud2()
    message.header.stamp = to_time(stamp)
    message.header.frame_id = frame
    message.height, message.width = points.shape if points.ndim == 2 else (1, len(points))
    message.fields = point_fields(points.dtype)
    message.point_step = points.dtype.itemsize
    message.row_step = message.point_step * message.width
    message.is_dense = bool(all(np.isfinite(points[name]).all() for name in ("x", "y", "z")))
    message.data = array.array("B", np.ascontiguousarray(points).tobytes())
    return message


class CloudTemplate:
    """Makes serialized clouds of one layout and frame.

    Parameters
    ----------
    layout : dtype
        Of the points.
    frame : str
    """

    def __init__(self, layout: np.dtype[np.void], frame: str) -> None:
        message = to_cloud(np.zeros(0, layout), HostNs(0), frame)
        message.width, message.row_step = 0x11111111, 0x22222222
        message.is_dense = True
        data = serialize_message(message)
        before, rest = _split(data, struct.pack("<I", message.width))
        self._between, _ = _split(rest, struct.pack("<I", message.row_step))
        self._encapsulation, self._before = before[:_STAMP_AT], before[_STAMP_AT + STAMP.size :]

    def serialize(self, points: NDArray[np.void], stamp: HostNs) -> bytes:
        """Return the CDR message of finite points, shape (N,), of this template's layout."""
        size = points.nbytes
        return b"".join(
            (
                self.head(len(points), size, stamp),
                struct.pack("<I", size),
                np.ascontiguousarray(points).view(np.uint8).data,  # copied once, here
                b"\x01",  # is_dense
            )
        )

    def head(self, count: int, row_step: int, stamp: HostNs) -> bytes:
        """Return a message up to and with ``row_step``."""
        return b"".join(
            (
                self._encapsulation,
                STAMP.pack(*split_stamp(stamp)),
                self._before,
                struct.pack("<I", count),
                self._between,
                struct.pack("<I", row_step),
            )
        )


class ImuTemplate:
    """Makes serialized IMU messages.

    Parameters
    ----------
    frame : str
    config : ImuConfig
        Gives the covariances.
    """

    _SLOTS: Final = (11.0e11, 12.0e12, 13.0e13)

    def __init__(self, frame: str, config: ImuConfig) -> None:
        message = Imu()
        message.header.frame_id = frame
        message.orientation.x, message.angular_velocity.x, message.linear_acceleration.x = (
            self._SLOTS
        )
        for name, variances in (
            ("orientation", (config.roll_covar, config.pitch_covar, config.yaw_covar)),
            ("angular_velocity", (config.gyro_x_covar, config.gyro_y_covar, config.gyro_z_covar)),
            (
                "linear_acceleration",
                (config.accel_x_covar, config.accel_y_covar, config.accel_z_covar),
            ),
        ):
            setattr(message, f"{name}_covariance", np.diag(variances).reshape(9))
        data = serialize_message(message)
        slots = [data.index(struct.pack("<d", value)) for value in self._SLOTS]
        sizes = (_QUATERNION.size, _VECTOR.size, _VECTOR.size)
        begins = [_STAMP_AT + STAMP.size, *(at + n for at, n in zip(slots, sizes, strict=True))]
        # What never changes: the encapsulation, and what stands before, between and behind.
        self._constant = (
            data[:_STAMP_AT],
            *(data[begin:end] for begin, end in zip(begins, [*slots, len(data)], strict=True)),
        )
        first, *rest = (f"{len(part)}s" for part in self._constant)
        frame, orientation, rate, end = rest
        self._message = struct.Struct(f"<{first}iI{frame}4d{orientation}3d{rate}3d{end}")

    def serialize(self, sample: ImuSample) -> bytes:
        """Return the CDR message of a sample."""
        stamp, (w, x, y, z), (p, q, r), (ax, ay, az) = sample
        seconds, nanoseconds = divmod(stamp, NS)
        if not _FIRST_S <= seconds <= _LAST_S:
            split_stamp(stamp)  # raises
        head, frame, after_orientation, after_rate, end = self._constant
        return self._message.pack(
            head, seconds, nanoseconds, frame, x, y, z, w, after_orientation, p, q, r,
            after_rate, ax, ay, az, end,
        )  # fmt: skip


def _split(data: bytes, mark: bytes) -> tuple[bytes, bytes]:
    """Return the bytes before and after a mark that occurs once."""
    before, found, after = data.partition(mark)
    if not found or mark in after:
        raise ValueError("the serialized message has an unexpected layout")
    return before, after


def imu_transform(frames: FrameConfig, stamp: HostNs) -> TransformStamped:
    """Return the static transform from the cloud frame to the IMU frame."""
    transform = TransformStamped()
    transform.header.stamp = to_time(stamp)
    transform.header.frame_id = frames.cloud
    transform.child_frame_id = frames.imu
    translation = transform.transform.translation
    translation.x, translation.y, translation.z = wire.IMU_POSITION_M
    transform.transform.rotation.w = 1.0
    return transform


def diagnostic_status(check: Check, name: str = "", hardware_id: str = "") -> DiagnosticStatus:
    """Return a check as a message; with a ``name`` the status is called ``<name>: <check>``."""
    return DiagnosticStatus(
        level=bytes([check.level]),
        name=f"{name}: {check.name}" if name else check.name,
        message=check.message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=value) for key, value in check.values.items()],
    )


def diagnostic_array(
    checks: Iterable[Check], name: str, stamp: HostNs, hardware_id: str = ""
) -> DiagnosticArray:
    """Return checks of a node of some name as a message for ``/diagnostics``."""
    message = DiagnosticArray(
        status=[diagnostic_status(check, name, hardware_id) for check in checks]
    )
    message.header.stamp = to_time(stamp)
    return message
