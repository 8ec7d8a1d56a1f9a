"""Holds what was received of a pair of topics, and gathers it from messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.check.measure import Contents, contents
from l2lidar_node.clouds.fields import Field, fields_of, points_of
from l2lidar_node.types import IMU_SAMPLE, HostNs

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
    """What clouds of one publisher have in common."""

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
    """What was received.

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
    is_levelled : bool or None
        The publisher's own word on ``imu_adjust``.
    """

    clouds: tuple[Cloud, ...] = ()
    imu: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, IMU_RECORD))
    imu_frames: tuple[str, ...] = ()
    transforms: frozenset[tuple[str, str]] = frozenset()
    cloud_qos: tuple[Qos, ...] = ()
    imu_qos: tuple[Qos, ...] = ()
    is_levelled: bool | None = None


class Gathering:
    """Gathers an observation message by message; keeps no points but a few of each cloud."""

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
        is_levelled: bool | None = None,
    ) -> Observation:
        """Return everything so far."""
        return Observation(
            clouds=tuple(self._clouds),
            imu=np.array(self._imu, IMU_RECORD),
            imu_frames=tuple(self._imu_frames),
            transforms=frozenset(self._transforms),
            cloud_qos=cloud_qos,
            imu_qos=imu_qos,
            is_levelled=is_levelled,
        )


def _stamp(message: Any) -> HostNs:
    stamp = message.header.stamp
    return HostNs(int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec))
