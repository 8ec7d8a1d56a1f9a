"""Writes what a driver hands out into a bag, as its node would publish it; needs no ROS."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from l2lidar_node.clouds.layouts import LAYOUTS
from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Event
from l2lidar_node.protocol import wire
from l2lidar_node.types import HostNs, ImuSample, Sweep

_NS: Final = 1_000_000_000
_CLOUD: Final = "sensor_msgs/msg/PointCloud2"
_IMU: Final = "sensor_msgs/msg/Imu"
_TF: Final = "tf2_msgs/msg/TFMessage"
_DATATYPES: Final = {
    "i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8,
}  # fmt: skip
"""Numbers of ``sensor_msgs/PointField`` by the kind and size of a NumPy type."""


class BagFile:
    """A bag that serialised messages are written into; use it in a ``with``.

    Parameters
    ----------
    path : Path
        A new MCAP file where the name ends in ``.mcap``, else a new rosbag2 folder.

    Raises
    ------
    FileExistsError
        If there is something of that name.
    """

    def __init__(self, path: Path) -> None:
        if path.exists():
            raise FileExistsError(errno.EEXIST, "it exists already", str(path))
        self._path = path
        # rosbags writes folders: for a single file, what is in one is taken out at the end.
        self._folder = path.with_suffix(".unfinished") if path.suffix == ".mcap" else path
        if self._folder.exists():
            left = f"'{self._folder}' was cut off; remove it if it is of no use"
            raise FileExistsError(errno.EEXIST, left, str(path))
        self._writer = Writer(self._folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, Connection] = {}
        self._is_used = False
        self.store = get_typestore(Stores.ROS2_JAZZY)

    def __enter__(self) -> BagFile:
        """Make the file."""
        self._writer.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish the file; after an exception it does not get its name, or goes if empty."""
        self._writer.close()
        if kind is not None:
            if not self._is_used:
                shutil.rmtree(self._folder)
        elif self._folder != self._path:
            (content,) = self._folder.glob("*.mcap")
            content.replace(self._path)
            shutil.rmtree(self._folder)

    def connect(self, topic: str, kind: str, depth: int, reliable: bool, latched: bool) -> None:
        """Announce a topic, its message type such as ``sensor_msgs/msg/Imu`` and its QoS."""
        self._connections[topic] = self._writer.add_connection(
            topic,
            kind,
            typestore=self.store,
            offered_qos_profiles=[_qos(depth, reliable, latched)],
        )

    def write(self, topic: str, now: int, data: bytes | memoryview) -> None:
        """Append a serialised (CDR) message that was received at an instant [ns]."""
        self._is_used = True
        self._writer.write(self._connections[topic], now, data)


class BagWriter:
    """A bag of clouds, IMU samples and the static transform; use it in a ``with``.

    Parameters
    ----------
    path : Path
        See :class:`BagFile`.
    config : DriverConfig
        Topics, frames, point layout and covariances.

    Attributes
    ----------
    clouds, samples : int
        What has been written.
    """

    def __init__(self, path: Path, config: DriverConfig) -> None:
        self.clouds = 0
        self.samples = 0
        self._file = BagFile(path)
        self._config = config
        self._layout = LAYOUTS[config.topics.point_layout]
        self._store = self._file.store
        self._types: Any = self._store.types

    def __enter__(self) -> BagWriter:
        """Make the file."""
        self._file.__enter__()
        topics = self._config.topics
        reliable = topics.qos_reliability == "reliable"
        for topic, kind, depth in (
            (topics.point_cloud_topic_id, _CLOUD, 10),
            (topics.imu_topic_id, _IMU, 1000),
        ):
            self._file.connect(topic, kind, depth, reliable, latched=False)
        if self._config.frames.publish_tf:
            self._file.connect("/tf_static", _TF, 1, reliable=True, latched=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish the file."""
        self._file.__exit__(kind, error, trace)

    def add(self, event: Event) -> None:
        """Write a sweep or a sample; everything else is passed over.

        The time at which a message counts as received is the end of what it measured.
        """
        if isinstance(event, Sweep):
            self._begin(event.start)
            topic = self._config.topics.point_cloud_topic_id
            self._write(topic, _CLOUD, event.end, self._cloud(event))
            self.clouds += 1
        elif isinstance(event, ImuSample):
            self._begin(event.stamp)
            topic = self._config.topics.imu_topic_id
            self._write(topic, _IMU, event.stamp, self._imu(event))
            self.samples += 1

    def _begin(self, now: HostNs) -> None:
        """Write the static transform before everything else."""
        if self.clouds or self.samples or not self._config.frames.publish_tf:
            return
        types = self._types
        frames = self._config.frames
        transform = types["geometry_msgs/msg/TransformStamped"](
            header=self._header(now, frames.cloud),
            child_frame_id=frames.imu,
            transform=types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](*wire.IMU_POSITION_M),
                rotation=types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            ),
        )
        self._write("/tf_static", _TF, now, types[_TF](transforms=[transform]))

    def _cloud(self, sweep: Sweep) -> Any:
        points = self._layout.convert(sweep.points, sweep.start)
        fields = [
            self._types["sensor_msgs/msg/PointField"](
                name=name,
                offset=offset,
                datatype=_DATATYPES[f"{item.base.kind}{item.base.itemsize}"],
                count=int(np.prod(item.shape)),
            )
            for name, (item, offset, *_) in (points.dtype.fields or {}).items()
        ]
        return self._types[_CLOUD](
            header=self._header(sweep.start, self._config.frames.cloud),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=points.dtype.itemsize,
            row_step=points.nbytes,
            data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=True,
        )

    def _imu(self, sample: ImuSample) -> Any:
        w, x, y, z = sample.orientation_wxyz
        imu = self._config.imu
        vector = self._types["geometry_msgs/msg/Vector3"]
        return self._types[_IMU](
            header=self._header(sample.stamp, self._config.frames.imu),
            orientation=self._types["geometry_msgs/msg/Quaternion"](x, y, z, w),
            orientation_covariance=_diagonal(imu.roll_covar, imu.pitch_covar, imu.yaw_covar),
            angular_velocity=vector(*sample.angular_velocity),
            angular_velocity_covariance=_diagonal(
                imu.gyro_x_covar, imu.gyro_y_covar, imu.gyro_z_covar
            ),
            linear_acceleration=vector(*sample.linear_acceleration),
            linear_acceleration_covariance=_diagonal(
                imu.accel_x_covar, imu.accel_y_covar, imu.accel_z_covar
            ),
        )

    def _header(self, stamp: HostNs, frame: str) -> Any:
        time = self._types["builtin_interfaces/msg/Time"](*divmod(int(stamp), _NS))
        return self._types["std_msgs/msg/Header"](stamp=time, frame_id=frame)

    def _write(self, topic: str, kind: str, now: HostNs, message: Any) -> None:
        self._file.write(topic, now, self._store.serialize_cdr(message, kind))


def _diagonal(*variances: float) -> Any:
    return np.diag(np.array(variances, np.float64)).reshape(9)


def _qos(depth: int, reliable: bool, latched: bool) -> Qos:
    never = QosTime(0, 0)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=never,
        lifespan=never,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=never,
        avoid_ros_namespace_conventions=False,
    )
