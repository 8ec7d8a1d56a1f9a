"""Range bias of an L2, estimated from its clouds while the odometry runs.

A constant added to all ranges moves a point along its ray. Where a wall is seen head-on it moves
by all of it, where it is seen at a grazing angle by nothing: a plane is bent. Registration follows
the bent planes, and 34 mm let the map of a room lean by 0.25 degrees. So the planes of single
sweeps are fitted with the bias as one more unknown. Ground that is as uneven as a lawn or curved
as a road bends by itself, by what seems up to 0.1 m of bias, and is left out. Where nothing is
flat, as in a wood, the map shows the bias more slowly: ground that was first seen from afar, at a
grazing angle, comes to lie higher or lower when the sensor passes above it. ``l2lidar calibrate
still`` measures it once and for all.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.cloud import positions_by_axis
from l2lidar_proc.odometry.intrinsics.fan_halves import cell_numbers
from l2lidar_proc.odometry.local_map.principal_axes import principal_axes, products


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
        # of planes, then of the map: of the correction [1/m^2], and multiplied by the estimate
        self._information, self._weighted = 1.0 / tuning.RANGE_BIAS_SIGMA**2, 0.0
        self._map_information, self._map_weighted = 0.0, 0.0

    def sigma_with(self, correction: float) -> float:
        """Return the uncertainty of ranges that got a correction [m], 1 sigma [m].

        An estimate that is too uncertain to be used as a correction counts as an error.
        """
        left = self._estimate - correction
        return float(np.sqrt(self._variance + left**2))

    def correct(self, points: NDArray[np.void]) -> None:
        """Correct the ranges of points (N,) in place."""
        if not self.correction:
            return
        at = positions_by_axis(points)
        share = self.correction / np.maximum(np.linalg.norm(at, axis=0), self.correction)
        for name, line in zip("xyz", at, strict=True):
            points[name] = line + share * line

    def learn(
        self, *sweeps: NDArray[np.void], used: float = 0.0, rest_force: F64 | None = None
    ) -> None:
        """Take the planes of sweeps.

        Parameters
        ----------
        *sweeps : ndarray, shape (N,)
            Points of each, deskewed, with the right beam angles [m].
        used : float
            Correction of their ranges [m].
        rest_force : ndarray, shape (3,), optional
            As for :func:`bend_of_planes`.
        """
        for points in sweeps:
            information, gradient = bend_of_planes(points, rest_force)
            self._information += information
            self._weighted += gradient + information * used
        if not self.needs_map:
            self.correction = self._known()

    def learn_from_map(self, seen: SeenAgain) -> None:
        """Learn from the distances of a sweep's points to the map, if planes do not show the bias.

        The correction changes slowly: sweeps with another correction do not fit the map, and the
        pose would jump. The bias that is left bends the map, which hides part of it, so only the
        latest sweeps count.
        """
        if not self.needs_map:
            return
        information, gradient = bend_of_map(seen)
        kept, share = 1.0 - 1.0 / tuning.RANGE_BIAS_MAP_SWEEPS, tuning.RANGE_BIAS_MAP_SHARE
        self._map_information = kept * self._map_information + share * information
        self._map_weighted = kept * self._map_weighted + share * gradient
        step = tuning.RANGE_BIAS_STEP
        self.correction += float(np.clip(self._known() - self.correction, -step, step))

    @property
    def needs_map(self) -> bool:
        """Whether planes alone do not show the bias."""
        return self._of_planes >= tuning.RANGE_BIAS_KNOWN**2

    @property
    def _of_planes(self) -> float:
        """Variance of the estimate from planes alone [m^2]."""
        return 1.0 / self._information + tuning.RANGE_BIAS_FLOOR**2

    @property
    def _evidence(self) -> tuple[float, float]:
        """Information about the bias [1/m^2], and the same multiplied by the estimate [1/m]."""
        # however long a map is looked at, it is not better than that
        share = 1.0 / (1.0 + self._map_information * tuning.RANGE_BIAS_MAP_FLOOR**2)
        return (
            self._information + share * self._map_information,
            self._weighted + share * self._map_weighted,
        )

    @property
    def _estimate(self) -> float:
        information, weighted = self._evidence
        return weighted / information

    @property
    def _variance(self) -> float:
        """Variance of the estimate [m^2]; has a floor, as no wall is perfectly flat."""
        return 1.0 / self._evidence[0] + tuning.RANGE_BIAS_FLOOR**2

    def _known(self) -> float:
        """Return the estimate if it is certain and not zero, or if it was in use before; else 0.

        Where planes show it well, it is used in any case: hardly a unit has no bias at all.
        """
        variance, bias = self._variance, self._estimate
        if abs(bias) > tuning.RANGE_BIAS_MOST:
            return 0.0  # what seems so has another cause
        is_in_use = self._map_information > 0.0 and self.correction != 0.0
        is_known = variance < tuning.RANGE_BIAS_KNOWN**2
        differs = bias**2 > tuning.BEAM_SIGMAS**2 * variance
        is_sure = self._of_planes < tuning.RANGE_BIAS_SURE**2
        return bias if is_in_use or is_sure or (is_known and differs) else 0.0


class SeenAgain(NamedTuple):
    """Points of a sweep, and how the surfaces of the map that they meet were seen before.

    Attributes
    ----------
    places : ndarray, shape (M, 3)
        From the sensor [m], map axes.
    normals : ndarray, shape (M, 3)
        Of the surfaces, unit, map axes.
    distances : ndarray, shape (M,)
        Of the points from the surfaces along the normals [m].
    lines : ndarray, shape (M, 3)
        Mean of the unit vectors from the sensor to a surface when the map saw it, map axes.
    corrected : ndarray, shape (M, 3)
        Mean of the same vectors, each multiplied by the correction of its range [m].
    correction : float
        Of the ranges of the sweep [m].
    """

    places: F64
    normals: F64
    distances: F64
    lines: F64
    corrected: F64
    correction: float


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


def bend_of_planes(points: NDArray[np.void], rest_force: F64 | None = None) -> tuple[float, float]:
    """Return what planes say about a correction of ranges: information and gradient.

    Walls and ceilings are assumed to be flat. The ground counts only if it is smooth and shows no
    curvature of its own.

    Parameters
    ----------
    points : ndarray, shape (N,)
        In the frame of the sensor [m].
    rest_force : ndarray, shape (3,), optional
        Specific force of a sensor at rest in this attitude [m/s^2]: it points away from the
        ground. Without it, or where it is zero, any plane may be the ground.

    Returns
    -------
    information : float
        [1/m^2]; 0 where no plane tells anything.
    gradient : float
        The information, multiplied by the correction [1/m].
    """
    force = np.zeros(3) if rest_force is None else rest_force
    least = tuning.RANGE_BIAS_GROUND * float(np.linalg.norm(force))
    information = gradient = 0.0
    for places, along, normal in _planes(_flat_cells(positions_by_axis(points))):
        # measured = plane - correction * cosine of the incidence
        sights = places / np.linalg.norm(places, axis=1)[:, None]
        middle = places.mean(axis=0)
        in_plane = (places - middle) @ along.T
        heights = (places - middle) @ normal
        design = np.column_stack((np.ones(len(places)), in_plane, -(sights @ normal)))
        bend = _bend_of(design, heights, tuning.RANGE_BIAS_CELL_SIGMA, tuning.RANGE_BIAS_SIGMA)
        may_be_ground = float(normal @ force) <= -least
        if may_be_ground and _bends_by_itself(bend, in_plane, design, heights):
            continue
        information, gradient = information + bend.information, gradient + bend.gradient
    return information, gradient


def bend_of_map(seen: SeenAgain) -> tuple[float, float]:
    """Return what a map says about a correction of ranges: information and gradient.

    The bias moves a point along the normal by an amount that depends on the angle at which it is
    seen, and the same holds for its surface in the map. The pose of the sweep is marginalized.

    Parameters
    ----------
    seen : SeenAgain

    Returns
    -------
    information, gradient : float
        As of :func:`bend_of_planes`; both 0 where few points meet surfaces.
    """
    if len(seen.distances) < tuning.RANGE_BIAS_MAP_POINTS:
        return 0.0, 0.0
    sights = seen.places / np.linalg.norm(seen.places, axis=1)[:, None]
    now = np.einsum("ni,ni->n", sights, seen.normals)
    before = np.einsum("ni,ni->n", seen.lines, seen.normals)
    corrected = np.einsum("ni,ni->n", seen.corrected, seen.normals)
    # distance = (correction of now - right one) * now - (those of the map - right one) * before
    measured = seen.distances - seen.correction * now + corrected
    pose = np.concatenate((seen.normals, np.cross(seen.places, seen.normals)), axis=1)
    design = np.column_stack((pose, before - now))
    bend = _bend_of(design, measured, tuning.RANGE_BIAS_MAP_SIGMA, tuning.RANGE_BIAS_MAP_PRIOR)
    return bend.information, bend.gradient


class _Bend(NamedTuple):
    """What surfaces say about a correction of ranges.

    Attributes
    ----------
    information, gradient : float
        As of :func:`bend_of_planes`.
    residuals : ndarray, shape (N,)
        Of the fit with that correction [m].
    weights : ndarray, shape (N,)
        Robust weights, 0 to 1.
    """

    information: float
    gradient: float
    residuals: F64
    weights: F64


def _bends_by_itself(bend: _Bend, in_plane: F64, design: F64, heights: F64) -> bool:
    """Return whether a plane is bent in a way that a correction of ranges does not explain.

    The ground is rough where it is natural, and curved where water has to run off.

    Parameters
    ----------
    bend : _Bend
        Of its cells.
    in_plane : ndarray, shape (C, 2)
        Their coordinates in the plane, from its middle [m].
    design, heights : ndarray, shape (C, 4) and (C,)
        From which the bend follows.
    """
    if float(np.median(np.abs(bend.residuals))) > tuning.RANGE_BIAS_ROUGH:
        return True
    curved = np.column_stack((design, 0.5 * in_plane**2, in_plane.prod(axis=1)))
    weighted = (curved * bend.weights[:, None]).T
    covariance = np.linalg.inv(weighted @ curved + 1e-6 * np.eye(len(weighted)))
    fit = covariance @ weighted @ heights
    x, y, twist = own = fit[-3:]
    free = len(heights) - len(fit)  # a plane has more cells than there are unknowns
    variance = float(bend.weights @ (heights - curved @ fit) ** 2) / free
    # F test of no curvature at all
    explained = own @ np.linalg.solve(covariance[-3:, -3:], own) / 3.0
    is_sure = explained > tuning.RANGE_BIAS_CURVED_F * variance
    most = float(np.abs(np.linalg.eigvalsh(np.array(((x, twist), (twist, y))))).max())
    return bool(is_sure and most > tuning.RANGE_BIAS_CURVATURE)


def _bend_of(design: F64, measured: F64, sigma: float, prior_sigma: float) -> _Bend:
    """Return what measurements say about the last unknown; the others are marginalized.

    Parameters
    ----------
    design : ndarray, shape (N, K)
        What one unit of each unknown does to each measurement.
    measured : ndarray, shape (N,)
        [m]
    sigma : float
        Of each [m]; outliers lose weight.
    prior_sigma : float
        Of the correction [m], used to find outliers; not part of information and gradient.
    """
    last = design.shape[1] - 1
    prior = 1e-6 * np.eye(last + 1)  # a single wall does not fix a pose
    prior[last, last] = 1.0 / prior_sigma**2
    fit = np.zeros(last + 1)
    for number in range(tuning.RANGE_BIAS_STEPS):
        residual = measured - design @ fit if number else np.zeros(len(measured))
        weights = 1.0 / (1.0 + (residual / tuning.RANGE_BIAS_SCALE) ** 2) ** 2
        weighted = (design * (weights / sigma**2)[:, None]).T
        normal_matrix, right = weighted @ design, weighted @ measured
        fit = np.linalg.solve(normal_matrix + prior, right)
    shared = np.linalg.solve(
        normal_matrix[:last, :last] + prior[:last, :last],
        np.column_stack((normal_matrix[:last, last], right[:last])),
    )
    across = normal_matrix[last, :last]
    return _Bend(
        float(normal_matrix[last, last] - across @ shared[:, 0]),
        float(right[last] - across @ shared[:, 1]),
        measured - design @ fit,
        weights,
    )


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
    """Return the flat cells of points (3, N), without those too near for a sound range."""
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
