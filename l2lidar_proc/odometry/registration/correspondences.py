"""Correspondences of a sweep's points with the map's surfaces: residuals, weights, derivatives.

The residual of a point y, deskewed to the reference (from the IMU's origin, cloud axes) and
measured dt after it, is ``n . (R y + p - m)``. Deskewing used the velocity, gravity and biases, so
the residual depends on these too, linearly in dt: a sweep corrects the motion within itself as
well as its place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64, I64
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import (
    ACCEL_BIAS,
    ERRORS,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    VELOCITY,
    InertialState,
    skew,
)
from l2lidar_proc.odometry.config import SurfaceConfig
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.odometry.local_map.surfels import YoungSurfaces

Support = tuple[I64, F64]
"""Numbers of sweeps (N,), ascending, and the share of the weight that each has (N,)."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """The points to align.

    Attributes
    ----------
    points : ndarray, shape (N, 3)
        Deskewed to the reference, from the IMU's origin, cloud axes [m]; best with each axis
        contiguous.
    times : ndarray, shape (N,)
        Instant of each point after the reference [s], negative before it.
    ranges : ndarray, shape (N,)
        Distance of each point from the cloud frame's origin [m].
    denser : callable, optional
        Gives more points of the same sweep, which thinning has left out.
    """

    points: F64
    times: F64
    ranges: F64
    denser: Callable[[], Source] | None = None

    def extended(self, more: Source) -> Source:
        """Return these and more points."""
        return Source(
            np.concatenate((self.points, more.points)),
            np.concatenate((self.times, more.times)),
            np.concatenate((self.ranges, more.ranges)),
        )

    def some(self, index: I64) -> Source:
        """Return the points of some indices."""
        return Source(self.points[index], self.times[index], self.ranges[index])


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """Points that are near a surface of the map, seen from one state.

    Attributes
    ----------
    index : ndarray, shape (M,)
        Which of the source's points; one point may have two surfaces.
    points : ndarray, shape (M, 3)
        Deskewed by the state's motion, from the IMU's origin, cloud axes [m].
    times : ndarray, shape (M,)
        Instant after the reference [s].
    normals : ndarray, shape (M, 3)
        Of the surfaces, map axes.
    distances : ndarray, shape (M,)
        The residuals [m].
    variances : ndarray, shape (M,)
        Of the residuals at the true state [m^2].
    scales : ndarray, shape (M,)
        Distance at which the robust kernel leaves a quarter of the weight [m].
    weights : ndarray, shape (M,)
        Robust weight by variance [1/m^2].
    born : ndarray, shape (M,)
        Number of the sweep that was the first at the surface's place.
    opened : ndarray, shape (M,)
        Number of the sweep that opened the surface itself.
    is_fine : ndarray, shape (M,)
        Whether the surface is that of one of the finest cells.
    cells, axis : ndarray, shape (M,)
        Of the surfaces, as in :class:`~l2lidar_proc.odometry.local_map.surfels.Matches`.
    met : int
        Points at known surfaces, near or not.
    met_fine : int
        Likewise in the finest cells.
    latest : int
        Number of the sweep that was added to the map last.
    sweep_s : float
        From one sweep to the next [s].
    young : YoungSurfaces
        Of that map.
    """

    index: I64
    points: F64
    times: F64
    normals: F64
    distances: F64
    variances: F64
    scales: F64
    weights: F64
    born: I64
    opened: I64
    is_fine: NDArray[np.bool_]
    cells: I64
    axis: I64
    met: int
    met_fine: int
    latest: int
    sweep_s: float
    young: YoungSurfaces

    def part(self, first: int, last: int, met: int, met_fine: int) -> Correspondences:
        """Return those of the points from one index to another, counted from the first."""
        some = (self.index >= first) & (self.index < last)
        return Correspondences(
            self.index[some] - first,
            self.points[some],
            self.times[some],
            self.normals[some],
            self.distances[some],
            self.variances[some],
            self.scales[some],
            self.weights[some],
            self.born[some],
            self.opened[some],
            self.is_fine[some],
            self.cells[some],
            self.axis[some],
            met,
            met_fine,
            self.latest,
            self.sweep_s,
            self.young,
        )

    @property
    def inlier_ratio(self) -> float:
        """Share of the points at known surfaces that are near them, 0 to 1."""
        return np.count_nonzero(self._is_inlier) / max(self.met, 1)

    @property
    def fine_inliers(self) -> int:
        """Points near a surface of one of the finest cells."""
        return int(np.count_nonzero(self._is_inlier & self.is_fine))

    @property
    def _is_inlier(self) -> NDArray[np.bool_]:
        return np.asarray(np.abs(self.distances) < tuning.INLIER_SCALES * self.scales)

    @property
    def residual(self) -> float:
        """Weighted root mean square of the distances [m]."""
        total = max(float(self.weights.sum()), 1e-12)
        return float(np.sqrt((self.weights * self.distances**2).sum() / total))

    @property
    def support(self) -> Support:
        """Sweeps that were the first where the surfaces are, and their shares of the weight."""
        return support_of(self.born, self.weights)

    def settled(self, age: int, *, strict: bool = False) -> NDArray[np.bool_]:
        """Return which surfaces have been in the map for at least ``age`` sweeps, shape (M,).

        In a young map half of the map's age is enough, unless ``strict``. In a map that began with
        an open velocity, the time counts: that of so many sweeps of an L2.
        """
        if self.young is not YoungSurfaces.TRUSTED:
            age = round(age * tuning.SWEEP_S / self.sweep_s)
        if not strict:
            age = min(age, self.latest // 2)
        return np.asarray(self.latest - self.opened >= age)

    def on_two_surfaces(self, some: I64, rotation: F64) -> NDArray[np.bool_]:
        """Return which of some correspondences are of points that lie on another surface too.

        Where the pose is off along a wall, points on its front come to lie beside jambs in the
        map, and seem to confirm the pose. Two cases do not count as ambiguous: many
        correspondences, as most of them are right, and surfaces mapped so recently that the pose
        cannot be far off relative to them.

        Parameters
        ----------
        some : ndarray, shape (K,)
            Indices of correspondences.
        rotation : ndarray, shape (3, 3)
            Of the state from which they were found.

        Returns
        -------
        ndarray, shape (K,), dtype bool
            Whether the point lies on a surface that points nearby were matched with, and that
            faces elsewhere.
        """
        out = np.zeros(len(some), np.bool_)
        if not 0 < len(some) <= tuning.AMBIGUOUS_MOST:
            return out
        is_old = (self.latest - self.opened[some]) * self.sweep_s >= tuning.AMBIGUOUS_AGE_S
        old = some[is_old]
        points, normals = self.points @ rotation.T, self.normals
        squares, offsets = (points**2).sum(axis=1), (points * normals).sum(axis=1)
        apart = squares[old, None] + squares - 2.0 * points[old] @ points.T
        is_near = apart < tuning.AMBIGUOUS_NEAR**2
        is_on = np.abs(points[old] @ normals.T - offsets) < tuning.AMBIGUOUS_THICKNESS
        is_other = np.abs(normals[old] @ normals.T) < tuning.AMBIGUOUS_FACING
        count = np.count_nonzero(is_near & is_on & is_other, axis=1)
        out[is_old] = count >= tuning.AMBIGUOUS_LEAST
        return out

    def without_points_on_two_surfaces(self, rotation: F64) -> Correspondences:
        """Return these with zero weight where points are :meth:`on_two_surfaces`.

        The surfaces that face each principal direction are tested by themselves. Returns the same
        object if no point is ambiguous.

        Parameters
        ----------
        rotation : ndarray, shape (3, 3)
            Of the state from which they were found.
        """
        normals = self.normals
        directions = np.linalg.eigh((normals * self.weights[:, None]).T @ normals)[1]
        is_false = np.zeros(len(normals), np.bool_)
        for facing in (np.abs(normals @ directions) > tuning.WEAK_FACING).T:
            some = np.flatnonzero(facing)
            is_false[some[self.on_two_surfaces(some, rotation)]] = True
        if not is_false.any():
            return self
        return replace(self, weights=np.where(is_false, 0.0, self.weights))

    def support_along(self, derivatives: F64) -> Support:
        """Return the sweeps that opened the surfaces which hold a direction.

        Not those that first mapped the place: along a wall that was seen from afar long before, a
        niche is only as certain as the pose of the sweep that first saw into it.

        Parameters
        ----------
        derivatives : ndarray, shape (M,)
            Derivatives of the residuals along the direction.
        """
        return support_of(self.opened, self.weights * derivatives**2)

    def places_along(self, derivatives: F64) -> Support:
        """Return the sweeps that first mapped the places of the surfaces that fix a direction."""
        return support_of(self.born, self.weights * derivatives**2)


def support_of(sweeps: I64, weights: F64) -> Support:
    """Return which sweeps surfaces come from, and the share of the weight that each has.

    Parameters
    ----------
    sweeps, weights : ndarray, shape (M,)
        Of the surfaces.
    """
    if not len(sweeps):
        return sweeps, weights
    first = sweeps.min()
    places = sweeps - first  # few different ones: counting takes a fifth of the time of sorting
    numbers = np.flatnonzero(np.bincount(places))
    total = max(float(weights.sum()), 1e-12)
    return numbers + first, np.bincount(places, weights)[numbers] / total


def correspondences(
    prior: InertialState,
    state: InertialState,
    source: Source,
    surfaces: SurfelMap,
    config: SurfaceConfig,
    reach: float,
    *,
    reject_ambiguous: bool = False,
) -> Correspondences:
    """Return the points that are near a surface.

    Parameters
    ----------
    prior : InertialState
        Its motion deskewed the source.
    state : InertialState
        From which the points are seen.
    source : Source
    surfaces : SurfelMap
    config : SurfaceConfig
    reach : float
        Largest distance [m]; more where a surface is thick.
    reject_ambiguous : bool
        As for :meth:`~l2lidar_proc.odometry.local_map.surfel_map.SurfelMap.match`.
    """
    views = [(state, source)]
    return correspondences_of(
        views, prior, surfaces, config, reach, reject_ambiguous=reject_ambiguous
    )[0]


def correspondences_of(
    views: Sequence[tuple[InertialState, Source]],
    prior: InertialState,
    surfaces: SurfelMap,
    config: SurfaceConfig,
    reach: float,
    *,
    reject_ambiguous: bool = False,
) -> list[Correspondences]:
    """Return the points near a surface of several states and sources, which costs less at once.

    Parameters
    ----------
    views : sequence of tuple
    prior, surfaces, config, reach, reject_ambiguous
        As for :func:`correspondences`, of all.
    """
    if not views:
        return []
    deskewed = [
        _deskewed_again(source, state.boxminus(prior), prior.rotation) for state, source in views
    ]
    # the transpose of products with the transpose: each axis stays contiguous
    seen = [
        (state.rotation @ points.T).T + state.position
        for points, (state, _) in zip(deskewed, views, strict=True)
    ]
    sizes = [len(points) for points in seen]
    # a wall between rooms is thinner than the first step reaches, and what comes into sight
    # through a door is mostly another side of a wall: it would pull the sweep by the thickness
    is_single = len(views) == 1
    places = [state.position for state, _ in views]
    origins = places[0] if is_single else np.repeat(places, sizes, axis=0)
    matches = surfaces.match(
        _joined(seen),
        narrow=True,
        sizes=sizes,
        origins=origins,
        again=is_single,
        reject_ambiguous=reject_ambiguous,
    )
    points, times, ranges = (
        _joined(items)
        for items in (
            deskewed,
            [source.times for _, source in views],
            [source.ranges for _, source in views],
        )
    )
    scales = np.sqrt(config.outlier_scale**2 + matches.point_variances)
    farthest = np.maximum(reach, tuning.LAST_REACH_SCALES * scales)
    near = np.flatnonzero(np.abs(matches.distances) < farthest)
    index, distances, scales = matches.index[near], matches.distances[near], scales[near]
    far = tuning.RANGE_NOISE_FACTOR * tuning.RANGE_NOISE_SLOPE * ranges[index]
    surface = matches.variances[near] + tuning.SCATTER_SHARED * matches.point_variances[near]
    variances = config.point_noise**2 + far**2 + surface
    found = Correspondences(
        index,
        points[index],
        times[index],
        matches.normals[near],
        distances,
        variances,
        scales,
        robust_weights(distances, scales) / variances,
        matches.born[near],
        matches.opened[near],
        matches.is_fine[near],
        matches.cells[near],
        matches.axis[near],
        len(matches.index),
        int(np.count_nonzero(matches.is_fine)),
        surfaces.latest,
        surfaces.sweep_s,
        surfaces.young,
    )
    if is_single:
        return [found]
    edges = np.cumsum([0, *sizes])
    met, met_fine = (
        np.diff(np.searchsorted(np.sort(some), edges)).tolist()
        for some in (matches.index, matches.index[matches.is_fine])
    )
    return [
        found.part(first, last, count, fine)
        for first, last, count, fine in zip(
            edges[:-1].tolist(), edges[1:].tolist(), met, met_fine, strict=True
        )
    ]


def _joined(parts: list[F64]) -> F64:
    """Return arrays one after the other, a single one as it is."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def pose_jacobian(found: Correspondences, rotation: F64) -> F64:
    """Return the derivatives (M, 6) of the residuals by the errors of turn and place."""
    normals = found.normals.T
    jacobian = np.empty((6, len(found.points)))
    x, y, z = found.points.T
    nx, ny, nz = rotation.T @ normals
    jacobian[0], jacobian[1], jacobian[2] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
    jacobian[3:] = normals
    return jacobian.T


def residual_jacobian(pose: F64, since: F64, rotation: F64) -> F64:
    """Return the derivatives (M, 18) of the residuals by all errors.

    Parameters
    ----------
    pose : ndarray, shape (M, 6)
        Derivatives by the errors of turn and place.
    since : ndarray, shape (M,)
        Instants after the reference [s].
    rotation : ndarray, shape (3, 3)
        Cloud axes to map axes.
    """
    turn, place = pose[:, :3].T, pose[:, 3:].T
    half = 0.5 * since * since
    h = np.empty((ERRORS, len(pose)))
    h[ROTATION] = turn
    h[POSITION] = place
    h[VELOCITY] = since * place
    h[GYRO_BIAS] = -since * turn
    h[ACCEL_BIAS] = -half * (rotation.T @ place)
    h[GRAVITY] = half * place
    return h.T


def robust_weights(distances: F64, scales: F64) -> F64:
    """Return the weights (N,) of Geman and McClure: 1 for no distance, a quarter at the scale."""
    return np.asarray(1.0 / (1.0 + (distances / scales) ** 2) ** 2)


def _deskewed_again(source: Source, error: F64, rotation: F64) -> F64:
    """Return the points (N, 3) as a corrected motion deskews them, to first order."""
    since, points = source.times, source.points.T
    velocity = (error[VELOCITY] @ rotation)[:, None]
    acceleration = (error[GRAVITY] @ rotation - error[ACCEL_BIAS])[:, None]
    moved = skew(-error[GYRO_BIAS]) @ points + velocity + (0.5 * since) * acceleration
    return np.asarray((points + since * moved).T)
