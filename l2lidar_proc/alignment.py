"""Aligns a sweep with the map of surfaces: iterated update of the inertial filter, point to plane.

The residual of a point y (deskewed to the reference, IMU axes) measured dt after the reference is
``n . (R y + p - m)``. It also depends on what deskewed the point, velocity, gravity and biases,
linearly in dt: so a sweep corrects the motion within itself as well as its place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc import rotations
from l2lidar_proc.inertial_filter import (
    ACCEL_BIAS,
    ERRORS,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    TURN,
    VELOCITY,
    InertialState,
    corrected,
)
from l2lidar_proc.odometry_config import SurfaceConfig
from l2lidar_proc.surfels import SurfelMap

F64 = NDArray[np.float64]

_FIRST_REACH_M = 0.5  # farthest point from its plane in the first step; each step halves it
_LAST_REACH_SCALES = 3.0  # down to this many outlier scales
_DONE = 2e-4  # a step below this, in radians and metres, is the last
_FAR_NOISE = 0.00056  # range noise grows as this times range^1.25, measured on a real unit


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """The points to align.

    Attributes
    ----------
    points : ndarray, shape (N, 3)
        Deskewed to the reference, from the IMU's origin, cloud axes [m].
    since : ndarray, shape (N,)
        Instant of each point after the reference [s], negative before it.
    ranges : ndarray, shape (N,)
        [m]
    """

    points: F64
    since: F64
    ranges: F64


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """What an alignment found.

    Attributes
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    information : ndarray, shape (18, 18)
        What the points alone say, at the last step.
    matched : int
        Points that took part in the last step.
    agreement : float
        Share of the points at known surfaces that are near them, 0 to 1: unknown surroundings do
        not lower it, a wrong pose does.
    residual : float
        Weighted root mean square of their distances [m].
    steps : int
    """

    state: InertialState
    covariance: F64
    information: F64
    matched: int
    agreement: float
    residual: float
    steps: int


def align(
    prior: InertialState,
    covariance: F64,
    source: Source,
    surfaces: SurfelMap,
    config: SurfaceConfig,
    least: int,
    start: InertialState | None = None,
) -> Alignment | None:
    """Return the posterior of a sweep, None where fewer than ``least`` points meet a surface.

    Parameters
    ----------
    prior : InertialState
        At the reference; it also deskewed the source.
    covariance : ndarray, shape (18, 18)
        Of the prior.
    source : Source
    surfaces : SurfelMap
    config : SurfaceConfig
    least : int
    start : InertialState, optional
        Where to begin instead of the prior.
    """
    state = prior if start is None else start
    noise2 = config.point_noise**2 + (2.0 * _FAR_NOISE * source.ranges**1.25) ** 2
    result = None
    for step in range(config.iterations):
        error = state.minus(prior)
        points = _redone(source, error, prior.rotation)
        places = points @ state.rotation.T + state.position
        found = surfaces.match(places)
        reach = max(_FIRST_REACH_M * 0.5**step, _LAST_REACH_SCALES * config.outlier_scale)
        near = np.abs(found.distances) < reach
        if np.count_nonzero(near) < least:
            return result
        index, normals, distances = found.index[near], found.normals[near], found.distances[near]
        weights = _trust(distances, config.outlier_scale) / (noise2[index] + found.variances[near])
        h = _derivatives(points[index], source.since[index], normals, state.rotation)
        weighted = h * weights[:, None]
        information = weighted.T @ h
        state, posterior = corrected(
            prior, covariance, state, information, -(weighted.T @ distances)
        )
        residual = float(np.sqrt((weights * distances**2).sum() / weights.sum()))
        agreement = np.count_nonzero(np.abs(distances) < 2.0 * config.outlier_scale) / len(near)
        result = Alignment(
            state, posterior, information, len(index), agreement, residual, step + 1
        )
        change = state.minus(prior) - error
        if np.abs(change[:6]).max() < _DONE:
            break
    return result


def _redone(source: Source, error: F64, rotation: F64) -> F64:
    """Return the points (N, 3) as a corrected motion deskews them, to first order."""
    since = source.since[:, None]
    turned = rotations.cross(-error[GYRO_BIAS] * since, source.points)
    moved = since * error[VELOCITY] + 0.5 * since**2 * error[GRAVITY]
    return np.asarray(
        source.points + turned + moved @ rotation - 0.5 * since**2 * error[ACCEL_BIAS]
    )


def _trust(distances: F64, scale: float) -> F64:
    """Return the weights (N,) of Geman and McClure: 1 for no distance, a quarter at the scale."""
    return np.asarray(1.0 / (1.0 + (distances / scale) ** 2) ** 2)


def _derivatives(points: F64, since: F64, normals: F64, rotation: F64) -> F64:
    """Return the derivatives of the residuals by the errors, shape (N, 18)."""
    dt = since[:, None]
    inner = normals @ rotation
    h = np.empty((len(points), ERRORS))
    h[:, TURN] = rotations.cross(points, inner)
    h[:, POSITION] = normals
    h[:, VELOCITY] = dt * normals
    h[:, GYRO_BIAS] = -dt * h[:, TURN]
    h[:, ACCEL_BIAS] = -0.5 * dt * dt * inner
    h[:, GRAVITY] = 0.5 * dt * dt * normals
    return h
