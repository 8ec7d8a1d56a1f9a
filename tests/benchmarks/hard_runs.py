"""Runs of the odometry through hard scenarios."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks import bench_odometry_hard
from benchmarks.hard_recordings import Recording
from benchmarks.hard_scores import Track, score
from l2lidar_proc.motion.imu_buffer import replay
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import OdometryEstimate
from l2lidar_proc.odometry.odometry import Odometry


def tracked(some: Recording) -> Track:
    """Return what the odometry says of a recording."""
    track = bench_odometry_hard.track_of(bench_odometry_hard.OURS, some)
    assert track is not None
    return track


def scaled(some: Recording, factor: float) -> Recording:
    """Return a recording with all points moved by so little that only rounding differs."""
    points = some.points.copy()
    for axis in "xyz":
        points[axis] = (points[axis].astype(np.float64) * factor).astype(np.float32)
    return replace(some, points=points)


def estimates_of(some: Recording, odometry: Odometry | None = None) -> list[OdometryEstimate]:
    """Return all estimates of a recording, by a given odometry or a new one."""
    odometry = odometry or Odometry(OdometryConfig(), some.T_cloud_imu)
    estimates: list[OdometryEstimate] = []
    for sweep, samples in replay(some.sweeps(), some.imu):
        odometry.imu(samples)
        estimates += odometry.register(sweep)
    return estimates


def end_of(some: Recording) -> float:
    """Return how far off the odometry ends [m]."""
    return score(some, tracked(some))["end_m"]
