"""Tells from the first IMU samples how the sensor lies, whether it rests, and its biases."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs
from l2lidar_proc import rotations
from l2lidar_proc.motion.filter import (
    ACCEL_BIAS,
    ERRORS,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    TURN,
    VELOCITY,
    InertialState,
)
from l2lidar_proc.motion.imu_buffer import Samples

F64 = NDArray[np.float64]

STANDARD_GRAVITY: Final = 9.80665
TRUSTED_NORM: Final = (
    8.8,
    10.8,
)  # mean |a| [m/s^2] of a sound IMU; the known fault reads 16 to 21

_ACCEL_BIAS: Final = 0.15  # [m/s^2]
_BLOCKS: Final = 6
_LEAST: Final = 20
_STILL_RATE: Final = 0.12  # [rad/s] a larger mean rate is no bias
_STILL_CHANGE: Final = (
    0.06,
    0.25,
)  # [rad/s, m/s^2] by which means over a few samples may differ at rest
_STILL_NOISE: Final = 5.0  # sigma of their noise by which such means may differ besides


@dataclass(frozen=True, slots=True, eq=False)
class Opening:
    """What is known before the first sweep is placed.

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


def opening(samples: Samples, stamp: HostNs, may_rest: bool = True) -> Opening:
    """Return the state at the first reference: the map's origin, level if gravity is trusted.

    Parameters
    ----------
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        Of the last moments up to and around the first sweep, cloud axes; may be empty.
    stamp : HostNs
        The first reference.
    may_rest : bool
        False where the clouds have shown that the sensor moves, however quiet the IMU is.
    """
    force = samples["linear_acceleration"].mean(axis=0) if len(samples) else np.zeros(3)
    norm = float(np.linalg.norm(force))
    trusted = bool(TRUSTED_NORM[0] < norm < TRUSTED_NORM[1])
    at_rest = may_rest and _at_rest(samples)
    rotation = np.eye(3)
    if trusted:
        rotation = rotations.matrices(rotations.between(force, (0.0, 0.0, 1.0)))
    # at rest what the force has beyond gravity is bias; its direction cannot tell
    excess = force * (1.0 - STANDARD_GRAVITY / norm) if trusted and at_rest else np.zeros(3)
    state = InertialState(
        stamp,
        rotation,
        np.zeros(3),
        np.zeros(3),
        samples["angular_velocity"].mean(axis=0) if at_rest else np.zeros(3),
        excess,
        np.array([0.0, 0.0, -STANDARD_GRAVITY]) if trusted else np.zeros(3),
    )
    return Opening(state, _covariance(rotation, at_rest), at_rest, trusted)


def _covariance(rotation: F64, at_rest: bool) -> F64:
    """Return how well the first state is known, shape (18, 18)."""
    sigma = np.zeros(ERRORS)
    sigma[TURN] = sigma[POSITION] = 1e-4  # the first pose is the map's own frame
    sigma[VELOCITY] = 0.02 if at_rest else 1.0
    sigma[GYRO_BIAS] = 0.01 if at_rest else 0.05
    sigma[ACCEL_BIAS] = 0.02 if at_rest else _ACCEL_BIAS
    # in motion the mean force is off by the motion too; the size of gravity is known
    sigma[GRAVITY] = 0.01 if at_rest else (0.7, 0.7, 0.1)
    covariance = np.diag(sigma**2)
    if at_rest:
        # bias and tilt cannot be told apart, but together they are what was felt: so the one
        # that is wrong across gravity is wrong by as much as the other
        both = np.zeros((ERRORS, 2))
        both[GRAVITY] = np.eye(3)[:, :2]
        both[ACCEL_BIAS] = rotation.T[:, :2]
        covariance += _ACCEL_BIAS**2 * both @ both.T
    return covariance


def _at_rest(samples: Samples) -> bool:
    """Return whether means over parts of the samples agree as they do at rest."""
    if len(samples) < _LEAST:
        return False
    parts = np.array_split(samples, _BLOCKS)
    rates = np.array([part["angular_velocity"].mean(axis=0) for part in parts])
    forces = np.array([part["linear_acceleration"].mean(axis=0) for part in parts])
    # units differ tenfold in what their motors shake into the samples; means still differ by that
    noise = np.array(
        [white_noise(samples[name]) for name in ("angular_velocity", "linear_acceleration")]
    )
    allowed = np.hypot(
        (2.0 * _STILL_CHANGE[0], _STILL_CHANGE[1]),
        _STILL_NOISE * noise / np.sqrt(len(samples) / _BLOCKS),
    )
    return bool(
        np.abs(rates.mean(axis=0)).max() < _STILL_RATE
        and np.ptp(rates, axis=0).max() < allowed[0]
        and np.ptp(forces, axis=0).max() < allowed[1]
    )


def white_noise(values: F64) -> float:
    """Return the standard deviation of the white part of samples (N, 3), despite slow motion.

    From the second differences, whose variance is 1.5 times that of white noise; the median
    ignores shocks.
    """
    if len(values) < 8:
        return 0.0
    bend = np.abs(values[1:-1] - 0.5 * (values[:-2] + values[2:]))
    return float(np.median(bend, axis=0).max() * 1.4826 / np.sqrt(1.5))
