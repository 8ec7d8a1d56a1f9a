"""KISS-ICP: its thinning, and as it is, at the limits of its range."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from kiss_icp.voxelization import voxel_down_sample

from l2lidar_node import rotations
from l2lidar_node.types import F64, POINT, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import Status
from l2lidar_proc.odometry.kiss import KissMatcher, PlainOdometry, thinned_indices
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


VOXEL = OdometryConfig().kiss.kiss_voxel_size
RANGE = OdometryConfig().max_range


def pose(way: float = 0.0, turn: float = 0.0) -> F64:
    """Return a pose (4, 4) on the x axis, turned about z."""
    found = np.eye(4)
    found[:3, :3] = rotations.matrices(rotations.exp((0.0, 0.0, turn)))
    found[0, 3] = way
    return found


def grown(*poses: F64, keyframes: bool = True) -> list[int]:
    """Return how many points the map has after a sweep of another wall at each pose."""
    matcher = KissMatcher(OdometryConfig())
    counts = []
    for number, here in enumerate(poses):
        matcher.update(wall(3.0 + 2.0 * number), here, here, keyframes=keyframes)
        counts.append(len(matcher.points()))
    return counts


@pytest.mark.parametrize(
    ("near", "far"),
    [
        (pose(0.9 * VOXEL), pose(1.1 * VOXEL)),
        (pose(-0.9 * VOXEL), pose(-1.1 * VOXEL)),
        (pose(0.0, 0.9 * tuning.KEYFRAME_TURN), pose(0.0, 1.1 * tuning.KEYFRAME_TURN)),
        (pose(0.0, -0.9 * tuning.KEYFRAME_TURN), pose(0.0, -1.1 * tuning.KEYFRAME_TURN)),
    ],
)
def test_a_sweep_is_a_keyframe_where_the_sensor_has_moved_or_turned(near: F64, far: F64) -> None:
    begun, unchanged, grown_at_last = grown(pose(), near, far)
    assert begun == unchanged
    assert grown_at_last > 1.5 * begun
    every = grown(pose(), near, far, keyframes=False)
    assert every[0] < every[1] < every[2]


def test_motion_counts_from_the_latest_keyframe() -> None:
    steps = [pose(0.6 * number * VOXEL) for number in range(5)]
    counts = grown(*steps)
    assert [after > before for before, after in itertools.pairwise(counts)] == [
        False,
        True,
        False,
        True,
    ]


def test_at_rest_every_fourth_sweep_is_a_keyframe() -> None:
    counts = grown(*[pose()] * 9)
    added = [after > before for before, after in itertools.pairwise(counts)]
    assert added == [False, False, False, True] * 2


def test_a_cleared_map_begins_with_the_next_sweep() -> None:
    matcher = KissMatcher(OdometryConfig())
    for _ in range(2):
        matcher.update(wall(), pose(), pose(), keyframes=True)
        assert len(matcher.points())
        matcher.clear()


def test_sweeps_between_keyframes_show_how_good_predictions_are() -> None:
    matcher = KissMatcher(OdometryConfig())
    matcher.update(wall(), pose(), pose(), keyframes=True)
    before = matcher.threshold
    matcher.update(wall(), pose(), pose(0.5), keyframes=True)
    assert matcher.threshold != before


def test_a_sweep_enters_the_map_where_its_pose_puts_it() -> None:
    matcher, here = KissMatcher(OdometryConfig()), pose(7.0, 0.5)
    points = wall()
    matcher.update(points, here, here, keyframes=True)
    placed = {tuple(p) for p in (points @ here[:3, :3].T + here[:3, 3]).round(9).tolist()}
    found = matcher.points()
    assert len(found) > 20
    assert {tuple(p) for p in found.round(9).tolist()} <= placed


def test_the_map_is_pruned_beyond_the_range() -> None:
    matcher = KissMatcher(OdometryConfig())
    reach = tuning.PRUNE_SHARE * RANGE
    for way in np.arange(0.0, RANGE + 2.0 * reach, 0.9 * reach):
        matcher.update(wall(), pose(way), pose(way), keyframes=True)
        farthest = way - matcher.points()[:, 0].min()
        assert farthest <= RANGE + reach
        assert way < RANGE or farthest > 0.8 * RANGE  # what is near enough stays
