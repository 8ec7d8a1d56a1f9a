"""Interface of an odometry, with or without an IMU, and the order of the sweeps it takes."""

from __future__ import annotations

from enum import Enum
from typing import Protocol

from l2lidar_node.types import F64, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import OdometryEstimate


class Phase(Enum):
    """State of an odometry."""

    INITIALIZING = "initializing"  # the first sweeps are held until the map can begin
    TRACKING = "tracking"  # each sweep is predicted and aligned with the map
    STATIONARY = "stationary"  # the sensor is at rest: the pose is held, each sweep tests it
    LOST = "lost"  # a new map has begun at the predicted pose and no sweep has met it yet


class SweepOrder(Enum):
    """How a sweep lies in time relative to the one before."""

    FOLLOWS = "later"
    LATE = "late or repeated"  # it is refused
    OTHER_TIME_LINE = "far back or far ahead"  # the clock was set


def sweep_order(step_ns: int) -> SweepOrder:
    """Return how a sweep lies in time relative to the one before.

    Parameters
    ----------
    step_ns : int
        From the sweep before to this one [ns].
    """
    if -tuning.LONG_GAP_NS < step_ns <= 0:
        return SweepOrder.LATE
    if 0 < step_ns <= tuning.TIME_JUMP_NS:
        return SweepOrder.FOLLOWS
    return SweepOrder.OTHER_TIME_LINE


class SweepOdometry(Protocol):
    """An odometry that registers one sweep after the other.

    Attributes
    ----------
    T_cloud_imu : ndarray, shape (4, 4)
        IMU coordinates to cloud coordinates; the identity where no IMU is used.
    phase : Phase
    motion : SweepMotion or None
        Of the sweep that was registered last; None before the first, and where no IMU is used.
    """

    T_cloud_imu: F64
    phase: Phase
    motion: SweepMotion | None

    def configure(self, config: OdometryConfig) -> None:
        """Take new live settings."""

    def reset(self) -> None:
        """Forget map and motion; the next sweep begins a new map."""

    def imu(self, samples: Samples) -> None:
        """Take IMU samples (N,), dtype IMU_SAMPLE, in any order and state."""

    def register(self, sweep: Sweep, *, may_skip: bool = False) -> list[OdometryEstimate]:
        """Return where the sensor was at the references of sweeps, oldest first.

        Parameters
        ----------
        sweep : Sweep
        may_skip : bool
            There is no time to align it: it may be predicted instead.
        """

    def extrapolated(self, stamp: HostNs) -> OdometryEstimate | None:
        """Return the continuation of the latest estimate to an instant, None if there is none."""

    @property
    def newest_imu(self) -> HostNs | None:
        """Stamp of the newest IMU sample; None before the first, and where no IMU is used."""

    def map_points(self) -> F64:
        """Return the points of the local map [m], shape (N, 3), map frame."""
