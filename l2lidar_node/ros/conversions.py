"""Turns plain values into ROS messages and back; changes units and order, nothing else.

Clouds and IMU samples are published hundreds of times a second, so both are made as serialised
(CDR) messages: a template lets rclpy serialise one message and then only replaces what changes.
"""

from __future__ import annotations

import array
import struct
from typing import Any, Final

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu, PointCloud2, PointField

from l2lidar_node import wire
from l2lidar_node.config import FrameConfig, ImuConfig
from l2lidar_node.types import HostNs, ImuSample

_FIELD_TYPES: Final = {
    "i1": PointField.INT8,
    "u1": PointField.UINT8,
    "i2": PointField.INT16,
    "u2": PointField.UINT16,
    "i4": PointField.INT32,
    "u4": PointField.UINT32,
    "f4": PointField.FLOAT32,
    "f8": PointField.FLOAT64,
}
_DTYPES: Final = {number: code for code, number in _FIELD_TYPES.items()}

NS: Final = 1_000_000_000


def to_time(stamp: HostNs) -> Time:
    """Return a stamp as a message."""
    seconds, nanoseconds = divmod(stamp, NS)
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
        if code not in _FIELD_TYPES:
            raise ValueError(f"field '{name}': type {base} has no PointField counterpart")
        fields.append(
            PointField(name=name, offset=offset, datatype=_FIELD_TYPES[code], count=shape[0])
        )
    return fields


def cloud_dtype(message: PointCloud2) -> np.dtype[np.void]:
    """Return the structured dtype of a cloud's points.

    Raises
    ------
    ValueError
        If the fields do not fit ``point_step``, or a type or count is unknown, naming the field.
    """
    order = ">" if message.is_bigendian else "<"
    names: list[str] = []
    formats: list[Any] = []
    offsets: list[int] = []
    for item in message.fields:
        code = _DTYPES.get(item.datatype)
        if code is None:
            raise ValueError(f"field '{item.name}': datatype {item.datatype} is not known")
        count = max(item.count, 1)
        if item.offset + int(code[1]) * count > message.point_step:
            raise ValueError(f"field '{item.name}': does not fit point_step {message.point_step}")
        if item.name in names:
            raise ValueError(f"field '{item.name}': stands twice")
        names.append(item.name)
        formats.append(f"{order}{code}" if count == 1 else (f"{order}{code}", (count,)))
        offsets.append(item.offset)
    return np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step}
    )


def from_cloud(message: PointCloud2) -> NDArray[np.void]:
    """Return the points of a cloud, row by row, as a view of the message's memory.

    Raises
    ------
    ValueError
        If sizes and data do not agree, or a field is impossible.
    """
    layout = cloud_dtype(message)
    data = np.frombuffer(message.data, np.uint8)
    used = message.width * message.point_step
    row_step = message.row_step or used
    if row_step < used or len(data) < row_step * message.height:
        raise ValueError(
            f"cloud of {message.width} x {message.height} points of {message.point_step} B has "
            f"row_step {message.row_step} and {len(data)} B of data"
        )
    rows = data[: row_step * message.height].reshape(message.height, row_step)[:, :used]
    return np.ascontiguousarray(rows).reshape(-1).view(layout)


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
    """Makes serialised clouds of one layout and frame.

    Parameters
    ----------
    layout : dtype
        Of the points.
    frame : str
    """

    _HEAD = struct.Struct("<iI")

    def __init__(self, layout: np.dtype[np.void], frame: str) -> None:
        message = to_cloud(np.zeros(0, layout), HostNs(0), frame)
        message.width, message.row_step = 0x11111111, 0x22222222
        message.is_dense = True
        data = serialize_message(message)
        self._layout = layout
        self._before, rest = _split(data, struct.pack("<I", message.width))
        self._between, _ = _split(rest, struct.pack("<I", message.row_step))

    def serialize(self, points: NDArray[np.void], stamp: HostNs) -> bytes:
        """Return the CDR message of finite points, shape (N,), of this template's layout."""
        seconds, nanoseconds = divmod(stamp, NS)
        size = points.nbytes
        return b"".join(
            (
                self._before[:4],
                self._HEAD.pack(seconds, nanoseconds),
                self._before[12:],
                struct.pack("<I", len(points)),
                self._between,
                struct.pack("<II", size, size),
                points.tobytes(),
                b"\x01",  # is_dense
            )
        )


class ImuTemplate:
    """Makes serialised IMU messages.

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
        self._data = bytearray(serialize_message(message))
        self._at = [self._data.index(struct.pack("<d", value)) for value in self._SLOTS]

    def serialize(self, sample: ImuSample) -> bytes:
        """Return the CDR message of a sample."""
        w, x, y, z = sample.orientation_wxyz
        data = self._data
        struct.pack_into("<iI", data, 4, *divmod(sample.stamp, NS))
        struct.pack_into("<4d", data, self._at[0], x, y, z, w)
        struct.pack_into("<3d", data, self._at[1], *sample.angular_velocity)
        struct.pack_into("<3d", data, self._at[2], *sample.linear_acceleration)
        return bytes(data)


def _split(data: bytes, mark: bytes) -> tuple[bytes, bytes]:
    """Return what stands before and after a mark that occurs once."""
    before, found, after = data.partition(mark)
    if not found or mark in after:
        raise ValueError("the serialised message does not look as expected")
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
