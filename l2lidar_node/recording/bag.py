"""Bags without ROS: reads any bag, and writes a driver's output as its node publishes it."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
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
from rosbags.typesys.store import Typestore

from l2lidar_node.clouds import DATATYPES, LAYOUTS
from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Event
from l2lidar_node.files import free_name
from l2lidar_node.protocol import wire
from l2lidar_node.types import HostNs, ImuSample, Sweep, split_stamp

CLOUD: Final = "sensor_msgs/msg/PointCloud2"
IMU: Final = "sensor_msgs/msg/Imu"
TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"
_DATATYPES: Final = {code: number for number, code in DATATYPES.items()}
_METADATA: Final = "metadata.yaml"
_FOLDER_SUFFIXES: Final = (".mcap", ".db3")  # of the files in a rosbag2 folder
_BAG_SUFFIXES: Final = (*_FOLDER_SUFFIXES, ".bag")
_NO_END: Final = "File end magic is invalid."  # of an MCAP file whose writer was killed


class RecordingError(ValueError):
    """A recording that cannot be used; the message says which and why."""


def open_bag(path: Path) -> AnyReader:
    """Return a reader of a rosbag2 folder or a file of one; use it in a ``with``.

    Where a folder has no metadata.yaml, which a recorder writes last, its files are read.
    """
    paths = [path]
    if path.is_dir() and not (path / _METADATA).exists():
        paths = _files(path) or paths
    return AnyReader(paths, default_typestore=get_typestore(Stores.ROS2_JAZZY))


def _files(folder: Path) -> list[Path]:
    return sorted(item for item in folder.iterdir() if item.suffix in _FOLDER_SUFFIXES)


@contextmanager
def opened(path: Path) -> Iterator[AnyReader]:
    """Open a recording for a ``with``.

    Raises
    ------
    RecordingError
        If it cannot be opened; the message names the file.
    """
    try:
        reader = open_bag(path)
        reader.open()
    except Exception as error:
        # Of a damaged file, any byte may lead anywhere in its readers.
        raise unreadable(path, error) from None
    try:
        yield reader
    finally:
        reader.close()


def unreadable(path: Path, error: Exception) -> RecordingError:
    """Return the error for a recording whose reader failed; its message names the file."""
    if isinstance(error, RecordingError):
        return error
    return RecordingError(f"{path}: {why_unreadable(path, error)}")


def why_unreadable(path: Path, error: Exception) -> str:
    """Return what to tell the user of a recording whose reader failed."""
    if not path.exists():
        return "no such file or folder"
    if path.is_dir() and not (path / _METADATA).exists() and not _files(path):
        return "not a rosbag2 folder: it has no metadata.yaml"
    if path.is_file() and path.suffix not in _BAG_SUFFIXES:
        return "cannot be read as a recording: neither a capture, nor MCAP, nor a rosbag2 folder"
    words = " ".join(str(error).split()) or type(error).__name__
    if words == _NO_END:
        words = "its end is missing; 'mcap recover' saves what is there"
    return f"cannot be read as a recording: {words}"


def messages(reader: AnyReader) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield every message of a bag in the order it was recorded, with that instant [ns].

    Raises
    ------
    RecordingError
        If it is damaged.
    """
    try:
        yield from reader.messages()
    except Exception as error:  # only of the reader: what is done with a message is not in here
        raise unreadable(Path(str(reader.paths[0])), error) from None


def kinds_of(reader: AnyReader) -> dict[str, str]:
    """Return the message types of a bag's topics, by name; topics without messages are left out.

    All of them where the recorder has not counted.
    """
    counted = {item.topic: item.msgtype for item in reader.connections if item.msgcount}
    return counted or {item.topic: item.msgtype for item in reader.connections}


class BagFile:
    """Writer of serialized messages to a bag; use it in a ``with``.

    It gets its name when it is finished. Until then it grows in a folder beside it that ends in
    ``.unfinished``; what a killed run left there neither blocks the next one nor is lost.

    Parameters
    ----------
    path : Path
        A new MCAP file where the name ends in ``.mcap``, else a new rosbag2 folder.
    keep_unfinished : bool
        Whether an exception leaves what was written until then, rather than removing it.
    store : Typestore, optional
        Message types; those of ROS 2 Jazzy unless given. A copy takes those of its source.

    Attributes
    ----------
    unfinished : Path or None
        What an exception left.

    Raises
    ------
    FileExistsError
        If there is something of that name.
    """

    def __init__(
        self, path: Path, *, keep_unfinished: bool = False, store: Typestore | None = None
    ) -> None:
        if path.exists():
            raise FileExistsError(errno.EEXIST, "it exists already", str(path))
        self.unfinished: Path | None = None
        self._path = path
        self._is_file = path.suffix == ".mcap"
        name = path.stem if self._is_file else path.name
        self._scratch = free_name(path.with_name(f"{name}.unfinished"))
        self._folder = self._scratch / name
        self._writer = Writer(self._folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, Connection] = {}
        self._copied: dict[tuple[str, str], Connection] = {}
        self._is_used = False
        self._keeps = keep_unfinished
        self.store = get_typestore(Stores.ROS2_JAZZY) if store is None else store

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
        """Finish the file and give it its name; see ``keep_unfinished`` for exceptions."""
        is_closed = False
        try:
            self._writer.close()
            is_closed = True
        finally:
            if kind is not None or not is_closed:
                if self._is_used and self._keeps:
                    self.unfinished = self._content()
                else:
                    shutil.rmtree(self._scratch)
        if kind is None:
            self._content().replace(self._path)
            shutil.rmtree(self._scratch)

    def _content(self) -> Path:
        return self._folder / f"{self._folder.name}.mcap" if self._is_file else self._folder

    def connect(self, topic: str, kind: str, depth: int, reliable: bool, latched: bool) -> None:
        """Announce a topic, its message type such as ``sensor_msgs/msg/Imu`` and its QoS."""
        self._connections[topic] = self._writer.add_connection(
            topic,
            kind,
            typestore=self.store,
            offered_qos_profiles=[_qos(depth, reliable, latched)],
        )

    def write(self, topic: str, now: int, data: bytes | memoryview) -> None:
        """Append a serialized (CDR) message that was received at an instant [ns]."""
        self._is_used = True
        self._writer.write(self._connections[topic], now, data)

    def cloud(
        self, topic: str, now: int, points: NDArray[np.void], stamp: HostNs, frame: str
    ) -> None:
        """Append points as a cloud; see :func:`cloud_message`. Announce the topic if it is new."""
        if topic not in self._connections:
            self.connect(topic, CLOUD, 10, reliable=True, latched=False)
        message = cloud_message(self.store, points, stamp, frame)
        self.write(topic, now, self.store.serialize_cdr(message, CLOUD))

    def copy(self, source: Connection, now: int, data: bytes) -> None:
        """Append a message of another bag as it is, on its topic and with its QoS."""
        self._is_used = True
        key = source.topic, source.msgtype
        if key not in self._copied:
            self._copied[key] = self._writer.add_connection(
                *key,
                typestore=self.store,
                offered_qos_profiles=getattr(source.ext, "offered_qos_profiles", ()),
            )
        self._writer.write(self._copied[key], now, data)


def cloud_message(store: Typestore, points: NDArray[np.void], stamp: HostNs, frame: str) -> Any:
    """Return points as a PointCloud2.

    Parameters
    ----------
    store : Typestore
        Makes the message.
    points : ndarray
        Shape (N,) or (H, W), with fields x, y and z.
    stamp : HostNs
    frame : str
    """
    types: Any = store.types
    fields = [
        types["sensor_msgs/msg/PointField"](
            name=name,
            offset=offset,
            datatype=_DATATYPES[item.base.str[1:]],
            count=int(np.prod(item.shape)),
        )
        for name, (item, offset, *_) in (points.dtype.fields or {}).items()
    ]
    height, width = points.shape if points.ndim == 2 else (1, len(points))
    time = types["builtin_interfaces/msg/Time"](*split_stamp(stamp))
    return types[CLOUD](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id=frame),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=False,
        point_step=points.dtype.itemsize,
        row_step=points.dtype.itemsize * width,
        data=np.frombuffer(np.ascontiguousarray(points).tobytes(), np.uint8),
        is_dense=all(bool(np.isfinite(points[axis]).all()) for axis in "xyz"),
    )


class Messages:
    """Makes the messages that the driver's node would publish, as values of rosbags.

    Parameters
    ----------
    config : DriverConfig
        Frames, point layout and covariances.
    """

    def __init__(self, config: DriverConfig) -> None:
        self.store = get_typestore(Stores.ROS2_JAZZY)
        self._config = config
        topics = config.topics
        self._layout = LAYOUTS[topics.point_layout].with_rings(topics.ring_count)
        self._types: Any = self.store.types

    def transforms(self, now: HostNs) -> Any:
        """Return the static transform from cloud to IMU frame, as a TFMessage."""
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
        return types[TRANSFORMS](transforms=[transform])

    def cloud(self, sweep: Sweep) -> Any:
        """Return a sweep as a PointCloud2."""
        points = self._layout.convert(sweep.points, sweep.start)
        return cloud_message(self.store, points, sweep.start, self._config.frames.cloud)

    def imu(self, sample: ImuSample) -> Any:
        """Return a sample as an Imu."""
        w, x, y, z = sample.orientation_wxyz
        imu = self._config.imu
        vector = self._types["geometry_msgs/msg/Vector3"]
        return self._types[IMU](
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
        time = self._types["builtin_interfaces/msg/Time"](*split_stamp(stamp))
        return self._types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


class BagWriter:
    """A bag of clouds, IMU samples and the static transform; use it in a ``with``.

    Parameters
    ----------
    path : Path
    config : DriverConfig
        Topics, frames, point layout and covariances.
    keep_unfinished : bool
        See :class:`BagFile`.

    Attributes
    ----------
    clouds, samples : int
        What has been written.
    """

    def __init__(self, path: Path, config: DriverConfig, *, keep_unfinished: bool = False) -> None:
        self.clouds = 0
        self.samples = 0
        self._file = BagFile(path, keep_unfinished=keep_unfinished)
        self._config = config
        self._messages = Messages(config)

    @property
    def unfinished(self) -> Path | None:
        """Path of an unfinished bag; see :class:`BagFile`."""
        return self._file.unfinished

    def __enter__(self) -> BagWriter:
        """Make the file."""
        self._file.__enter__()
        topics = self._config.topics
        reliable = topics.qos_reliability == "reliable"
        for topic, kind, depth in (
            (topics.point_cloud_topic_id, CLOUD, 10),
            (topics.imu_topic_id, IMU, 1000),
        ):
            self._file.connect(topic, kind, depth, reliable, latched=False)
        if self._config.frames.publish_tf:
            self._file.connect("/tf_static", TRANSFORMS, 1, reliable=True, latched=True)
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
            self._write(topic, CLOUD, event.end, self._messages.cloud(event))
            self.clouds += 1
        elif isinstance(event, ImuSample):
            self._begin(event.stamp)
            topic = self._config.topics.imu_topic_id
            self._write(topic, IMU, event.stamp, self._messages.imu(event))
            self.samples += 1

    def _begin(self, now: HostNs) -> None:
        """Write the static transform before everything else."""
        if not (self.clouds or self.samples) and self._config.frames.publish_tf:
            self._write("/tf_static", TRANSFORMS, now, self._messages.transforms(now))

    def _write(self, topic: str, kind: str, now: HostNs, message: Any) -> None:
        self._file.write(topic, now, self._messages.store.serialize_cdr(message, kind))


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
