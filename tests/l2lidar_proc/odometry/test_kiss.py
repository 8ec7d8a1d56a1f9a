"""KISS-ICP: its thinning, and as it is, at the limits of its range."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from kiss_icp.voxelization import voxel_down_sample

from l2lidar_node.types import POINT, HostNs, Sweep
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import Status
from l2lidar_proc.odometry.kiss import PlainOdometry, thinned_indices
from tests.l2lidar_proc.motion.analytic import at
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


RNG_SEED = 4


def wall(x: float = 2.0) -> Any:
    """Return points on a wall across x, with 1 cm of noise."""
    rng = np.random.default_rng(RNG_SEED)
    points = rng.uniform((x, -1.0, 0.0), (x, 1.0, 2.0), (4000, 3))
    points[:, 0] += 0.01 * rng.standard_normal(len(points))
    return points


def test_thinning_keeps_one_point_per_voxel_and_says_which() -> None:
    points = wall()
    kept = thinned_indices(points, 0.5)
    assert len(set(kept.tolist())) == len(kept)
    cells = {tuple(cell) for cell in np.floor(points / 0.5).astype(int).tolist()}
    assert len(kept) == len(cells)


def test_thinning_keeps_the_points_that_kiss_icp_keeps() -> None:
    points = np.random.default_rng(RNG_SEED).uniform(-9.0, 9.0, (5000, 3))
    points = np.concatenate((points, points[::3] + 0.01))
    kept = points[thinned_indices(points, 0.4)]
    expected = np.asarray(voxel_down_sample(points, 0.4))
    assert {tuple(point) for point in kept.tolist()} == {tuple(p) for p in expected.tolist()}


def test_thinning_of_a_wall_at_one_x_names_every_point_it_keeps() -> None:
    rng = np.random.default_rng(RNG_SEED)
    points = rng.uniform((2.0, -3.0, 0.0), (2.0, 3.0, 3.0), (4000, 3))
    kept = thinned_indices(points, 0.2)
    cells = np.floor(points / 0.2).astype(int)
    assert len(kept) == len({tuple(cell) for cell in cells.tolist()})
    assert len({tuple(cell) for cell in cells[kept].tolist()}) == len(kept)


@pytest.mark.parametrize("count", [0, 1, 2, 11])
def test_plain_mode_survives_what_aborts_kiss_icp(count: int) -> None:
    """Without the guards the process ends here, and all tests with it."""
    run = recording("room", "still", 3.0)
    whole = next(iter(sweeps(run, "turn")))
    odometry = PlainOdometry(OdometryConfig(mode="plain"))
    odometry.register(whole)
    points = whole.points[:count].copy()
    points["time"] = 0.1
    later = Sweep(HostNs(whole.start + 10**9), HostNs(whole.end + 10**9), points, 0, 0)
    (estimate,) = odometry.register(later)
    assert (Status.SPARSE in estimate.status) == (count < 10)
    assert np.isfinite(estimate.T_map_lidar).all()


def test_plain_mode_leaves_out_points_with_their_times() -> None:
    points = np.zeros(100, POINT)
    points["x"], points["time"] = np.linspace(1, 5, 100), np.linspace(0, 0.2, 100)
    points["y"][::7] = np.nan
    odometry = PlainOdometry(OdometryConfig(mode="plain"))
    (estimate,) = odometry.register(Sweep(at(0), at(0.2), points, 0, 0))
    assert len(estimate.points) == np.isfinite(points["y"]).sum()
