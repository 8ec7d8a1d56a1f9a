"""KISS-ICP as it is, at the limits of its range."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from l2lidar_node.types import HostNs, Sweep
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import Status
from l2lidar_proc.odometry.kiss import PlainOdometry
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


@pytest.mark.parametrize("seconds", [3_600, 10**9, -3_600])
def test_one_cloud_of_another_time_costs_no_other(seconds: int) -> None:
    odometry = PlainOdometry(OdometryConfig(mode="plain"))
    found = []
    for number, sweep in enumerate(itertools.islice(sweeps(recording("room", "walk"), "turn"), 8)):
        by = seconds * 10**9 if number == 4 else 0
        moved = Sweep(HostNs(sweep.start + by), HostNs(sweep.end + by), sweep.points, 0, 0)
        found += odometry.register(moved)
    status = [item.status for item in found]
    assert status == [(), (), (), (), (Status.RESTARTED,), (Status.RESTARTED,), (), ()]
    assert all(np.linalg.norm(item.velocity) < 3.0 for item in found)
    again = odometry.register(moved)
    assert again[0].status == (Status.REFUSED,)
