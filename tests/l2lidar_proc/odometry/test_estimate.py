"""Pose and twist of a frame fixed to the sensor, with their covariances."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_node.types import F64, POINT, HostNs
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.sweep_motion import SweepMotion, predict_sweep
from l2lidar_proc.odometry.estimate import (
    AlignmentQuality,
    BaseFrame,
    OdometryEstimate,
    estimate_of,
)
from l2lidar_proc.odometry.uncertainty import FrameJump, MapDrift
from tests.l2lidar_proc.motion.analytic import Motion, at

ARM = np.array([0.4, -0.3, 0.2])
MOUNT = rotations.transform(rotations.exp((0.2, -0.4, 1.1)), ARM)
STEP = 1e-6


def estimate(pose: F64, velocity: F64, rate: F64, covariance: F64, twist: F64) -> OdometryEstimate:
    nothing = np.zeros(3)
    return OdometryEstimate(
        HostNs(0), pose, covariance, velocity, rate, twist, np.zeros(0, POINT), (),
        AlignmentQuality(), nothing, nothing, nothing,
    )  # fmt: skip


def some_covariance(seed: int) -> F64:
    root = np.random.default_rng(seed).normal(0.0, 0.1, (6, 6))
    return np.asarray(root @ root.T)


POSE = rotations.transform(rotations.exp((0.1, 0.3, -0.7)), (2.0, -1.0, 0.5))
VELOCITY, RATE = np.array([0.7, -0.2, 0.1]), np.array([0.3, -0.6, 1.2])


def test_the_twist_is_that_of_the_displaced_frame() -> None:
    """Against the motion of a rigid body over a short time."""
    found = BaseFrame(MOUNT).motion(estimate(POSE, VELOCITY, RATE, np.eye(6), np.eye(6)))
    h = 1e-6
    lidar = np.eye(4)
    lidar[:3, :3] = rotations.matrices(rotations.exp(h * RATE))
    lidar[:3, 3] = h * VELOCITY
    moved = rotations.inverse(MOUNT) @ lidar @ MOUNT
    np.testing.assert_allclose(found.velocity, moved[:3, 3] / h, atol=1e-5)
    turn = rotations.log(rotations.from_matrix(moved[:3, :3])) / h
    np.testing.assert_allclose(found.angular_velocity, turn, atol=1e-5)


def test_the_covariance_of_the_twist_follows_its_derivatives() -> None:
    base, spread = BaseFrame(MOUNT), some_covariance(1)
    jacobian = np.empty((6, 6))
    here = base.motion(estimate(POSE, VELOCITY, RATE, np.eye(6), spread))
    for column in range(6):
        off = np.zeros(6)
        off[column] = STEP
        moved = base.motion(estimate(POSE, VELOCITY + off[:3], RATE + off[3:], np.eye(6), spread))
        change = np.concatenate(
            (moved.velocity - here.velocity, moved.angular_velocity - here.angular_velocity)
        )
        jacobian[:, column] = change / STEP
    expected = jacobian @ spread @ jacobian.T
    np.testing.assert_allclose(here.twist_covariance, expected, atol=1e-7)
    assert np.abs(expected[:3, 3:]).max() > 1e-3, "the arm couples velocity and rate"


def test_the_covariance_of_the_pose_follows_its_derivatives() -> None:
    """Errors are places and small turns about the axes of the fixed frame."""
    base, spread = BaseFrame(MOUNT), some_covariance(2)
    here = base.motion(estimate(POSE, VELOCITY, RATE, spread, np.eye(6)))
    jacobian = np.empty((6, 6))
    for column in range(6):
        off = np.zeros(6)
        off[column] = STEP
        pose = POSE.copy()
        pose[:3, :3] = rotations.matrices(rotations.exp(off[3:])) @ POSE[:3, :3]
        pose[:3, 3] += off[:3]
        moved = base.pose(pose)
        turn = rotations.log(rotations.from_matrix(moved[:3, :3] @ here.T_odom_base[:3, :3].T))
        step = moved[:3, 3] - here.T_odom_base[:3, 3]
        jacobian[:, column] = np.concatenate((step, turn)) / STEP
    np.testing.assert_allclose(here.covariance, jacobian @ spread @ jacobian.T, atol=1e-6)


LEVER = np.array([0.3, -0.2, 0.5])


def estimated(motion: SweepMotion, quality: AlignmentQuality | None = None) -> OdometryEstimate:
    """Return the estimate of a motion, without points, on a map without error."""
    return estimate_of(
        motion, LEVER, np.zeros(0, POINT), (), quality or AlignmentQuality(), 0.0, None,
        FrameJump(), MapDrift(),
    )  # fmt: skip


def test_the_covariances_of_an_estimate_follow_its_derivatives_by_the_state() -> None:
    """Pose and twist are the cloud frame's, the state is the IMU's."""
    turn = rotations.matrices(rotations.exp((0.3, -0.2, 0.9)))
    state = eskf.InertialState(
        at(1.0), turn, np.zeros(3), np.array([2.0, -1.0, 0.5]), np.full(3, 0.02), np.zeros(3),
        np.array([0.0, 0.0, -9.80665]),
    )  # fmt: skip
    root = np.random.default_rng(5).normal(0.0, 0.01, (eskf.ERRORS, eskf.ERRORS))
    motion = predict_sweep(
        state, root @ root.T, Motion().imu(0.9, 1.5), (at(1.0), at(1.0)), at(1.0),
        noise=eskf.Noise(0.0, 0.0, 0.0, 0.0), gap_ns=50_000_000, steady_rate=np.zeros(3),
        use_forces=True,
    )  # fmt: skip
    here = estimated(motion)
    jacobian = np.empty((12, eskf.ERRORS))
    for column in range(eskf.ERRORS):
        off = np.zeros(eskf.ERRORS)
        off[column] = STEP
        moved = estimated(motion.with_state(motion.state.boxplus(off), motion.covariance))
        turned = moved.T_map_lidar[:3, :3] @ here.T_map_lidar[:3, :3].T
        parts = (
            moved.T_map_lidar[:3, 3] - here.T_map_lidar[:3, 3],
            rotations.log(rotations.from_matrix(turned)),
            moved.velocity - here.velocity,
            moved.angular_velocity - here.angular_velocity,
        )
        jacobian[:, column] = np.concatenate(parts) / STEP
    both = jacobian @ motion.covariance @ jacobian.T
    pose = here.covariance - here.map_covariance(motion.state.position)
    twist = here.twist_covariance.copy()
    twist[:3, :3] -= np.outer(here.stamp_velocity_error, here.stamp_velocity_error)
    np.testing.assert_allclose(pose, both[:6, :6], atol=1e-8)
    np.testing.assert_allclose(twist, both[6:, 6:], atol=1e-8)
    bias = both[:6, :6] * 0.0
    bias[:, :3] = (jacobian @ motion.covariance)[:6, eskf.GYRO_BIAS]
    np.testing.assert_allclose(here.gyro_bias_covariance[:6], bias[:, :3], atol=1e-8)
    bent = estimated(motion, AlignmentQuality(attitude_variance=0.04)).covariance
    np.testing.assert_allclose(
        bent - here.covariance, 0.04 * np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]), atol=1e-12
    )


def test_the_first_pose_is_the_origin_with_yaw_zero() -> None:
    base = BaseFrame(np.eye(4))
    first = base.pose(POSE)
    assert first[:3, 3] == pytest.approx(0.0, abs=1e-12)
    assert np.arctan2(first[1, 0], first[0, 0]) == pytest.approx(0.0, abs=1e-12)


def test_base_frame_moves_with_the_arm() -> None:
    T_lidar_base = np.eye(4)
    T_lidar_base[:3, 3] = [-1.0, 0.0, 0.0]
    base = BaseFrame(T_lidar_base)
    np.testing.assert_allclose(base.pose(np.eye(4)), np.eye(4), atol=1e-12)
    turned = np.eye(4)
    turned[:3, :3] = rotations.matrices(rotations.exp((0.0, 0.0, np.pi / 2)))
    np.testing.assert_allclose(base.pose(turned)[:3, 3], [1.0, -1.0, 0.0], atol=1e-12)
