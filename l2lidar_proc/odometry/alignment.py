"""Scan alignment: iterated update of the filter with point-to-plane residuals.

The residual of a point y (deskewed to the reference, IMU axes) measured dt after the reference is
``n . (R y + p - m)``. It also depends on what deskewed the point, velocity, gravity and biases,
linearly in dt: so a sweep corrects the motion within itself as well as its place.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc import rotations, tuning
from l2lidar_proc.config import SurfaceConfig
from l2lidar_proc.motion.filter import (
    ACCEL_BIAS,
    ERRORS,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    VELOCITY,
    InertialState,
    update_with_information,
)
from l2lidar_proc.odometry.surfel_map import SurfelMap

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """The points to align.

    Attributes
    ----------
    points : ndarray, shape (N, 3)
        Deskewed to the reference, from the IMU's origin, cloud axes [m].
    times : ndarray, shape (N,)
        Instant of each point after the reference [s], negative before it.
    ranges : ndarray, shape (N,)
        [m]
    """

    points: F64
    times: F64
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
    inlier_ratio : float
        Share of the points at known surfaces that are near them, 0 to 1: unknown surroundings do
        not lower it, a wrong pose does.
    residual : float
        Weighted root mean square of their distances [m].
    steps : int
    support : tuple of ndarray
        Numbers of the sweeps that opened the surfaces met, and the share of the weight of each.
    """

    state: InertialState
    covariance: F64
    information: F64
    matched: int
    inlier_ratio: float
    residual: float
    steps: int
    support: tuple[NDArray[np.int64], F64]


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
    far = tuning.RANGE_NOISE_FACTOR * tuning.RANGE_NOISE_SLOPE * source.ranges
    noise2 = config.point_noise**2 + far**2
    result = None
    for step in range(config.iterations):
        error = state.boxminus(prior)
        points = _deskewed_again(source, error, prior.rotation)
        places = points @ state.rotation.T + state.position
        found = surfaces.match(places, narrow=True)
        reach = max(
            tuning.FIRST_REACH_M * 0.5**step, tuning.LAST_REACH_SCALES * config.outlier_scale
        )
        spread = np.sqrt(config.outlier_scale**2 + found.scatter)
        near = np.abs(found.distances) < np.maximum(reach, tuning.LAST_REACH_SCALES * spread)
        if np.count_nonzero(near) < least:
            return result
        index, normals, distances = found.index[near], found.normals[near], found.distances[near]
        spread = spread[near]
        known2 = found.variances[near] + tuning.SCATTER_SHARED * found.scatter[near]
        weights = _robust_weights(distances, spread) / (noise2[index] + known2)
        h = residual_jacobian(points[index], source.times[index], normals, state.rotation)
        weighted = h * weights[:, None]
        information = weighted.T @ h
        some = np.flatnonzero(near)[:: tuning.TILT_SAMPLE]
        at = found.index[some]
        for axis in range(2):
            tilted = residual_jacobian(
                points[at], source.times[at], found.across[some, axis], state.rotation
            )
            tilts = tuning.TILT_SAMPLE * weights[:: tuning.TILT_SAMPLE] * found.tilts[some, axis]
            information -= (tilted * tilts[:, None]).T @ tilted
        state, posterior = update_with_information(
            prior, covariance, state, information, -(weighted.T @ distances)
        )
        residual = float(np.sqrt((weights * distances**2).sum() / weights.sum()))
        inlier_ratio = np.count_nonzero(np.abs(distances) < 2.0 * spread) / len(near)
        born, place = np.unique(found.born[near], return_inverse=True)
        support = born, np.bincount(place, weights) / weights.sum()
        result = Alignment(
            state, posterior, information, len(index), inlier_ratio, residual, step + 1, support
        )
        change = state.boxminus(prior) - error
        if np.abs(change[:6]).max() < tuning.CONVERGED:
            break
    return None if result is None else _limited_to_observed(result, covariance)


def _limited_to_observed(found: Alignment, before: F64) -> Alignment:
    """Return an alignment that claims less in directions for which only few points speak.

    The few that there are err together, and lie in parts of the map that were seen as seldom: what
    they agree on is hardly news. So in these directions the covariance stays near that of before.
    """
    strength, directions = np.linalg.eigh(found.information[POSITION, POSITION])
    share = strength / max(float(strength.sum()), 1e-12)
    doubt = (
        directions
        * np.sqrt(1.0 - np.clip(share / tuning.DEGENERATE_SHARE, 0.0, 1.0))
        @ directions.T
    )
    kept = np.zeros((ERRORS, ERRORS))
    kept[POSITION, POSITION] = kept[VELOCITY, VELOCITY] = kept[GRAVITY, GRAVITY] = doubt
    kept[ACCEL_BIAS, ACCEL_BIAS] = found.state.rotation.T @ doubt @ found.state.rotation
    covariance = found.covariance + kept @ (before - found.covariance) @ kept
    return dataclasses.replace(found, covariance=covariance)


def _deskewed_again(source: Source, error: F64, rotation: F64) -> F64:
    """Return the points (N, 3) as a corrected motion deskews them, to first order."""
    since = source.times[:, None]
    turned = rotations.cross(-error[GYRO_BIAS] * since, source.points)
    moved = since * error[VELOCITY] + 0.5 * since**2 * error[GRAVITY]
    return np.asarray(
        source.points + turned + moved @ rotation - 0.5 * since**2 * error[ACCEL_BIAS]
    )


def _robust_weights(distances: F64, scale: F64) -> F64:
    """Return the weights (N,) of Geman and McClure: 1 for no distance, a quarter at the scale."""
    return np.asarray(1.0 / (1.0 + (distances / scale) ** 2) ** 2)


def residual_jacobian(points: F64, since: F64, normals: F64, rotation: F64) -> F64:
    """Return the derivatives of the residuals by the errors, shape (N, 18)."""
    dt = since[:, None]
    inner = normals @ rotation
    h = np.empty((len(points), ERRORS))
    h[:, ROTATION] = rotations.cross(points, inner)
    h[:, POSITION] = normals
    h[:, VELOCITY] = dt * normals
    h[:, GYRO_BIAS] = -dt * h[:, ROTATION]
    h[:, ACCEL_BIAS] = -0.5 * dt * dt * inner
    h[:, GRAVITY] = 0.5 * dt * dt * normals
    return h
