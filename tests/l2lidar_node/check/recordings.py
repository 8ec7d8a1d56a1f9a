"""Recordings as the driver makes them, to be checked whole or damaged in one respect."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import interfaces
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from l2lidar_node import rotations
from l2lidar_node.check.observation import CLOUD, IMU, TRANSFORMS, Gathering, Observation, Qos
from l2lidar_node.check.requirements import CONSUMERS
from l2lidar_node.clouds import DATATYPES, LAYOUTS, RINGS, points_of as read_points
from l2lidar_node.types import Sweep
from tests.support import build

TYPES = get_typestore(Stores.ROS2_JAZZY)
T: Any = TYPES.types
NUMBERS = {code: number for number, code in DATATYPES.items()}

RELIABLE = ("fast_lio", "genz_icp", "dlio", "point_lio", "rtabmap", "autoware")
DURATION_S = 2.5
TILT = 0.4  # rad


@dataclass
class Recording:
    """Messages with the instants they came."""

    clouds: list[Any]
    cloud_arrivals: list[int]
    imu: list[Any]
    imu_arrivals: list[int]
    transforms: list[tuple[str, str]] = field(
        default_factory=lambda: [("l2lidar_link", "l2lidar_imu"), ("base_link", "l2lidar_link")]
    )
    reliability: str = "best_effort"
    imu_reliability: str = ""
    is_leveled: bool | None = None
    depth: int = 0

    def points(self, change: Callable[[np.ndarray], np.ndarray | None]) -> None:
        """Replace every cloud's points by what a function makes of them (None: in place)."""
        for at, message in enumerate(self.clouds):
            points = points_of(message).copy()
            changed = change(points)
            changed = points if changed is None else changed
            stamp, frame = stamp_of(message), message.header.frame_id
            self.clouds[at] = cloud(changed, stamp, frame)

    def observe(self) -> Observation:
        gathering = Gathering()
        for message, arrival in zip(self.clouds, self.cloud_arrivals, strict=True):
            gathering.cloud(message, arrival)
        for message, arrival in zip(self.imu, self.imu_arrivals, strict=True):
            gathering.imu(message, arrival)
        gathering.transforms(tf(self.transforms))
        return gathering.observation(
            (Qos(self.reliability, self.depth),),
            (Qos(self.imu_reliability or self.reliability, self.depth),),
            self.is_leveled,
        )

    def write(self, path: Path, storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
        """Write a rosbag2 folder with the publishers' QoS; return the path."""
        with Writer(path, version=9, storage_plugin=storage) as writer:
            qos = [bag_qos(self.reliability)]
            entries = []
            for topic, kind, items, arrivals in (
                ("/points", CLOUD, self.clouds, self.cloud_arrivals),
                ("/imu/data", IMU, self.imu, self.imu_arrivals),
                ("/tf_static", TRANSFORMS, [tf(self.transforms)], [self.cloud_arrivals[0]]),
            ):
                if not items:
                    continue
                connection = writer.add_connection(
                    topic, kind, typestore=TYPES, offered_qos_profiles=qos
                )
                entries += [
                    (at, connection, TYPES.serialize_cdr(item, kind))
                    for item, at in zip(items, arrivals, strict=True)
                ]
            for at, connection, data in sorted(entries, key=lambda entry: entry[0]):
                writer.write(connection, at, data)
        return path


@cache
def good(consumer: str) -> Recording:
    """Return what the driver publishes with our configuration for a consumer."""
    asked = CONSUMERS[consumer]
    layout = LAYOUTS[asked.inputs[0].layout].with_rings(asked.ring_count or RINGS)
    clouds, arrivals = [], []
    for sweep in sweeps():
        clouds.append(cloud(layout.convert(sweep.points, sweep.start), sweep.start))
        arrivals.append(sweep.end + 3_000_000)
    samples = imu_messages()
    reliability = "reliable" if consumer in RELIABLE else "best_effort"
    made = Recording(
        clouds,
        arrivals,
        samples,
        [stamp_of(item) + 500_000 for item in samples],
        reliability=reliability,
    )
    if asked.moves_cloud_frame:  # it is that frame's parent itself
        made.transforms = [pair for pair in made.transforms if pair[1] != "l2lidar_link"]
    return made


@cache
def sweeps() -> list[Sweep]:
    return build.sweeps(build.capture(DURATION_S), {"sweep_cut": "turn"})


@cache
def orientations() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times [s], orientations (N, 4) and rates (N, 3) of a tilted sensor that nods."""
    at = np.arange(round(DURATION_S * 250)) / 250
    angle = TILT + 0.15 * np.sin(5.0 * at)
    speed = 0.75 * np.cos(5.0 * at)
    zero = np.zeros_like(at)
    q = np.stack([np.cos(angle / 2), zero, np.sin(angle / 2), zero], axis=1)
    return at, q, np.stack([zero, speed, zero], axis=1)


def imu_messages() -> list[Any]:
    at, q, rates = orientations()
    up = rotations.rotate(q * [1.0, -1.0, -1.0, -1.0], np.tile([0.0, 0.0, 9.81], (len(at), 1)))
    return [
        imu(build.EPOCH_NS + round(at[i] * 1e9), q[i], rates[i], up[i]) for i in range(len(at))
    ]


def copied(recording: Recording) -> Recording:
    """Return a recording that can be changed without changing this one."""
    made = copy.copy(recording)
    made.clouds = [_copied(message, "header") for message in recording.clouds]
    for message in made.clouds:
        message.fields = [copy.copy(item) for item in message.fields]
    parts = ("header", "orientation", "angular_velocity", "linear_acceleration")
    made.imu = [_copied(message, *parts) for message in recording.imu]
    made.cloud_arrivals = list(recording.cloud_arrivals)
    made.imu_arrivals = list(recording.imu_arrivals)
    return made


def _copied(message: Any, *parts: str) -> Any:
    made = _twin(message)
    for name in parts:
        setattr(made, name, _twin(getattr(message, name)))
    return made


def _twin(item: Any) -> Any:
    """Return a shallow copy, faster than the library's."""
    made = object.__new__(type(item))
    made.__dict__.update(item.__dict__)
    return made


def header(stamp: int, frame: str) -> Any:
    time = T["builtin_interfaces/msg/Time"](*divmod(int(stamp), 1_000_000_000))
    return T["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)


def cloud(points: np.ndarray, stamp: int, frame: str = "l2lidar_link") -> Any:
    places = dict(points.dtype.fields or {})
    return T[CLOUD](
        header=header(stamp, frame),
        height=1,
        width=len(points),
        fields=[
            T["sensor_msgs/msg/PointField"](
                name, places[name][1], NUMBERS[places[name][0].base.str[1:]], 1
            )
            for name in points.dtype.names
        ],
        is_bigendian=False,
        point_step=points.dtype.itemsize,
        row_step=points.dtype.itemsize * len(points),
        data=np.frombuffer(np.ascontiguousarray(points).tobytes(), np.uint8),
        is_dense=True,
    )


def points_of(message: Any) -> np.ndarray:
    return read_points(message)


def imu(stamp: int, wxyz: Any, rate: Any, acceleration: Any, frame: str = "l2lidar_imu") -> Any:
    w, x, y, z = (float(value) for value in wxyz)
    vector = T["geometry_msgs/msg/Vector3"]
    return T[IMU](
        header=header(stamp, frame),
        orientation=T["geometry_msgs/msg/Quaternion"](x, y, z, w),
        orientation_covariance=np.diag([4.9e-9, 4.9e-9, 10.0]).reshape(9),
        angular_velocity=vector(*map(float, rate)),
        angular_velocity_covariance=np.diag([2.5e-5] * 3).reshape(9),
        linear_acceleration=vector(*map(float, acceleration)),
        linear_acceleration_covariance=np.diag([0.01] * 3).reshape(9),
    )


def tf(transforms: list[tuple[str, str]]) -> Any:
    vector = T["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    turn = T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    return T[TRANSFORMS](
        [
            T["geometry_msgs/msg/TransformStamped"](
                header(0, parent), child, T["geometry_msgs/msg/Transform"](vector, turn)
            )
            for parent, child in transforms
        ]
    )


def bag_qos(reliability: str) -> interfaces.Qos:
    never = interfaces.QosTime(0, 0)
    return interfaces.Qos(
        interfaces.QosHistory.UNKNOWN,
        0,
        interfaces.QosReliability[reliability.upper()],
        interfaces.QosDurability.VOLATILE,
        never,
        never,
        interfaces.QosLiveliness.AUTOMATIC,
        never,
        False,
    )
