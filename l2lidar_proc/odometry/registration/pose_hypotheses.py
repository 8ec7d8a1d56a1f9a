"""Pose hypotheses: poses at which most points of a sweep lie on surfaces of the map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, POSITION, ROTATION, InertialState
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.odometry.registration.correspondences import Source


def pose_hypotheses(
    state: InertialState, covariance: F64, source: Source, surfaces: SurfelMap, count: int = 3
) -> list[InertialState]:
    """Return states nearby at which most points lie on surfaces, best first.

    The position is searched on a grid; gyro and gravity keep the attitude good enough for tens of
    seconds. Where they were missing, pairs of attitude and position are drawn from the covariance.

    Parameters
    ----------
    state : InertialState
        Predicted.
    covariance : ndarray, shape (18, 18)
    source : Source
    surfaces : SurfelMap
    count : int
        Largest number of states to return.
    """
    errors = _grid(covariance)
    if rotation_is_loose(covariance):
        seed = abs(int(state.stamp))  # so that each sweep tries others
        errors = _drawn(covariance, np.zeros((1, ERRORS)), tuning.SEARCH_PLACES, seed)
        scores = _scores(state, errors, source, surfaces, tuning.SEARCH_POINTS // 2)
        likely = errors[np.argsort(-scores, kind="stable")[: tuning.SEARCH_REFINED]]
        errors = _drawn(
            covariance / tuning.SEARCH_FINER**2,
            likely,
            tuning.SEARCH_PLACES // tuning.SEARCH_REFINED,
            seed,
        )
    scores = _scores(state, errors, source, surfaces, tuning.SEARCH_POINTS)
    best = _distinct(errors, scores, 2.0 * tuning.SEARCH_STEP_M, count)
    return [state.boxplus(error) for error in best]


def level_hypotheses(
    state: InertialState, places: F64, source: Source, surfaces: SurfelMap
) -> list[InertialState]:
    """Return states on the same level at which more points lie on surfaces, best first.

    They are closer together than those of :func:`pose_hypotheses`, as only few of the points may
    lie on the surface that fixes the position.

    Parameters
    ----------
    state : InertialState
        With a gravity.
    places : ndarray, shape (3, 3)
        Covariance of its place, map axes [m^2].
    source : Source
    surfaces : SurfelMap
    """
    shifts = level_grid(places, level_basis(state.gravity))
    errors = np.zeros((len(shifts), ERRORS))
    errors[:, POSITION] = shifts
    scores = _scores(state, errors, source, surfaces, tuning.SEARCH_POINTS)
    least = tuning.RELOCALIZE_MATCHED * len(_some(source.points, tuning.SEARCH_POINTS))
    better = scores > max(scores[0], least)
    count, apart = tuning.RELOCALIZE_STARTS, tuning.RELOCALIZE_APART_M
    best = _distinct(errors[better], scores[better], apart, count)
    return [state.boxplus(error) for error in best]


def level_basis(gravity: F64) -> F64:
    """Return two level directions (3, 2), orthonormal, for a gravity (3,) that is not zero."""
    return np.asarray(np.linalg.svd(gravity[None])[2][1:].T)


def is_explained_by_drift(
    move: F64, places: F64, sigmas: float = tuning.RELOCALIZE_SIGMAS
) -> bool:
    """Return whether a move (3,) [m] is within so many sigma of a place (3, 3) [m^2], nearly."""
    covariance = places + tuning.RELOCALIZE_FLOOR_M**2 * np.eye(3)
    return float(move @ np.linalg.solve(covariance, move)) <= sigmas**2


def _distinct(errors: F64, scores: NDArray[np.int64], apart: float, count: int) -> list[F64]:
    """Return the errors (18,) of the highest scores, each so far from all others, best first."""
    best: list[F64] = []
    for index in np.argsort(-scores, kind="stable").tolist():
        if all(_apart(errors[index], other) > apart for other in best):
            best.append(errors[index])
        if len(best) == count:
            break
    return best


def _scores(
    state: InertialState, errors: F64, source: Source, surfaces: SurfelMap, count: int
) -> NDArray[np.int64]:
    """Return how many of some points lie on surfaces for each error (N, 18) of the state."""
    points = _some(source.points, count)
    turns = state.rotation @ rotations.matrices(rotations.exp(errors[:, ROTATION]))
    origins = state.position + errors[:, POSITION]
    seen = np.einsum("kij,nj->kni", turns, points)
    seen += origins[:, None]
    origins = np.repeat(origins, len(points), axis=0)
    found = surfaces.match(seen.reshape(-1, 3), origins=origins)
    near = np.abs(found.distances) < tuning.SEARCH_NEAR_M
    return np.bincount(found.index[near] // len(points), minlength=len(errors))


def _some(points: F64, count: int) -> F64:
    """Return every n-th of points (N, 3), so that at least ``count`` are left, or all."""
    return points[:: max(len(points) // count, 1)]


def rotation_is_loose(covariance: F64) -> bool:
    """Return whether the attitude is so uncertain that other attitudes have to be tried."""
    return bool(np.linalg.eigvalsh(covariance[ROTATION, ROTATION])[-1] > tuning.LOOSE_ROTATION**2)


def _apart(one: F64, other: F64) -> float:
    difference = one - other
    turn, way = np.linalg.norm(difference[ROTATION]), np.linalg.norm(difference[POSITION])
    return float(way + tuning.SEARCH_ARM_M * turn)


def _drawn(covariance: F64, middles: F64, count: int, seed: int) -> F64:
    """Return errors (N, 18) of turn and place, drawn from a covariance about each of some errors.

    Parameters
    ----------
    covariance : ndarray, shape (18, 18)
    middles : ndarray, shape (M, 18)
        Themselves the first of those drawn about them.
    count : int
        How many to draw about each.
    seed : int
    """
    both = slice(ROTATION.start, POSITION.stop)
    strength, axes = np.linalg.eigh(covariance[both, both])
    normal = np.random.default_rng(seed).standard_normal((len(middles), count, len(strength)))
    normal[:, 0] = 0.0
    errors = np.repeat(middles[:, None], count, axis=1)
    errors[..., both] += normal * np.sqrt(np.maximum(strength, 0.0)) @ axes.T
    errors[..., ROTATION] = np.clip(
        errors[..., ROTATION], -tuning.SEARCH_ROTATION, tuning.SEARCH_ROTATION
    )
    errors[..., POSITION] = np.clip(
        errors[..., POSITION], -tuning.SEARCH_RADIUS_M[1], tuning.SEARCH_RADIUS_M[1]
    )
    return np.asarray(errors.reshape(-1, ERRORS))


def _grid(covariance: F64) -> F64:
    """Return errors (N, 18) of the place that fill an ellipsoid of three sigma."""
    variances = np.maximum(np.diag(covariance)[POSITION], 0.0)
    radius = np.clip(3.0 * np.sqrt(variances), *tuning.SEARCH_RADIUS_M)
    volume = 4.0 / 3.0 * np.pi * float(radius.prod())
    step = max(tuning.SEARCH_STEP_M, (volume / tuning.SEARCH_PLACES) ** (1.0 / 3.0))
    axes = [step * np.arange(-np.ceil(r / step), np.ceil(r / step) + 1.0) for r in radius]
    offsets = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = offsets[((offsets / radius) ** 2).sum(axis=1) <= 1.0]
    errors = np.zeros((len(offsets), ERRORS))
    errors[:, POSITION] = offsets
    return errors


def level_grid(places: F64, basis: F64) -> F64:
    """Return shifts (N, 3) [m] that fill an ellipse of the uncertainty on a level, 0 first.

    Parameters
    ----------
    places : ndarray, shape (3, 3)
        [m^2]
    basis : ndarray, shape (3, 2)
        As :func:`level_basis` returns it.
    """
    strength, axes = np.linalg.eigh(basis.T @ places @ basis)
    radius = np.minimum(
        tuning.RELOCALIZE_SIGMAS * np.sqrt(np.maximum(strength, 0.0)), tuning.SEARCH_RADIUS_M[1]
    )
    area = np.pi * float(np.maximum(radius, tuning.RELOCALIZE_STEP_M).prod())
    step = max(tuning.RELOCALIZE_STEP_M, (area / tuning.RELOCALIZE_PLACES) ** 0.5)
    counts = np.floor(radius / step).astype(np.int64)
    steps = np.meshgrid(*(np.arange(-count, count + 1) for count in counts), indexing="ij")
    shifts = step * np.stack(steps, axis=-1).reshape(-1, 2)
    shifts = shifts[((shifts / np.maximum(radius, step)) ** 2).sum(axis=1) <= 1.0]
    shifts = shifts[np.argsort((shifts**2).sum(axis=1), kind="stable")]
    return np.asarray(shifts @ (basis @ axes).T)
