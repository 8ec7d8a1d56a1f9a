"""Bags as the drivers of other sensors record them, measured in the emulator's worlds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from l2lidar_node.clouds import DATATYPES
from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.motion.motion import Motion
from l2lidar_node.emulator.unit.inertial import ImuNoise, Inertial
from l2lidar_node.emulator.world import scenes
from l2lidar_node.emulator.world.world import World
from l2lidar_node.protocol import wire
from l2lidar_node.types import F64
from tests.support.other_sensors import SENSORS, RangeSensor, spinning

EPOCH: Final = 1_700_000_000_000_000_000
SECONDS: Final = 2.2
LIVOX: Final = "livox_ros_driver2/msg/CustomMsg"
_LIVOX_POINT: Final = """
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
_LIVOX_MESSAGE: Final = """
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
livox_ros_driver2/CustomPoint[] points
"""
SPINNING: Final = RangeSensor(
    "small", 0.1, spinning(np.deg2rad(np.arange(-16.0, 17.0, 2.5)), 400, 0.1),
    0.5, 60.0, 0.01, 0.0,
)  # fmt: skip

Cloud = NDArray[np.void]
Formatter = Callable[[Cloud, int], Cloud]


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Clouds with their stamps [ns], IMU samples (stamps, rates, forces), and the truth."""

    clouds: list[tuple[int, Cloud]]
    stamps: NDArray[np.int64]
    rates: F64
    forces: F64
    motion: Motion

    def truth(self, stamps: NDArray[np.int64]) -> F64:
        """Return true places (N, 3) of the sensor [m]."""
        return self.motion.poses(np.asarray((stamps - EPOCH) * 1e-9, np.float64))[0]


@lru_cache(maxsize=4)
def measured(name: str = "small", seconds: float = SECONDS, rest_s: float = 0.6) -> Measured:
    """Return what a sensor measures on a walk through the room."""
    sensor = SPINNING if name == "small" else SENSORS[name]
    scene = scenes.make("room")
    world = World(scene.triangles, scene.reflectivity)
    motion = trajectories.make("walk", scene, rest_s=rest_s, seed=2)
    clouds = [
        (EPOCH + round(k * sensor.sweep_s * 1e9), sensor.measure(world, motion, k, seed=1))
        for k in range(int(seconds / sensor.sweep_s))
    ]
    noise = ImuNoise(gyro_line=0.0, gyro_noise=0.01, accel_noise=0.03)
    raw, times = Inertial(motion, noise, 1).samples(0, int((seconds + 0.1) * wire.IMU_RATE_HZ))
    stamps = EPOCH + np.round(times * 1e9).astype(np.int64)
    rates = raw["angular_velocity"].astype(np.float64)
    forces = raw["linear_acceleration"].astype(np.float64)
    return Measured(clouds, stamps, rates, forces, motion)


def velodyne(cloud: Cloud, stamp: int) -> Cloud:
    """``time`` float32 seconds before the stamp, which is that of the last point."""
    made = _xyz(cloud, [("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")])
    made["time"] = cloud["time"] - np.float32(0.1)
    return made


def ouster(cloud: Cloud, stamp: int) -> Cloud:
    """``t`` uint32 nanoseconds, with the fields that Ouster's driver adds."""
    more = [("intensity", "<f4"), ("t", "<u4"), ("reflectivity", "<u2"), ("ring", "u1")]
    made = _xyz(cloud, [*more, ("ambient", "<u2"), ("range", "<u4")])
    made["t"] = np.round(cloud["time"].astype(np.float64) * 1e9)
    return made


def hesai(cloud: Cloud, stamp: int) -> Cloud:
    """``timestamp`` float64 absolute seconds."""
    made = _xyz(cloud, [("intensity", "<f4"), ("ring", "<u2"), ("timestamp", "<f8")])
    made["timestamp"] = stamp * 1e-9 + cloud["time"].astype(np.float64)
    return made


def livox(cloud: Cloud, stamp: int) -> Cloud:
    """``timestamp`` float64 absolute nanoseconds, as Livox's driver makes PointCloud2."""
    more = [("intensity", "<f4"), ("tag", "u1"), ("line", "u1"), ("timestamp", "<f8")]
    made = _xyz(cloud, more)
    made["timestamp"] = float(stamp) + cloud["time"].astype(np.float64) * 1e9
    return made


def offset_time(cloud: Cloud, stamp: int) -> Cloud:
    """``offset_time`` uint32 nanoseconds, as converters of Livox's own messages name it."""
    made = _xyz(cloud, [("offset_time", "<u4"), ("line", "u1")])
    made["offset_time"] = np.round(cloud["time"].astype(np.float64) * 1e9)
    return made


def autoware(cloud: Cloud, stamp: int) -> Cloud:
    """``time_stamp`` uint32 nanoseconds, as Autoware's drivers name it."""
    made = _xyz(cloud, [("intensity", "u1"), ("time_stamp", "<u4")])
    made["time_stamp"] = np.round(cloud["time"].astype(np.float64) * 1e9)
    return made


def depth(cloud: Cloud, stamp: int) -> Cloud:
    """No time at all, as depth cameras have it; some points are not finite."""
    made = _xyz(cloud, [("rgb", "<f4")])
    made["x"][::17] = np.nan
    return made


FORMATS: Final[dict[str, Formatter]] = {
    "velodyne": velodyne,
    "ouster": ouster,
    "hesai": hesai,
    "livox": livox,
    "offset_time": offset_time,
    "autoware": autoware,
}


def images(given: Measured) -> list[tuple[int, Cloud]]:
    """Return every third image of a depth camera's sweeps, as a cloud of its own."""
    out = []
    for stamp, cloud in given.clouds:
        times = np.unique(cloud["time"])
        for time in times[::3].tolist():
            out.append((stamp + round(time * 1e9), cloud[cloud["time"] == np.float32(time)]))
    return out


class BagMaker:
    """Writes a bag; use it in a ``with``.

    Parameters
    ----------
    path : Path
    compression : str
        rosbag2's mode: FILE, MESSAGE or STORAGE; empty for none.
    """

    def __init__(self, path: Path, compression: str = "") -> None:
        self.store = get_typestore(Stores.ROS2_JAZZY)
        self.store.register(
            {
                **get_types_from_msg(_LIVOX_POINT, "livox_ros_driver2/msg/CustomPoint"),
                **get_types_from_msg(_LIVOX_MESSAGE, LIVOX),
            }
        )
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        if compression:
            self._writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> BagMaker:
        self._writer.open()
        return self

    def __exit__(self, *error: object) -> None:
        self._writer.close()

    def header(self, stamp: int, frame: str) -> Any:
        seconds, rest = divmod(int(stamp), 10**9)
        types = self.store.types
        time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
        return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)

    def announce(self, topic: str, kind: str) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self.store
            )

    def write(self, topic: str, kind: str, message: Any, stamp: int) -> None:
        self.announce(topic, kind)
        self.raw(topic, self.store.serialize_cdr(message, kind), stamp)

    def raw(self, topic: str, data: bytes | memoryview, stamp: int) -> None:
        self._writer.write(self._connections[topic], int(stamp), data)

    def imu(
        self, topic: str, stamp: int, frame: str, rate: F64, force: F64, now: int | None = None
    ) -> None:
        types = self.store.types
        vector = types["geometry_msgs/msg/Vector3"]
        unknown = np.array([-1.0, *[0.0] * 8])
        message = types["sensor_msgs/msg/Imu"](
            header=self.header(stamp, frame),
            orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=0.0),
            orientation_covariance=unknown,
            angular_velocity=vector(*rate.tolist()),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=vector(*force.tolist()),
            linear_acceleration_covariance=np.zeros(9),
        )
        self.write(topic, "sensor_msgs/msg/Imu", message, stamp if now is None else now)

    def cloud(self, topic: str, stamp: int, frame: str, points: Cloud, now: int) -> None:
        types, layout = self.store.types, points.dtype
        numbers = {code: number for number, code in DATATYPES.items()}
        assert layout.fields is not None
        message = types["sensor_msgs/msg/PointCloud2"](
            header=self.header(stamp, frame),
            height=1,
            width=len(points),
            fields=[
                types["sensor_msgs/msg/PointField"](
                    name=name, offset=place[1], datatype=numbers[place[0].str[1:]], count=1
                )
                for name, place in layout.fields.items()
            ],
            is_bigendian=False,
            point_step=layout.itemsize,
            row_step=layout.itemsize * len(points),
            data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=False,
        )
        self.write(topic, "sensor_msgs/msg/PointCloud2", message, now)

    def livox(self, topic: str, stamp: int, frame: str, points: Cloud, now: int) -> None:
        types = self.store.types
        point = types["livox_ros_driver2/msg/CustomPoint"]
        offsets = np.round(points["time"].astype(np.float64) * 1e9).astype(np.int64).tolist()
        message = types[LIVOX](
            header=self.header(stamp, frame),
            timebase=123_456_789_012,
            point_num=len(points),
            lidar_id=1,
            rsvd=np.zeros(3, np.uint8),
            points=[
                point(offset_time=t, x=x, y=y, z=z, reflectivity=50, tag=16, line=2)
                for t, x, y, z in zip(
                    offsets,
                    *(points[axis].tolist() for axis in "xyz"),
                    strict=True,
                )
            ],
        )
        self.write(topic, LIVOX, message, now)


def write_bag(
    path: Path,
    given: Measured,
    put: Callable[[BagMaker, int, Cloud], None],
    *,
    clouds: list[tuple[int, Cloud]] | None = None,
    imu: Callable[[F64], F64] | None = lambda force: force,
    gyro: Callable[[F64], F64] = lambda rate: rate,
    imu_topic: str = "/imu/data",
    imu_frame: str = "imu",
) -> None:
    """Write clouds and IMU samples in the order of their time.

    Parameters
    ----------
    path : Path
    given : Measured
    put : callable
        Writes one cloud.
    clouds : list, optional
        In place of those of ``given``.
    imu : callable, optional
        What becomes of the accelerometer's samples; None: no IMU at all.
    gyro : callable
        What becomes of the gyro's samples.
    imu_topic, imu_frame : str
    """
    with BagMaker(path) as bag:
        for stamp, cloud in _in_order(given, given.clouds if clouds is None else clouds):
            if cloud is not None:
                put(bag, stamp, cloud)
            elif imu is not None:
                k = int(np.searchsorted(given.stamps, stamp))
                force = imu(given.forces[k])
                bag.imu(imu_topic, stamp, imu_frame, gyro(given.rates[k]), force)


def _in_order(
    given: Measured, clouds: list[tuple[int, Cloud]]
) -> Iterator[tuple[int, Cloud | None]]:
    """Yield clouds when they are whole, and the stamps of samples (without a cloud)."""
    events: list[tuple[int, int, int, Cloud | None]] = [
        (stamp, 0, stamp, None) for stamp in given.stamps.tolist()
    ]
    for stamp, cloud in clouds:
        end = stamp + round(float(cloud["time"][-1] - cloud["time"][0]) * 1e9)
        events.append((end, 1, stamp, cloud))
    for _, _, stamp, given_cloud in sorted(events, key=lambda event: event[:2]):
        yield stamp, given_cloud


def _xyz(cloud: Cloud, more: list[tuple[str, str]]) -> Cloud:
    kinds: list[Any] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *more]
    made = np.zeros(len(cloud), kinds)
    for axis in "xyz":
        made[axis] = cloud[axis]
    return made
