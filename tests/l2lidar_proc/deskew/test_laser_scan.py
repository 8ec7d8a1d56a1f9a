"""Scans against geometry: a room of vertical walls, a sensor that walks, turns and nods."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from l2lidar_node import rotations
from l2lidar_node.settings import SettingError
from l2lidar_node.types import F64, POINT
from l2lidar_proc.deskew.config import ScanConfig
from l2lidar_proc.deskew.laser_scan import ScanBuilder, level_rotation, slice_of
from l2lidar_proc.motion.config import MotionConfig
from l2lidar_proc.motion.tracker import MotionTracker
from tests.l2lidar_proc.motion.analytic import T_CLOUD_IMU, Motion, at

HALF = np.array([6.0, 4.0])  # of the room [m]
WALK = Motion(turn=1.0, nod=0.1, speed=0.5)


def to_wall(origin: F64, angles: F64) -> F64:
    """Return the distance from a place in the room to its walls, by direction [m]."""
    way = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    with np.errstate(divide="ignore"):
        steps = np.where(way > 0, (HALF - origin) / way, (-HALF - origin) / way)
    return np.asarray(steps.min(axis=-1))


def pose(seconds: float) -> F64:
    """Return cloud coordinates to the room's, (4, 4)."""
    moment = np.array([seconds])
    made = np.eye(4)
    made[:3, :3] = WALK.rotation(moment).as_matrix()[0]
    made[:3, 3] = WALK.position(moment)[0]
    return made


def sweep(seconds: float, columns: int, seed: int) -> np.ndarray:
    """Return what a sensor sees of the walls from where it is, in columns of 200 points."""
    rng = np.random.default_rng(seed)
    T_world_cloud = pose(seconds)
    angles = np.repeat(rng.uniform(-np.pi, np.pi, columns), 200)
    distance = to_wall(T_world_cloud[:2, 3], angles)
    places = np.stack(
        (
            T_world_cloud[0, 3] + distance * np.cos(angles),
            T_world_cloud[1, 3] + distance * np.sin(angles),
            rng.uniform(-1.0, 4.0, len(angles)),
        ),
        axis=-1,
    )
    local = (places - T_world_cloud[:3, 3]) @ T_world_cloud[:3, :3]
    points = np.zeros(len(local), POINT)
    points["x"], points["y"], points["z"] = local.T
    points["intensity"] = 7.0
    return points


def test_every_range_is_the_way_to_the_wall_however_the_sensor_tilts() -> None:
    """Within what the wall changes over one step of the angle, and 2 cm for the rounding."""
    config = ScanConfig(sweeps=4)
    builder = ScanBuilder(config)
    seen = []
    for number, seconds in enumerate(np.arange(1.0, 3.0, 0.23)):
        T_world_cloud = pose(seconds)
        T_scan_cloud = np.eye(4)
        T_scan_cloud[:3, :3] = level_rotation(T_world_cloud[2, :3])
        before = rotations.inverse(T_world_cloud) @ pose(seconds - 0.23) if number else None
        scan = builder.add(sweep(seconds, 100, number), T_scan_cloud, before)
        turn = T_world_cloud @ rotations.inverse(T_scan_cloud)
        assert turn[2, :3] == pytest.approx([0, 0, 1], abs=1e-9)
        yaw = np.arctan2(turn[1, 0], turn[0, 0])
        step = scan.angle_increment
        angles = scan.angle_min + step * np.arange(len(scan.ranges)) + yaw
        fine = to_wall(T_world_cloud[:2, 3], angles[:, None] + np.linspace(-0.5, 0.5, 21) * step)
        there = np.isfinite(scan.ranges)
        assert (scan.ranges[there] > fine.min(axis=1)[there] - 0.02).all()
        assert (scan.ranges[there] < fine.max(axis=1)[there] + 0.02).all()
        assert (scan.intensities[there] == 7.0).all()
        assert (scan.intensities[~there] == 0.0).all()
        seen.append(there.mean())
    assert len(scan.ranges) == 360
    # of 360 directions 100 random ones are seen at a time: 1 - exp(-100/360), then of four sweeps
    assert seen[0] == pytest.approx(0.243, abs=0.04)
    assert seen[-1] == pytest.approx(0.671, abs=0.06)


def test_the_nearest_in_heights_and_ranges_counts_and_edges_wrap() -> None:
    config = ScanConfig(angle_increment=np.pi / 2, height_min=-0.1, height_max=0.2, range_max=9.0)
    xyz = np.array(
        [
            [3.0, 0.0, 0.0], [2.0, 0.1, 0.1], [1.0, 0.0, 0.5], [1.5, 0.0, -0.2],
            [-4.0, 0.01, 0.0], [-3.5, -0.01, 0.0], [0.0, 9.5, 0.0], [0.0, -0.05, 0.0],
            [np.nan, 0.0, 0.0], [1.0, np.inf, 0.0],
        ]
    )  # fmt: skip
    scan = slice_of(xyz, np.arange(10, dtype=np.float32), config)
    assert scan.angle_min == -np.pi
    assert scan.ranges == pytest.approx([3.5, np.inf, np.hypot(2.0, 0.1), np.inf], abs=1e-4)
    assert scan.intensities.tolist() == [5.0, 0.0, 1.0, 0.0]
    nothing = slice_of(np.zeros((0, 3)), np.zeros(0, np.float32), config)
    assert np.isinf(nothing.ranges).all()
    with pytest.raises(SettingError, match="scan_height_min"):
        ScanConfig(height_min=1.0, height_max=0.5)


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_a_level_frame_is_a_rotation_with_the_vertical_as_z(way: tuple[float, ...]) -> None:
    up = np.array(way) / np.linalg.norm(way)
    turn = level_rotation(up)
    assert turn @ up == pytest.approx([0, 0, 1], abs=1e-9)
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    heading = turn[:, 0] if abs(up[0]) < 0.9 else turn[:, 2]
    assert heading[1] == pytest.approx(0.0, abs=1e-9)  # x, or z of a sensor that looks ahead
    assert heading[0] > 0


def test_the_tracker_tells_the_vertical_and_the_motion_between_sweeps() -> None:
    tracker = MotionTracker(MotionConfig(), T_CLOUD_IMU)
    assert tracker.up(at(0.0)) is None
    assert tracker.motion(at(0.0), at(0.2)) is None
    samples = WALK.imu(0.0, 4.0)
    for first in range(0, len(samples), 5):
        tracker.imu(samples[first : first + 5])
        seconds = first / 250.0
        if first % 50 == 0:
            velocity = WALK.velocity(np.array([seconds]))[0]
            tracker.velocity(at(seconds), velocity, "odometry")
    for seconds in np.arange(2.0, 3.8, 0.17):
        up = tracker.up(at(seconds))
        assert up is not None
        assert np.degrees(np.arccos(up @ pose(seconds)[2, :3])) < 1.0
    found = tracker.motion(at(3.6), at(3.83))
    expected = rotations.inverse(pose(3.83)) @ pose(3.6)
    assert found == pytest.approx(expected, abs=0.01)
    assert tracker.motion(at(3.6), at(3.6)) is None
    assert tracker.motion(at(3.6), at(9.6)) is None
