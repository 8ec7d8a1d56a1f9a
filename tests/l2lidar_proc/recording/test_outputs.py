"""Trajectory files, and where the odometry frame begins."""

from __future__ import annotations

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.types import HostNs
from l2lidar_proc.recording.outputs import Trajectory, kitti, leveled_start, tum


def test_trajectory_files_keep_nanoseconds() -> None:
    pose = np.eye(4)
    pose[:3, 3] = [1.0, -2.0, 0.5]
    trajectory = Trajectory()
    for index in range(300):
        trajectory.append(HostNs(1_700_000_000_123_456_789 + index), pose)
    text = tum(trajectory.poses[:1])
    assert text.split() == [
        "1700000000.123456789", "1.000000000", "-2.000000000", "0.500000000",
        "0.000000000", "0.000000000", "0.000000000", "1.000000000",
    ]  # fmt: skip
    rows = np.array(kitti(trajectory.poses).split(), dtype=float)
    np.testing.assert_array_equal(rows.reshape(-1, 3, 4), np.tile(pose[:3], (300, 1, 1)))
    assert tum(trajectory.poses[-1:]).startswith("1700000000.123457088 ")


def test_a_trajectory_of_days_stays_bounded_and_keeps_its_latest_pose() -> None:
    trajectory = Trajectory(most=16)
    for index in range(1000):
        trajectory.append(HostNs(index), np.eye(4) * index)
        poses = trajectory.poses
        assert len(poses) <= 16
        assert poses["stamp"][-1] == index
        assert (np.diff(poses["stamp"]) > 0).all()
        np.testing.assert_array_equal(poses["pose"][:, 0, 0], poses["stamp"])
    assert len(poses) >= 8
    assert poses["stamp"][0] == 0
    assert np.diff(poses["stamp"])[:-1].max() <= 128


def test_the_start_keeps_roll_and_pitch_only() -> None:
    pose = np.eye(4)
    pose[:3, :3] = rotations.matrices(
        rotations.multiply(rotations.exp((0.0, 0.0, 1.0)), rotations.exp((0.1, 0.0, 0.0)))
    )
    pose[:3, 3] = [3.0, 2.0, 1.0]
    begun = leveled_start(pose) @ pose
    np.testing.assert_allclose(begun[:3, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(
        begun[:3, :3], rotations.matrices(rotations.exp((0.1, 0.0, 0.0))), atol=1e-12
    )
