"""Puts together what is reported of a sweep from its motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import GYRO_BIAS, POSITION, ROTATION, VELOCITY, InertialState
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.earlier_maps import FrameJump
from l2lidar_proc.odometry.estimate import AlignmentQuality, OdometryEstimate, Status
from l2lidar_proc.odometry.map_drift import MapDrift

F64 = NDArray[np.float64]


def cloud_pose(state: InertialState, lever: F64) -> F64:
    """Return the pose (4, 4) of the cloud frame, in which the IMU is at ``lever`` (3,) [m]."""
    pose = np.eye(4)
    pose[:3, :3] = state.rotation
    pose[:3, 3] = state.position - state.rotation @ lever
    return pose


def gaps_in(motion: SweepMotion) -> list[Status]:
    """Return what is to be said of the IMU samples of a motion."""
    if motion.imu.missing.all():
        return [Status.NO_IMU]
    return [Status.IMU_GAP] if motion.imu.missing.any() else []


def estimate_of(
    motion: SweepMotion,
    lever: F64,
    moved: NDArray[np.void],
    status: tuple[Status, ...],
    quality: AlignmentQuality,
    gyro_noise: float,
    jump: FrameJump,
    drift: MapDrift,
) -> OdometryEstimate:
    """Return the estimate that a motion amounts to.

    Parameters
    ----------
    motion : SweepMotion
    lever : ndarray, shape (3,)
        Place of the IMU in the cloud frame [m].
    moved : ndarray, shape (N,)
        The points it deskewed.
    status : tuple of Status
        DEGENERATE is added here.
    quality : AlignmentQuality
    gyro_noise : float
        Of an angular velocity [rad/s].
    jump : FrameJump
    drift : MapDrift
        What the map's own place, and its own error, add to the covariance.
    """
    state, p = motion.state, quality.excess * motion.covariance
    if quality.matched and quality.degeneracy_ratio < tuning.DEGENERATE_SHARE:
        status = (*status, Status.DEGENERATE)
    pose = np.zeros((6, 18))
    pose[:3, POSITION] = np.eye(3)
    pose[3:, ROTATION] = state.rotation
    twist = np.zeros((6, 18))
    twist[:3, VELOCITY] = state.rotation.T
    twist[3:, GYRO_BIAS] = np.eye(3)
    twist_covariance = twist @ p @ twist.T
    twist_covariance[3:, 3:] += gyro_noise**2 * np.eye(3)
    rate = motion.rate
    return OdometryEstimate(
        stamp=state.stamp,
        T_map_lidar=cloud_pose(state, lever),
        covariance=pose @ p @ pose.T + jump.at(state.position) + drift.at(state.position),
        velocity=state.rotation.T @ state.velocity - rotations.cross(rate, lever),
        angular_velocity=rate,
        twist_covariance=twist_covariance,
        points=moved,
        status=status,
        quality=quality,
        gyro_bias=state.gyro_bias,
        accel_bias=state.accel_bias,
        gravity=state.gravity,
    )
