"""Directions of the pose that a sweep does not fix, however many points it has.

A wall fixes nothing along itself, yet its points seem to: normals a few degrees off, by noise or
because the wall was mapped from a pose that turned, and the rounded rims of what has just been
seen, add up to a few percent of the strongest direction. They agree with every place along the
wall, so the pose stays where it was predicted, and velocity, biases and gravity are learned from
that. A direction that is weak by the eigenvalues (Zhang et al. 2016) is therefore tested:

* only surfaces that face it count, as in X-ICP (Tuna et al. 2024), and only if the map has had
  them for some sweeps: the rim of what has just been seen moves along with the view. Points that
  also lie on a surface along the direction do not count;
* the sweep is moved both ways along the direction and matched again: what the residuals pull back,
  divided by what they should if the surfaces were there, is the share of the information that is
  real. The rest is the noise of the gradient.

Eigenvectors mix rotations with translations, so what little is known about a rotation would
constrain the translation along a wall as well. With a narrow view, that halved the uncertainty of
a velocity which was wrong by more. So translations that no surface faces are taken out first, as
directions of their own. For these, only the few points that face them count.

A carrier that drives leaves the rims of its view behind, and an error of its velocity soon adds
up. There, five rules are stricter, and in turn surfaces count sooner:

* a surface faces the direction only if the error of its own normal cannot explain that;
* nor if it is hardly wider than the noise of the ranges: a scan line on the leaf of a door, just
  behind its frame, looks like the reveal, and moves along with the view;
* nor if few sweeps have seen it, as people leave surfaces behind: not in a map that began with an
  open velocity, where what faces the way may be seen for a moment only;
* the direction is that of the walls: what faces it is left out, and normals count as well as they
  are known;
* it is averaged over the last sweeps. If it differed from sweep to sweep, the strong directions
  would constrain it.

A surface that passes these tests may still move along with the view, and then confirms any
velocity. So it counts with the probability that it is the surface in the map (data association),
which is the lower, the less certain the position is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import (
    ERRORS,
    POSE,
    InertialState,
    association_probability,
)
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.odometry.local_map.surfels import YoungSurfaces
from l2lidar_proc.odometry.registration.correspondences import (
    Correspondences,
    pose_jacobian,
    robust_weights,
)

Views = Sequence[tuple[InertialState, NDArray[np.int64]]]
"""States, and which of the source's points are seen from each."""

MatchAgain = Callable[[Views], list[Correspondences]]
"""Gives the correspondences of each view."""


_STEPS: Final = (tuning.WEAK_STEP, -tuning.WEAK_STEP)
_PLACE: Final = slice(3, 6)  # of a direction


@dataclass(frozen=True, slots=True, eq=False)
class WeakAxes:
    """Directions of the pose that are weak by the eigenvalues.

    Attributes
    ----------
    scale : ndarray, shape (6,)
        Errors of turn and place [rad, m] for a unit of a direction.
    axes : ndarray, shape (6, K)
        The directions, orthonormal in these units, weakest first.
    surfaces : SurfelMap
    normal_scatter : ndarray, shape (3, 3), optional
        Scatter matrix of the walls' normals, map axes, in this sweep and those before; None where
        the carrier does not drive along the weakest direction.
    free : int
        How many of them, the first ones, are directions of the place that nothing faces.
    """

    scale: F64
    axes: F64
    surfaces: SurfelMap
    normal_scatter: F64 | None = None
    free: int = 0

    @property
    def is_driven(self) -> bool:
        """Whether the carrier drives along the weakest direction."""
        return self.normal_scatter is not None

    def derivatives(self, state: InertialState, found: Correspondences) -> F64:
        """Return the derivatives (M, K) of the residuals by the directions."""
        return np.asarray((pose_jacobian(found, state.rotation) * self.scale) @ self.axes)

    def facing(self, state: InertialState, found: Correspondences) -> NDArray[np.bool_]:
        """Return which surfaces face each of the directions (M, K)."""
        derivatives = self.derivatives(state, found)
        return np.stack(
            [self.faces(k, state, found, along) for k, along in enumerate(derivatives.T)], axis=1
        )

    def faces(
        self, number: int, state: InertialState, found: Correspondences, derivatives: F64
    ) -> NDArray[np.bool_]:
        """Return which surfaces (M,) face a direction, so that they tell the place along it.

        Parameters
        ----------
        number : int
            Of the direction.
        state : InertialState
            From which the correspondences were found.
        found : Correspondences
        derivatives : ndarray, shape (M,)
            Derivatives of the residuals along the direction.
        """
        age = tuning.DRIVING_AGE if self.is_driven else tuning.WEAK_AGE
        is_ignored = number < self.free and found.young is YoungSurfaces.IGNORED
        settled = found.settled(age, strict=is_ignored)
        faces = (np.abs(derivatives) > tuning.WEAK_FACING) & settled
        some = np.flatnonzero(faces)
        if not self.is_driven:
            faces[some] = ~found.on_two_surfaces(some, state.rotation)
            return faces
        if number == 0:  # the way that the carrier drives
            widths = self.surfaces.widths(found.cells[some], found.axis[some])
            faces[some] = widths > tuning.FACING_WIDTH
            if found.young is YoungSurfaces.TRUSTED:  # others tell young surfaces apart by age
                sweeps = self.surfaces.cells(found.cells[some])["sweeps"]
                faces[some] &= sweeps >= tuning.FACING_SWEEPS
            some = np.flatnonzero(faces)
        axis = self.scale * self.axes[:, number]
        moves = np.cross(axis[:3], found.points[some]) @ state.rotation.T + axis[_PLACE]
        tilts = self.surfaces.tilts(found.cells[some], found.axis[some])
        sigma = np.linalg.norm(np.einsum("nij,nj->ni", tilts, moves), axis=1)
        faces[some] = np.abs(derivatives[some]) > tuning.FACING_SIGMAS * sigma
        return faces


def weak_axes(
    state: InertialState,
    found: Correspondences,
    surfaces: SurfelMap,
    *,
    driving: bool = False,
    normal_scatter: F64 | None = None,
) -> WeakAxes | None:
    """Return the directions that a sweep may not fix, None where it fixes all.

    Parameters
    ----------
    state : InertialState
        From which the correspondences were found.
    found : Correspondences
    surfaces : SurfelMap
    driving : bool
        Whether the carrier drives, in whatever direction.
    normal_scatter : ndarray, shape (3, 3), optional
        As in :class:`WeakAxes`, of the sweeps before; None before the first. Used while driving.
    """
    # a turn counts as the way that it moves the points
    arm = float(np.sqrt((found.points**2).sum(axis=1).mean()))
    scale = np.repeat((1.0 / max(arm, tuning.WEAK_LEAST_ARM), 1.0), 3)
    derivatives = pose_jacobian(found, state.rotation) * scale
    strength, axes = np.linalg.eigh((derivatives * found.weights[:, None]).T @ derivatives)
    weak = strength < tuning.WEAK_SHARE * strength[-1]
    if not weak.any():
        return None
    axes = axes[:, weak]
    if not driving or not _is_way(axes[:, 0], state.gravity):
        axes, free = _free_first(axes, found, state.gravity)
        return WeakAxes(scale, axes, surfaces, free=free)
    tilts = np.linalg.norm(surfaces.tilts(found.cells, found.axis), axis=2).max(axis=1)
    weights = found.weights / (1.0 + (tilts / tuning.NORMAL_KNOWN) ** 2)
    axes = _along_walls(axes, derivatives, weights)
    before = np.zeros((3, 3)) if normal_scatter is None else normal_scatter
    axes, normal_scatter = _steadied(axes, found.normals, weights, before)
    return WeakAxes(scale, axes, surfaces, normal_scatter)


def _free_first(axes: F64, found: Correspondences, gravity: F64) -> tuple[F64, int]:
    """Return weak directions (6, K) with those of the place first that no surface faces.

    Parameters
    ----------
    axes : ndarray, shape (6, K)
        Orthonormal, weakest first.
    found : Correspondences
    gravity : ndarray, shape (3,)
        [m/s^2]; zero if unknown.

    Returns
    -------
    axes : ndarray, shape (6, L)
        Orthonormal. They span the given directions as far as those of the place leave them.
    free : int
        How many of them are those of the place.
    """
    normals = found.normals
    strength, places = np.linalg.eigh((normals * found.weights[:, None]).T @ normals)
    places = places[:, strength < tuning.WEAK_SHARE * strength[-1]]
    is_height = np.zeros(places.shape[1], np.bool_)
    if found.young is YoungSurfaces.IGNORED:
        places, is_height = _height_apart(places, gravity)
    faces = np.abs(normals @ places) > tuning.WEAK_FACING
    strict = found.young is not YoungSurfaces.TRUSTED
    # between bare walls, floor and ceiling tell the height at once: no rim looks like them
    faces &= found.settled(tuning.WEAK_AGE, strict=strict)[:, None] | is_height
    faces &= (found.weights > 0.0)[:, None]
    places = places[:, np.count_nonzero(faces, axis=0) <= tuning.FREE_FACING]
    if not places.shape[1]:
        return axes, 0
    free = np.concatenate((np.zeros_like(places), places))
    others, lengths, _ = np.linalg.svd(axes - free @ (free.T @ axes), full_matrices=False)
    others = others[:, lengths > tuning.FREE_LEFT]
    return np.column_stack((free, others[:, ::-1])), free.shape[1]


def _height_apart(places: F64, gravity: F64) -> tuple[F64, NDArray[np.bool_]]:
    """Return directions (3, K), one of them nearly vertical if possible, and whether each is (K,).

    Floor and ceiling may constrain the height as little as anything constrains the way along a
    corridor. The two weak directions are then an arbitrary basis of a plane.

    Parameters
    ----------
    places : ndarray, shape (3, K)
        Orthonormal.
    gravity : ndarray, shape (3,)
        [m/s^2]
    """
    within = places.T @ gravity
    length = float(np.linalg.norm(within))
    is_height = np.zeros(places.shape[1], np.bool_)
    if length <= tuning.WEAK_HEIGHT * float(np.linalg.norm(gravity)):
        return places, is_height
    is_height[0] = True
    turn = np.linalg.qr(np.column_stack((within / length, np.eye(len(within)))))[0]
    return np.asarray(places @ turn), is_height


def _is_way(axis: F64, gravity: F64) -> bool:
    """Return whether a direction (6,) is a level translation, along which one may drive."""
    way = axis[_PLACE]
    size = float(np.linalg.norm(gravity))
    level = abs(float(way @ gravity)) < tuning.DRIVING_SLOPE * size
    return level and float(np.linalg.norm(way)) > tuning.DRIVING_WAY


def _along_walls(axes: F64, derivatives: F64, weights: F64) -> F64:
    """Return the weak directions (6, K) without the surfaces that face the weakest.

    Parameters
    ----------
    axes : ndarray, shape (6, K)
    derivatives : ndarray, shape (M, 6)
        Derivatives of the residuals by turn and place, scaled.
    weights : ndarray, shape (M,)
        The better a normal is known, the more.
    """
    for _ in range(tuning.WALL_ROUNDS):
        walls = np.abs(derivatives @ axes[:, 0]) < tuning.WEAK_FACING
        if np.count_nonzero(walls) < tuning.WALL_LEAST * len(walls):
            break
        some = derivatives[walls]
        directions = np.linalg.eigh((some * weights[walls, None]).T @ some)[1]
        axes = directions[:, : axes.shape[1]]
    return axes


def _steadied(axes: F64, normals: F64, weights: F64, before: F64) -> tuple[F64, F64]:
    """Return the weak directions, the weakest averaged over sweeps, and the normals' scatter.

    Parameters
    ----------
    axes : ndarray, shape (6, K)
    normals : ndarray, shape (M, 3)
    weights : ndarray, shape (M,)
    before : ndarray, shape (3, 3)
        Scatter of the sweeps before.
    """
    way = axes[_PLACE, 0]
    length = float(np.linalg.norm(way))
    if length < tuning.DRIVING_WAY:
        return axes, before
    way = way / length
    walls = np.abs(normals @ way) < tuning.WEAK_FACING
    now = (normals[walls] * weights[walls, None]).T @ normals[walls]
    scatter = tuning.WALL_BLEND * before + now
    strength, directions = np.linalg.eigh(scatter)
    steady = directions[:, 0] * np.sign(directions[:, 0] @ way)
    bent = steady @ way < np.cos(tuning.WALL_BEND)
    if bent or strength[0] > tuning.WALL_FLAT * strength[1]:
        return axes, now
    first = np.r_[np.zeros(3), steady]
    others = np.linalg.qr(np.column_stack((first, axes[:, 1:])))[0][:, 1:]
    return np.column_stack((first, others)), scatter


@dataclass(frozen=True, slots=True, eq=False)
class WeakDirections:
    """Directions of the pose that a sweep constrains less than its points suggest.

    Attributes
    ----------
    tested : WeakAxes
        The directions.
    shares : ndarray, shape (K,)
        How much of what facing surfaces claim is real, 0 to 1.
    associated : float
        Square root of the share of the information along the first direction that is left, since
        the surfaces may be others, 0 to 1.
    """

    tested: WeakAxes
    shares: F64
    associated: float = 1.0

    def reduced(self, pose: F64, facing: NDArray[np.bool_]) -> tuple[F64, F64]:
        """Return derivatives (M, 6) by turn and place, reduced to the share that is real.

        The first ones are for the information, the second ones for the gradient.

        A residual of which the share f is real measures 1/f times as coarsely: its information is
        scaled by f^2 and its gradient by f, which keeps the minimum where it is. A surface that
        may be another one is as far away as it seems but less certain: information and gradient
        are scaled alike.

        Parameters
        ----------
        pose : ndarray, shape (M, 6)
            Derivatives of the residuals.
        facing : ndarray, shape (M, K)
            Which surfaces face which direction.
        """
        scaled = pose * self.tested.scale
        shares = self.shares.copy()
        shares[0] *= self.associated
        information = self._without(scaled, facing, shares)
        if self.associated == 1.0:
            return information, information
        shares[0] *= self.associated
        return information, self._without(scaled, facing, shares)

    def _without(self, scaled: F64, facing: NDArray[np.bool_], shares: F64) -> F64:
        """Return derivatives (M, 6), given scaled, without what is not real in them."""
        axes = self.tested.axes
        lost = (scaled @ axes) * np.where(facing, 1.0 - shares, 1.0)
        return np.asarray((scaled - lost @ axes.T) / self.tested.scale)


def weak_directions(
    state: InertialState,
    found: Correspondences,
    weak: WeakAxes,
    match_again: MatchAgain,
    prior: InertialState,
    covariance: F64,
) -> WeakDirections:
    """Return which share of the information about weak directions is real.

    Parameters
    ----------
    state : InertialState
        From which the correspondences were found.
    found : Correspondences
    weak : WeakAxes
    match_again : callable
    prior : InertialState
        As predicted.
    covariance : ndarray, shape (6, 6)
        Of its turn and place.
    """
    trials = [_Trial(state, found, weak, number) for number in range(weak.axes.shape[1])]
    there = iter(match_again([view for trial in trials for view in trial.views]))
    shares = np.array([trial.real_share([next(there) for _ in trial.views]) for trial in trials])
    if not weak.is_driven or shares[0] == 0.0:
        return WeakDirections(weak, shares)
    moved = state.boxminus(prior)[POSE]
    return WeakDirections(weak, shares, trials[0].associated(shares[0], moved, covariance))


class _Trial:
    """A sweep moved both ways along one of some weak directions."""

    def __init__(
        self, state: InertialState, found: Correspondences, weak: WeakAxes, number: int
    ) -> None:
        self._weak, self._number = weak, number
        self._axis = weak.scale * weak.axes[:, number]  # [rad, m]
        derivatives = pose_jacobian(found, state.rotation) @ self._axis
        facing = np.flatnonzero(weak.faces(number, state, found, derivatives))
        self._facing = derivatives[facing], found.distances[facing], found.scales[facing]
        self._variances = found.variances[facing]
        self._some = np.unique(found.index[facing])
        move = np.zeros(ERRORS)
        self._moved = []
        for step in _STEPS if len(facing) else ():
            move[POSE] = step * self._axis
            self._moved.append(state.boxplus(move))

    def associated(self, share: float, moved: F64, covariance: F64) -> float:
        """Return the square root of the share of the information that is left.

        A surface that moves along with the view is always where it is expected, and a few points
        face any direction. The less certain the position is, the less likely is a nearby surface
        the one in the map. The measurement then counts as a coarser one, which leaves the same
        variance as the mixture of both cases.

        Parameters
        ----------
        share : float
            Of what the residuals claim that is real.
        moved : ndarray, shape (6,)
            Turn and place from which the correspondences were found, against the predicted ones.
        covariance : ndarray, shape (6, 6)
            Of the predicted ones.
        """
        derivatives, distances, scales = self._facing
        weights = robust_weights(distances, scales) / self._variances
        claimed = float((weights * derivatives**2).sum())
        information = share**2 * claimed
        unit = self._weak.axes[:, self._number] / self._weak.scale
        pulled = -float((weights * derivatives * distances).sum()) / (share * claimed)
        innovation = float(unit @ moved) + pulled
        before = float(unit @ covariance @ unit)
        expected = before + 1.0 / information
        many = len(derivatives) >= tuning.FACING_MANY
        odds = tuning.FACING_TRUE_MANY if many else tuning.FACING_TRUE
        right = association_probability(innovation, expected, odds)
        gain = before / expected
        spread = right * (1.0 - right) * (gain * innovation) ** 2
        mixed = right * before * (1.0 - gain) + (1.0 - right) * before + spread
        return float(np.sqrt(max(1.0 / mixed - 1.0 / before, 0.0) / information))

    @property
    def views(self) -> Views:
        """The moved states and the points to match from each; empty if no surface faces."""
        return [(moved, self._some) for moved in self._moved]

    def real_share(self, there: list[Correspondences]) -> float:
        """Return the share of the information that the moved points confirm, 0 to 1."""
        derivatives, distances, scales = self._facing
        claimed = pulled = noise = 0.0
        for step, moved, seen in zip(_STEPS, self._moved, there, strict=bool(there)):
            expected = distances + step * derivatives
            claimed += step * float(
                (robust_weights(expected, scales) / self._variances * derivatives * expected).sum()
            )
            along = pose_jacobian(seen, moved.rotation) @ self._axis
            pulls = seen.weights * along * seen.distances
            pulls = pulls[self._weak.faces(self._number, moved, seen, along)]
            pulled += step * float(pulls.sum())
            noise += step**2 * float((pulls**2).sum())
        if claimed <= 0.0:
            return 0.0
        share = (pulled - tuning.WEAK_SIGMAS * np.sqrt(noise)) / claimed
        return float(np.clip(share, 0.0, 1.0))
