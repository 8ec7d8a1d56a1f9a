"""Range bias of an L2, estimated from its clouds while the odometry runs.

A constant added to all ranges moves a point along its ray. Where a wall is seen head-on it moves
by all of it, where it is seen at a grazing angle by nothing: a plane is bent. Registration follows
the bent planes, and 34 mm let the map of a room lean by 0.25 degrees. So the planes of single
sweeps are fitted with the bias as one more unknown. ``l2lidar calibrate still`` measures it once
and for all.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.fan_halves import cell_numbers
from l2lidar_proc.odometry.principal_axes import principal_axes, products


class RangeBias:
    """The estimate of one unit's range bias, and the correction of its clouds.

    Attributes
    ----------
    correction : float
        Added to ranges [m]; 0 as long as it is not known.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forget what was learned."""
        self.correction = 0.0
        self._information = 1.0 / tuning.RANGE_BIAS_SIGMA**2  # of the correction [1/m^2]
        self._weighted = 0.0  # by the estimate

    @property
    def sigma(self) -> float:
        """What the ranges of corrected clouds may be wrong by, 1 sigma [m].

        What the estimate says but is not sure enough of to correct it counts as well.
        """
        left = self._estimate - self.correction
        return float(np.sqrt(self._variance + left**2))

    def applied_to(self, points: NDArray[np.void]) -> None:
        """Correct the ranges of points (N,) in place."""
        if not self.correction:
            return
        at = _places(points)
        share = self.correction / np.maximum(np.linalg.norm(at, axis=0), self.correction)
        for name, line in zip("xyz", at, strict=True):
            points[name] = line + share * line

    def learn(self, *sweeps: NDArray[np.void], used: float = 0.0) -> None:
        """Take the planes of sweeps.

        Parameters
        ----------
        *sweeps : ndarray, shape (N,)
            Points of each, deskewed, with the right beam angles [m].
        used : float
            Correction of their ranges [m].
        """
        for points in sweeps:
            information, gradient = bend_of_planes(points)
            self._information += information
            self._weighted += gradient + information * used
        self.correction = self._known()

    @property
    def _estimate(self) -> float:
        return self._weighted / self._information

    @property
    def _variance(self) -> float:
        """Of the estimate [m^2]: no wall is quite flat, however often it is seen."""
        return 1.0 / self._information + tuning.RANGE_BIAS_FLOOR**2

    def _known(self) -> float:
        """Return the estimate if it is known, and differs from zero."""
        variance, bias = self._variance, self._estimate
        known = variance < tuning.RANGE_BIAS_KNOWN**2
        return bias if known and bias**2 > tuning.BEAM_SIGMAS**2 * variance else 0.0


class _Flat(NamedTuple):
    """Flat cells of a cloud.

    Attributes
    ----------
    places, normals : ndarray, shape (C, 3)
        Means of their points [m], and unit normals that point away from the sensor.
    counts : ndarray, shape (C,)
    """

    places: F64
    normals: F64
    counts: F64


def bend_of_planes(points: NDArray[np.void]) -> tuple[float, float]:
    """Return what planes tell about a correction of ranges.

    Parameters
    ----------
    points : ndarray, shape (N,)
        In the frame of the sensor [m].

    Returns
    -------
    information : float
        [1/m^2]; 0 where no plane tells anything.
    gradient : float
        The information, multiplied by the correction [1/m].
    """
    information = gradient = 0.0
    for places, along, normal in _planes(_flat_cells(_places(points))):
        # measured = plane - correction * cosine of the incidence
        sights = places / np.linalg.norm(places, axis=1)[:, None]
        middle = places.mean(axis=0)
        heights = (places - middle) @ normal
        design = np.column_stack(
            (np.ones(len(places)), (places - middle) @ along.T, -(sights @ normal))
        )
        prior = np.diag((0.0, 0.0, 0.0, 1.0 / tuning.RANGE_BIAS_SIGMA**2))
        fit = np.zeros(4)
        for number in range(tuning.RANGE_BIAS_STEPS):
            residual = heights - design @ fit if number else np.zeros(len(heights))
            weights = 1.0 / (1.0 + (residual / tuning.RANGE_BIAS_SCALE) ** 2) ** 2
            weighted = (design * (weights / tuning.RANGE_BIAS_CELL_SIGMA**2)[:, None]).T
            normal_matrix, right = weighted @ design, weighted @ heights
            fit = np.linalg.solve(normal_matrix + prior, right)
        # place and attitude of the plane are of no interest
        shared = np.linalg.solve(
            normal_matrix[:3, :3], np.column_stack((normal_matrix[:3, 3], right[:3]))
        )
        information += float(normal_matrix[3, 3] - normal_matrix[3, :3] @ shared[:, 0])
        gradient += float(right[3] - normal_matrix[3, :3] @ shared[:, 1])
    return information, gradient


def _planes(flat: _Flat) -> Iterator[tuple[F64, F64, F64]]:
    """Yield the larger planes: places (C, 3) of cells, axes (2, 3) along, the normal (3,).

    Each begins at the fullest cell that is left, and grows to the cells that lie on it.
    """
    left = np.ones(len(flat.counts), np.bool_)
    for _ in range(tuning.RANGE_BIAS_SEEDS):
        if np.count_nonzero(left) < tuning.RANGE_BIAS_CELLS:
            return
        seed = int(np.argmax(np.where(left, flat.counts, 0.0)))
        normal, middle = flat.normals[seed], flat.places[seed]
        along: F64 = np.zeros((2, 3))
        on = left
        for _ in range(tuning.RANGE_BIAS_STEPS):
            near = np.abs((flat.places - middle) @ normal) < tuning.RANGE_BIAS_BEND_MOST
            on = left & near & (flat.normals @ normal > tuning.RANGE_BIAS_FACING)
            if np.count_nonzero(on) < tuning.RANGE_BIAS_CELLS:
                break
            middle = np.average(flat.places[on], axis=0, weights=flat.counts[on])
            axes = np.linalg.eigh(np.cov(flat.places[on].T, aweights=flat.counts[on]))[1].T
            normal = axes[0] * np.sign(axes[0] @ normal)
            along = axes[1:]
        if np.count_nonzero(on) >= tuning.RANGE_BIAS_CELLS:
            yield flat.places[on], along, normal
            left &= ~on
        else:
            left[seed] = False


def _flat_cells(at: F64) -> _Flat:
    """Return the flat cells of points (3, N), without those that are too near to be right."""
    at = at[:, np.linalg.norm(at, axis=0) > tuning.RANGE_BIAS_NEAREST]
    cell = cell_numbers(at)
    counts = np.bincount(cell).astype(np.float64)
    means = np.stack([np.bincount(cell, line) for line in at]) / counts
    around = at - means[:, cell]
    spread, axes = principal_axes(
        np.stack([np.bincount(cell, line) / counts for line in products(*around)])
    )
    flat = counts >= tuning.BEAM_CELL_POINTS
    flat &= spread[:, 0] < tuning.BEAM_THICKNESS**2
    flat &= spread[:, 1] > (tuning.BEAM_WIDTH * tuning.BEAM_CELL) ** 2
    places, normals = means[:, flat].T, axes[flat, 0]
    outward = np.sign((normals * places).sum(axis=1))
    return _Flat(places, normals * outward[:, None], counts[flat])


def _places(points: NDArray[np.void]) -> F64:
    return np.stack([points[name].astype(np.float64) for name in "xyz"])
