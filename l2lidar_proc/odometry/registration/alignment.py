"""Scan alignment: iterated update of the filter with point-to-plane residuals.

Directions that a sweep does not fix are found once it has converged
(:mod:`~l2lidar_proc.odometry.registration.weak_directions`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import (
    POSE,
    POSITION,
    TWIST,
    InertialState,
    square_root,
    update_with_information,
)
from l2lidar_proc.odometry.config import SurfaceConfig
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.odometry.registration.correspondences import (
    Correspondences,
    Source,
    Support,
    correspondences,
    correspondences_of,
    pose_jacobian,
    residual_jacobian,
)
from l2lidar_proc.odometry.registration.weak_directions import (
    Views,
    WeakAxes,
    WeakDirections,
    weak_axes,
    weak_directions,
)


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Result of an alignment.

    Attributes
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    information : ndarray, shape (18, 18)
        What the points alone say, at the last step; nothing in directions they do not fix.
    claimed : ndarray, shape (3, 3)
        About the place, if every surface fixed what its normal claims [1/m^2].
    matched : int
        Points that took part in the last step.
    inlier_ratio : float
        Share of the points at known surfaces that are near them, 0 to 1: unknown surroundings do
        not lower it, a wrong pose does.
    residual : float
        Weighted root mean square of their distances [m].
    support : Support
        Of all surfaces met.
    weakly : tuple of ndarray and Support, optional
        Direction of the place (3,), map axes, that the points fix least, and the support of the
        surfaces that fix it; None where it was not surfaces that fixed the place.
    strongly : tuple of tuple of ndarray and Support
        Likewise of the other two directions; of these, the sweeps that were the first there.
    fine_inliers : int
        Points near surfaces of the finest cells.
    fine_ratio : float
        Share of the points in such cells that these are, 0 to 1.
    normal_scatter : ndarray, shape (3, 3), optional
        Of the walls along which the carrier drives, as in
        :class:`~l2lidar_proc.odometry.registration.weak_directions.WeakAxes`.
    """

    state: InertialState
    covariance: F64
    information: F64
    claimed: F64
    matched: int
    inlier_ratio: float
    residual: float
    support: Support
    weakly: tuple[F64, Support] | None = None
    strongly: tuple[tuple[F64, Support], ...] = ()
    fine_inliers: int = 0
    fine_ratio: float = 0.0
    normal_scatter: F64 | None = None

    def fits_better_than(self, other: Alignment, points: int) -> bool:
        """Return whether this is right and another alignment of the sweep's points is wrong.

        More points must fit here. They must also be a large share of the sweep and fix the place,
        or be many and nearly all of it.
        """
        if self.inlier_ratio < other.inlier_ratio + tuning.DOUBT_BETTER:
            return False
        if self.fixes_place:
            return self.is_rich(points)
        nearly_all = tuning.DOUBT_MATCHED.free * points
        return self.matched >= max(nearly_all, tuning.DOUBT_MANY)

    def fits_closer_than(self, other: Alignment, config: SurfaceConfig) -> bool:
        """Return whether this fixes the place, and as many points lie much closer to surfaces."""
        if not self.fixes_place or self.matched < tuning.DOUBT_AS_MANY * other.matched:
            return False
        closer = tuning.DOUBT_CLOSER
        share = closer.fixed if other.fixes_place else closer.free
        return bool(self.misfit(config) < share * other.misfit(config))

    def is_rich(self, points: int) -> bool:
        """Return whether it fixes the place, and a good part of so many points match."""
        return self.fixes_place and self.matched >= tuning.DOUBT_MATCHED.fixed * points

    @property
    def fixes_place(self) -> bool:
        """Whether every direction of the place is observed."""
        return not unobserved_directions(self.information[POSITION, POSITION]).size

    def misfit(self, config: SurfaceConfig) -> float:
        """Mean square of the points' distances to surfaces; outliers are at their limit [m^2]."""
        outliers = 1.0 - self.inlier_ratio
        limit = tuning.INLIER_SCALES * config.outlier_scale
        return self.inlier_ratio * self.residual**2 + outliers * limit**2


def align(
    prior: InertialState,
    covariance: F64,
    source: Source,
    surfaces: SurfelMap,
    config: SurfaceConfig,
    least: int,
    start: InertialState | None = None,
    *,
    driving: bool = False,
    normal_scatter: F64 | None = None,
) -> Alignment | None:
    """Return the posterior of a sweep, None where fewer than ``least`` points meet a surface.

    Directions that the sweep does not fix are found once it has converged; there the prior is
    kept, and a few more steps bring the others to rest.

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
    driving : bool
        Whether the carrier drives: it then leaves the rims of its view behind.
    normal_scatter : ndarray, shape (3, 3), optional
        That of the sweep before, if it has one. Used while driving.
    """
    at = prior if start is None else start
    root = square_root(covariance)
    step, weak = None, None
    last = config.iterations - 1
    # what is ahead of a carrier that drives is seen from afar first: its surfaces grow with each
    # sweep, and points beyond their extent are right
    reject_ambiguous = not driving
    for number in range(config.iterations + tuning.WEAK_STEPS):
        reach = max(
            tuning.FIRST_REACH_M * 0.5**number, tuning.LAST_REACH_SCALES * config.outlier_scale
        )
        found = correspondences(
            prior, at, source, surfaces, config, reach, reject_ambiguous=reject_ambiguous
        )
        if len(found.index) < least:
            break
        if weak is not None and reject_ambiguous:  # it has converged
            found = found.without_points_on_two_surfaces(at.rotation)
        step = _step(prior, root, at, found, weak)
        done = _is_small(step.state.boxminus(at)) or number >= last
        if done and weak is None:
            if reject_ambiguous:
                found = found.without_points_on_two_surfaces(at.rotation)
            axes = weak_axes(at, found, surfaces, driving=driving, normal_scatter=normal_scatter)
            if axes is None:
                step = step if found is step.found else _step(prior, root, at, found, None)
                break
            matching = _Matching(prior, surfaces, config, reach, reject_ambiguous)
            if axes.is_driven:
                source = matching.with_facing(source, at, axes)
                found = matching.of([(at, source)])[0]
            again = partial(matching.of_some, source)
            weak = weak_directions(at, found, axes, again, prior, covariance[POSE, POSE])
            before = step.state
            step = _step(prior, root, at, found, weak)
            done = _is_small(step.state.boxminus(before))
            last = number + tuning.WEAK_STEPS
        if done:
            break
        at = step.state
    return None if step is None else step.alignment


class _Matching(NamedTuple):
    """Settings with which the points of a sweep are matched with the map, from any state."""

    prior: InertialState
    surfaces: SurfelMap
    config: SurfaceConfig
    reach: float
    reject_ambiguous: bool

    def of(self, seen: Sequence[tuple[InertialState, Source]]) -> list[Correspondences]:
        """Return the correspondences of several states and sources."""
        return correspondences_of(
            seen,
            self.prior,
            self.surfaces,
            self.config,
            self.reach,
            reject_ambiguous=self.reject_ambiguous,
        )

    def of_some(self, source: Source, views: Views) -> list[Correspondences]:
        """Return the correspondences of several states, each with some of the points."""
        return self.of([(state, source.some(index)) for state, index in views])

    def with_facing(self, source: Source, at: InertialState, weak: WeakAxes) -> Source:
        """Return a source with all points of its sweep on surfaces facing the weakest direction.

        Thinning leaves only a point or two on a reveal, which is a hand wide.
        """
        if source.denser is None:
            return source
        more = source.denser()
        found = self.of([(at, more)])[0]
        facing = weak.faces(0, at, found, weak.derivatives(at, found)[:, 0])
        return source.extended(more.some(np.unique(found.index[facing])))


class _Step(NamedTuple):
    """One iteration: the correspondences, and the posterior that follows from them."""

    state: InertialState
    covariance: F64
    information: F64
    normals: F64  # derivatives (M, 3) of the residuals by the place
    found: Correspondences
    weak: WeakDirections | None

    @property
    def alignment(self) -> Alignment:
        """The result, if this is the last iteration."""
        found = self.found
        weakest, *others = np.linalg.eigh(self.information[POSITION, POSITION])[1].T
        return Alignment(
            self.state,
            self.covariance,
            self.information,
            (found.normals * found.weights[:, None]).T @ found.normals,
            len(found.index),
            found.inlier_ratio,
            found.residual,
            found.support,
            (weakest, found.support_along(self.normals @ weakest)),
            tuple((axis, found.places_along(self.normals @ axis)) for axis in others),
            found.fine_inliers,
            found.fine_inliers / max(found.met_fine, 1),
            None if self.weak is None else self.weak.tested.normal_scatter,
        )


def _step(
    prior: InertialState,
    root: F64,
    at: InertialState,
    found: Correspondences,
    weak: WeakDirections | None,
) -> _Step:
    """Return the posterior of correspondences found from a state."""
    pose = by_pose = pose_jacobian(found, at.rotation)
    if weak is not None:
        pose, by_pose = weak.reduced(pose, weak.tested.facing(at, found))
    h = residual_jacobian(pose, found.times, at.rotation)
    weighted = h * found.weights[:, None]
    information = weighted.T @ h
    if by_pose is not pose:
        h = residual_jacobian(by_pose, found.times, at.rotation)
        weighted = h * found.weights[:, None]
    state, posterior = update_with_information(
        prior, root, at, information, -(weighted.T @ found.distances)
    )
    return _Step(state, posterior, information, pose[:, 3:], found, weak)


def _is_small(change: F64) -> bool:
    """Return whether a step hardly changes the pose, nor the twist that deskews the points."""
    twist = np.abs(change[TWIST]).max()
    return bool(np.abs(change[POSE]).max() < tuning.CONVERGED and twist < tuning.CONVERGED_TWIST)


def degeneracy_ratio(information: F64) -> float:
    """Return the share of some information (3, 3) that its least observed direction has."""
    strength = np.linalg.eigvalsh(information)
    return float(strength[0] / max(float(strength.sum()), 1e-12))


def weakest_direction(information: F64) -> tuple[float, float, float]:
    """Return the direction, unit, of which some information (3, 3) says least."""
    x, y, z = np.linalg.eigh(information)[1][:, 0].tolist()
    return x, y, z


def unobserved_directions(information: F64) -> F64:
    """Return the directions (3, K), orthonormal, of which some information (3, 3) says nothing."""
    strength, directions = np.linalg.eigh(information)
    total = max(float(strength.sum()), 1e-12)
    return np.asarray(directions[:, strength < tuning.DEGENERATE_SHARE * total])
