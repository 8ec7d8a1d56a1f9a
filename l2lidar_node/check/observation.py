"""Observation of a cloud topic and an IMU topic, with bounded memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.clouds import Field, fields_of, points_of
from l2lidar_node.types import F64, IMU_SAMPLE, HostNs

COLUMNS: Final = 1800
"""``Horizon_SCAN`` of our configuration for LIO-SAM: 0.2 degrees each."""


def kept_share(ring: NDArray[np.int64], x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Return the share of points, 0 to 1, that are the first of their cell.

    Parameters
    ----------
    ring : ndarray, shape (N,), int64
        Row of each point.
    x, y : ndarray, shape (N,)
        Finite [m].
    """
    if not len(ring):
        return 1.0
    degrees = np.degrees(np.arctan2(x, y))
    column = COLUMNS // 2 - np.round((degrees - 90.0) / (360.0 / COLUMNS)).astype(np.int64)
    column %= COLUMNS
    return len(np.unique(ring * COLUMNS + column)) / len(ring)


TIME_FIELDS: Final = ("t", "time", "timestamp", "time_stamp", "stamps")
"""Names that some consumer takes for a time."""

_SAMPLE: Final = 400


class Times(NamedTuple):
    """The values of a time field, in its own unit.

    Attributes
    ----------
    first, last : float
        Of the points in their order; of the finite ones.
    least, greatest : float
    descents : int
        Points whose time is below the one before.
    invalid : int
        Points whose time is not finite.
    """

    first: float
    last: float
    least: float
    greatest: float
    descents: int
    invalid: int


class Rings(NamedTuple):
    """The values of the ring field.

    Attributes
    ----------
    least, greatest : int
    kept : float
        Share of the points that LIO-SAM's projection keeps if it has enough rings.
    """

    least: int
    greatest: int
    kept: float


@dataclass(frozen=True, slots=True, eq=False)
class Contents:
    """What is in a cloud.

    Attributes
    ----------
    count : int
        Points.
    nonfinite : int
        Points whose x, y or z is NaN or infinite.
    at_origin : int
        Points whose x, y and z are 0.
    times : mapping
        By name of the field.
    rings : Rings or None
    sample : ndarray, shape (K, 3), float32
        Some of the finite points [m].
    """

    count: int
    nonfinite: int
    at_origin: int
    times: Mapping[str, Times]
    rings: Rings | None
    sample: NDArray[np.float32]


def contents(points: NDArray[np.void]) -> Contents:
    """Return the contents of a cloud.

    Parameters
    ----------
    points : ndarray, shape (N,)
        Structured, of any fields.
    """
    xyz = [_column(points, axis) for axis in "xyz"]
    known = [axis for axis in xyz if axis is not None]
    with np.errstate(all="ignore"):
        finite = np.ones(len(points), np.bool_)
        for axis in known:
            finite &= np.isfinite(axis)
        at_origin = 0
        sample = np.zeros((0, 3), np.float32)
        if len(known) == 3:
            positions = np.stack(known, axis=1)
            at_origin = int((positions == 0).all(axis=1).sum())
            usable = positions[finite]
            sample = usable[:: max(len(usable) // _SAMPLE, 1)].astype(np.float32)
        times = {}
        for name in TIME_FIELDS:
            values = _column(points, name)
            if values is not None and len(values):
                times[name] = _times(values)
        ring = _column(points, "ring")
        rings = None
        if ring is not None and len(known) == 3 and finite.any():
            rings = _rings(ring[finite], positions[finite])
    return Contents(len(points), int(len(points) - finite.sum()), at_origin, times, rings, sample)


def _column(points: NDArray[np.void], name: str) -> F64 | None:
    """Return a field's values, None if there is no such field of plain numbers."""
    if name not in (points.dtype.names or ()) or points.dtype[name].shape:
        return None
    with np.errstate(invalid="ignore"):  # of a signalling NaN
        return np.asarray(points[name], np.float64)


def _times(values: F64) -> Times:
    finite = values[np.isfinite(values)]
    invalid = len(values) - len(finite)
    if not len(finite):
        return Times(0.0, 0.0, 0.0, 0.0, 0, invalid)
    return Times(
        float(finite[0]),
        float(finite[-1]),
        float(finite.min()),
        float(finite.max()),
        int((finite[1:] < finite[:-1]).sum()),
        invalid,
    )


def _rings(ring: F64, positions: F64) -> Rings:
    rows = np.clip(np.nan_to_num(ring, nan=-1.0), -(2**31), 2**31).astype(np.int64)
    return Rings(
        int(rows.min()),
        int(rows.max()),
        kept_share(rows, positions[:, 0], positions[:, 1]),
    )


IMU_RECORD: Final = np.dtype(
    [
        *IMU_SAMPLE.descr,
        ("arrival", "<i8"),  # [ns] host clock
        ("orientation_covariance", "<f8", (9,)),
        ("angular_velocity_covariance", "<f8", (9,)),
        ("linear_acceleration_covariance", "<f8", (9,)),
    ]
)
"""One IMU message: the sample, when it came, and its covariances."""


class Qos(NamedTuple):
    """QoS that a publisher offers.

    Attributes
    ----------
    reliability : str
        ``reliable``, ``best_effort`` or ``unknown``.
    depth : int
        Length of its queue; 0 where that is not known, as DDS does not tell it.
    """

    reliability: str
    depth: int = 0


class Format(NamedTuple):
    """Properties common to the clouds of one publisher."""

    fields: tuple[Field, ...]
    point_step: int
    is_bigendian: bool


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """One cloud.

    Attributes
    ----------
    stamp, arrival : HostNs
    frame : str
    format : Format
    width, height, row_step : int
    is_dense : bool
    contents : Contents or None
        What is in it; None if it cannot be read.
    fault : str
        Why it cannot be read.
    """

    stamp: HostNs
    arrival: HostNs
    frame: str
    format: Format
    width: int
    height: int
    row_step: int
    is_dense: bool
    contents: Contents | None
    fault: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Everything received.

    Attributes
    ----------
    clouds : tuple of Cloud
        In the order they came.
    imu : ndarray, shape (M,), dtype IMU_RECORD
        In the order they came.
    imu_frames : tuple of str
        Frames of the IMU messages.
    transforms : frozenset of (str, str)
        Parent and child of each transform.
    cloud_qos, imu_qos : tuple of Qos
        Of the publishers; empty where they are not known.
    is_leveled : bool or None
        The publisher's own word on ``imu_adjust``.
    """

    clouds: tuple[Cloud, ...] = ()
    imu: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, IMU_RECORD))
    imu_frames: tuple[str, ...] = ()
    transforms: frozenset[tuple[str, str]] = frozenset()
    cloud_qos: tuple[Qos, ...] = ()
    imu_qos: tuple[Qos, ...] = ()
    is_leveled: bool | None = None


class Gathering:
    """Gathers an observation message by message; keeps only a few points of each cloud."""

    def __init__(self) -> None:
        self._clouds: list[Cloud] = []
        self._formats: dict[Format, Format] = {}
        self._imu: list[tuple[Any, ...]] = []
        self._imu_frames: dict[str, None] = {}
        self._transforms: set[tuple[str, str]] = set()

    @property
    def counts(self) -> Mapping[str, int]:
        """How many of each kind there are."""
        return {"clouds": len(self._clouds), "IMU samples": len(self._imu)}

    def cloud(self, message: Any, arrival: int) -> None:
        """Take a PointCloud2 that came at ``arrival`` [ns]."""
        form = Format(fields_of(message), int(message.point_step), bool(message.is_bigendian))
        form = self._formats.setdefault(form, form)
        inside, fault = None, ""
        try:
            inside = contents(points_of(message))
        except ValueError as error:
            fault = str(error)
        self._clouds.append(
            Cloud(
                stamp=_stamp(message),
                arrival=HostNs(arrival),
                frame=str(message.header.frame_id),
                format=form,
                width=int(message.width),
                height=int(message.height),
                row_step=int(message.row_step),
                is_dense=bool(message.is_dense),
                contents=inside,
                fault=fault,
            )
        )

    def imu(self, message: Any, arrival: int) -> None:
        """Take an Imu that came at ``arrival`` [ns]."""
        q, rate, force = (
            message.orientation,
            message.angular_velocity,
            message.linear_acceleration,
        )
        self._imu_frames[str(message.header.frame_id)] = None
        self._imu.append(
            (
                _stamp(message),
                (q.w, q.x, q.y, q.z),
                (rate.x, rate.y, rate.z),
                (force.x, force.y, force.z),
                arrival,
                message.orientation_covariance,
                message.angular_velocity_covariance,
                message.linear_acceleration_covariance,
            )
        )

    def transforms(self, message: Any) -> None:
        """Take a TFMessage."""
        for item in message.transforms:
            self._transforms.add((str(item.header.frame_id), str(item.child_frame_id)))

    def observation(
        self,
        cloud_qos: tuple[Qos, ...] = (),
        imu_qos: tuple[Qos, ...] = (),
        is_leveled: bool | None = None,
    ) -> Observation:
        """Return everything so far."""
        return Observation(
            clouds=tuple(self._clouds),
            imu=np.array(self._imu, IMU_RECORD),
            imu_frames=tuple(self._imu_frames),
            transforms=frozenset(self._transforms),
            cloud_qos=cloud_qos,
            imu_qos=imu_qos,
            is_leveled=is_leveled,
        )


def _stamp(message: Any) -> HostNs:
    stamp = message.header.stamp
    return HostNs(int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec))


CLOUD: Final = "sensor_msgs/msg/PointCloud2"
IMU: Final = "sensor_msgs/msg/Imu"
TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"


class SourceError(ValueError):
    """The source does not have what was asked for; the message says why."""


class Topics(NamedTuple):
    """Topics of the clouds and of the IMU samples; empty for the only one of its kind."""

    cloud: str = ""
    imu: str = ""


def choose(kinds: Mapping[str, str], asked: Topics, needs_imu: bool) -> Topics:
    """Return the topics to be judged.

    Parameters
    ----------
    kinds : mapping
        Types of all topics by name.
    asked : Topics
    needs_imu : bool
        Whether it matters which IMU topic is taken; else none is taken among several.

    Raises
    ------
    SourceError
        If a topic that was asked for is not there or of another type, if there is no cloud, or
        if several topics may be meant.
    """
    cloud = _choose(kinds, CLOUD, asked.cloud, "--cloud")
    if not cloud:
        there = ", ".join(sorted(kinds)) or "none at all"
        raise SourceError(f"there is no topic of type {CLOUD}; topics are: {there}")
    several = sum(kind == IMU for kind in kinds.values()) > 1
    if several and not asked.imu and not needs_imu:
        return Topics(cloud)
    return Topics(cloud, _choose(kinds, IMU, asked.imu, "--imu"))


def _choose(kinds: Mapping[str, str], kind: str, asked: str, option: str) -> str:
    """Return the topic of a type, empty if there is none."""
    found = sorted(topic for topic, its_kind in kinds.items() if its_kind == kind)
    if asked:
        if asked in found:
            return asked
        if asked in kinds:
            raise SourceError(f"topic '{asked}' is of type {kinds[asked]}, expected {kind}")
        there = ", ".join(found) or "none"
        raise SourceError(f"there is no topic '{asked}'; topics of type {kind} are: {there}")
    if len(found) > 1:
        raise SourceError(
            f"several topics are of type {kind}; select one with {option}: " + ", ".join(found)
        )
    return found[0] if found else ""
