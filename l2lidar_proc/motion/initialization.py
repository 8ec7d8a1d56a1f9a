"""Initialization: attitude, biases and gravity from the first IMU samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion import static
from l2lidar_proc.motion.filter import (
    ACCEL_BIAS,
    ERRORS,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    VELOCITY,
    InertialState,
)
from l2lidar_proc.motion.imu_buffer import Samples

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class InitialState:
    """State before anything but the IMU has been seen.

    Attributes
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    at_rest : bool
    gravity_trusted : bool
        False without samples and with an accelerometer whose norm is not that of gravity.
    """

    state: InertialState
    covariance: F64
    at_rest: bool
    gravity_trusted: bool


def initial_state(samples: Samples, stamp: HostNs, may_rest: bool = True) -> InitialState:
    """Return the state at the origin of a new map frame, level if gravity is trusted.

    Parameters
    ----------
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        Of the last moments up to and around the stamp, sensor axes; may be empty.
    stamp : HostNs
    may_rest : bool
        False where the sensor is known to move, however quiet the IMU is.
    """
    force = samples["linear_acceleration"].mean(axis=0) if len(samples) else np.zeros(3)
    norm = float(np.linalg.norm(force))
    trusted = static.gravity_is_plausible(samples, at_rest=True) or (
        not may_rest and static.gravity_is_plausible(samples, at_rest=False)
    )
    at_rest = may_rest and static.may_be_static(samples)
    rotation = np.eye(3)
    if trusted:
        rotation = rotations.matrices(rotations.between(force, (0.0, 0.0, 1.0)))
    # at rest the excess of the force over gravity is bias; its direction remains ambiguous
    g = tuning.STANDARD_GRAVITY
    excess = force * (1.0 - g / norm) if trusted and at_rest else np.zeros(3)
    state = InertialState(
        stamp,
        rotation,
        np.zeros(3),
        np.zeros(3),
        samples["angular_velocity"].mean(axis=0) if at_rest else np.zeros(3),
        excess,
        np.array([0.0, 0.0, -g]) if trusted else np.zeros(3),
    )
    return InitialState(state, _covariance(rotation, at_rest), at_rest, trusted)


def _covariance(rotation: F64, at_rest: bool) -> F64:
    """Return how well the first state is known, shape (18, 18)."""
    sigma = np.zeros(ERRORS)
    sigma[ROTATION] = sigma[POSITION] = tuning.START_POSE_SIGMA
    sigma[VELOCITY] = tuning.START_VELOCITY_SIGMA[not at_rest]
    sigma[GYRO_BIAS] = tuning.START_GYRO_BIAS_SIGMA[not at_rest]
    sigma[ACCEL_BIAS] = tuning.START_ACCEL_BIAS_SIGMA[not at_rest]
    # in motion the mean force is off by the motion too; the size of gravity is known
    sigma[GRAVITY] = tuning.START_GRAVITY_SIGMA[not at_rest]
    covariance = np.diag(sigma**2)
    if at_rest:
        # bias and tilt are not separable, but their sum is what was measured: so the one that is
        # wrong across gravity is wrong by as much as the other
        both = np.zeros((ERRORS, 2))
        both[GRAVITY] = np.eye(3)[:, :2]
        both[ACCEL_BIAS] = rotation.T[:, :2]
        covariance += tuning.ACCEL_BIAS_SIGMA**2 * both @ both.T
    return covariance
