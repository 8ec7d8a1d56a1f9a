"""Looks for the place where a sweep fits the map when the prediction is not good enough."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc.alignment import Source
from l2lidar_proc.inertial_filter import POSITION, InertialState
from l2lidar_proc.surfels import SurfelMap

F64 = NDArray[np.float64]

_STEP_M = 0.3  # between places that are tried
_NEAR_M = 0.15  # a point this near a surface speaks for a place
_RADIUS_M = (0.3, 4.0)  # least and most to search about the prediction
_MOST_PLACES = 1200
_POINTS = 200


def likely_places(
    state: InertialState, covariance: F64, source: Source, surfaces: SurfelMap, count: int = 3
) -> list[InertialState]:
    """Return states at the places nearby where most points lie on surfaces, best first.

    Only the place is searched: gyro and gravity keep the attitude good enough for tens of seconds.

    Parameters
    ----------
    state : InertialState
        Predicted.
    covariance : ndarray, shape (18, 18)
    source : Source
    surfaces : SurfelMap
    count : int
        Largest number of places to return.
    """
    sigma = np.sqrt(np.diag(covariance)[POSITION])
    places = state.position + _grid(np.clip(3.0 * sigma, *_RADIUS_M))
    stride = max(len(source.points) // _POINTS, 1)
    points = source.points[::stride] @ state.rotation.T
    found = surfaces.match((places[:, None] + points).reshape(-1, 3))
    near = np.abs(found.distances) < _NEAR_M
    scores = np.bincount(found.index[near] // len(points), minlength=len(places))
    best: list[F64] = []
    for index in np.argsort(-scores, kind="stable").tolist():
        if all(np.linalg.norm(places[index] - other) > 2.0 * _STEP_M for other in best):
            best.append(places[index])
        if len(best) == count:
            break
    return [dataclasses.replace(state, position=place) for place in best]


def _grid(radius: F64) -> F64:
    """Return offsets (N, 3) [m] that fill an ellipsoid of some half-axes (3,)."""
    volume = 4.0 / 3.0 * np.pi * float(radius.prod())
    step = max(_STEP_M, (volume / _MOST_PLACES) ** (1.0 / 3.0))
    axes = [step * np.arange(-np.ceil(r / step), np.ceil(r / step) + 1.0) for r in radius]
    offsets = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(offsets[((offsets / radius) ** 2).sum(axis=1) <= 1.0])
