"""KISS-ICP as it is, at the limits of its range."""

from __future__ import annotations

import numpy as np

from l2lidar_proc.config import OdometryConfig
from l2lidar_proc.odometry.plain import PlainOdometry
from tests.l2lidar_proc.odometry.odometry_world import recording
from tests.support.odometry_runs import sweeps


def test_points_that_its_deskew_moves_across_the_limit_are_left_out() -> None:
    # in motion, and with walls on both sides of the limit
    odometry = PlainOdometry(OdometryConfig(mode="plain", max_range=4.0))
    fewer = 0
    for sweep in sweeps(recording("room", "walk"), "turn"):
        (found,) = odometry.register(sweep)
        xyz = np.stack([sweep.points[axis] for axis in "xyz"], axis=1).astype(np.float64)
        ranges = np.linalg.norm(xyz, axis=1)
        inside = np.count_nonzero((ranges >= odometry.config.min_range) & (ranges <= 4.0))
        assert len(found.points) <= inside
        fewer += int(len(found.points) < inside)
        out = np.stack([found.points[axis] for axis in "xyz"], axis=1).astype(np.float64)
        assert np.linalg.norm(out, axis=1).max() < 4.001
    assert fewer > 5
