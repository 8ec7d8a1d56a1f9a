"""Runs unmodified KISS-ICP, without IMU: its own deskew and prediction, for comparison."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import AlignmentQuality, OdometryEstimate, Status
from l2lidar_proc.odometry.kiss import LEAST_POINTS, PlainKiss

F64 = NDArray[np.float64]

_UNKNOWN = 1.0  # KISS-ICP gives no covariance: a metre and a radian


class PlainOdometry:
    """KISS-ICP with the interface of :class:`l2lidar_proc.odometry.odometry.Odometry`.

    Parameters
    ----------
    config : OdometryConfig
    """

    def __init__(self, config: OdometryConfig) -> None:
        self.config = config
        self.reset()

    def configure(self, config: OdometryConfig) -> None:
        """Take new settings; they come into force with :meth:`reset`."""
        self.config = config

    def reset(self) -> None:
        """Start again at the origin."""
        self._kiss = PlainKiss(self.config)
        self._last: OdometryEstimate | None = None

    def imu(self, samples: Samples) -> None:
        """Take IMU samples and ignore them."""

    def register(self, sweep: Sweep) -> list[OdometryEstimate]:
        """Return the pose of the sweep's last point, as KISS-ICP registers it.

        A sweep that is late by less than a second is refused. Further back, or far ahead, the
        clock was set: the map is kept, the velocity is unknown.
        """
        points = sweep.points
        xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float64)
        times = points["time"].astype(np.float64)
        finite = np.isfinite(xyz).all(axis=1) & np.isfinite(times)
        points, xyz, times = points[finite], xyz[finite], times[finite]
        ranges = np.linalg.norm(xyz, axis=1)
        inside = (ranges >= self.config.min_range) & (ranges <= self.config.max_range)
        few = np.count_nonzero(inside) < LEAST_POINTS
        last = float(times.max()) if len(times) else (sweep.end - sweep.start) * 1e-9
        stamp = HostNs(sweep.start + round(last * 1e9))
        status: tuple[Status, ...] = ()
        if self._last is not None:
            step = stamp - self._last.stamp
            if -tuning.LONG_GAP_NS < step <= 0:
                refused = (Status.REFUSED,)
                return [dataclasses.replace(self._last, points=points[:0], status=refused)]
            if not 0 < step <= tuning.TIME_JUMP_NS:
                self._last = None
                status = (Status.RESTARTED,)
        if not few:
            # KISS-ICP takes equal times of all points inside its limits for a reason to abort
            spread = np.ptp(times[inside]) > 0.0
            frame = self._kiss.register(xyz[inside], times[inside] if spread else times[:0])
            points = points[inside].copy()
            if len(frame) != len(points):
                # its deskew moved some across its range limits; it does not tell which
                points = np.zeros(len(frame), points.dtype)
            for axis, column in zip("xyz", frame.T, strict=True):
                points[axis] = column
        if few:
            status += (Status.PREDICTED, Status.SPARSE)
        self._last = self._estimate(stamp, points, status, int(inside.sum()))
        return [self._last]

    def map_points(self) -> F64:
        """Return the map's points [m], shape (N, 3)."""
        return self._kiss.points()

    def _estimate(
        self, stamp: HostNs, points: NDArray[np.void], status: tuple[Status, ...], count: int
    ) -> OdometryEstimate:
        pose = self._kiss.pose
        velocity, rate = np.zeros(3), np.zeros(3)
        if self._last is not None:
            dt = (stamp - self._last.stamp) * 1e-9
            moved = np.linalg.inv(self._last.T_map_lidar) @ pose
            velocity = moved[:3, :3].T @ moved[:3, 3] / dt
            rate = rotations.log(rotations.from_matrix(moved[:3, :3])) / dt
        return OdometryEstimate(
            stamp=stamp,
            T_map_lidar=pose.copy(),
            covariance=_UNKNOWN * np.eye(6),
            velocity=velocity,
            angular_velocity=rate,
            twist_covariance=_UNKNOWN * np.eye(6),
            points=points,
            status=status,
            quality=AlignmentQuality(points=count),
            gyro_bias=np.zeros(3),
            accel_bias=np.zeros(3),
            gravity=np.zeros(3),
        )
