"""Scan alignment: iterated update of the filter with point-to-plane residuals.

It also finds which directions of the pose a sweep does not fix, however many points it has. A wall
fixes nothing along itself, yet its points seem to: normals a few degrees off, by noise or because
the wall was mapped from a pose that turned, and the rounded rims of what has just been seen, add
up to a few percent of the strongest direction. They agree with every place along the wall, so the
pose stays where it was predicted, and velocity, biases and gravity are learned from that. A
direction that is weak by the eigenvalues (Zhang et al. 2016) is therefore tested:

* only surfaces that face it count, as in X-ICP (Tuna et al. 2024), and only if the map has had
  them for some sweeps: the rim of what has just been seen moves along with the view;
* the sweep is moved both ways along the direction and matched again: what the residuals pull back,
  divided by what they should if the surfaces were there, is the share of the information that is
  real. The rest is the noise of the gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import (
    ERRORS,
    POSE,
    POSITION,
    TWIST,
    InertialState,
    square_root,
    update_with_information,
)
from l2lidar_proc.odometry.config import SurfaceConfig
from l2lidar_proc.odometry.correspondences import (
    Correspondences,
    Source,
    Support,
    correspondences,
    correspondences_of,
    pose_jacobian,
    residual_jacobian,
    robust_weights,
)
from l2lidar_proc.odometry.surfel_map import SurfelMap


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
    steps : int
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
    """

    state: InertialState
    covariance: F64
    information: F64
    claimed: F64
    matched: int
    inlier_ratio: float
    residual: float
    steps: int
    support: Support
    weakly: tuple[F64, Support] | None = None
    strongly: tuple[tuple[F64, Support], ...] = ()
    fine_inliers: int = 0
    fine_ratio: float = 0.0


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
    """
    at = prior if start is None else start
    root = square_root(covariance)
    step, weak = None, None
    last = config.iterations - 1
    for number in range(config.iterations + tuning.WEAK_STEPS):
        reach = max(
            tuning.FIRST_REACH_M * 0.5**number, tuning.LAST_REACH_SCALES * config.outlier_scale
        )
        found = correspondences(prior, at, source, surfaces, config, reach)
        if len(found.index) < least:
            break
        step = _step(prior, root, at, found, weak, number + 1)
        done = _is_small(step.state.boxminus(at)) or number >= last
        if done and weak is None:

            def match_again(views: Views, reach: float = reach) -> list[Correspondences]:
                seen = [(moved, source.some(some)) for moved, some in views]
                return correspondences_of(seen, prior, surfaces, config, reach)

            weak = weak_directions(at, found, match_again)
            if weak is None:
                break
            before = step.state
            step = _step(prior, root, at, found, weak, number + 1)
            done = _is_small(step.state.boxminus(before))
            last = number + tuning.WEAK_STEPS
        if done:
            break
        at = step.state
    return None if step is None else step.alignment


class _Step(NamedTuple):
    """One iteration: the correspondences, and the posterior that follows from them."""

    state: InertialState
    covariance: F64
    information: F64
    normals: F64  # derivatives (M, 3) of the residuals by the place
    found: Correspondences
    number: int

    @property
    def alignment(self) -> Alignment:
        """What is reported where this is the last one."""
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
            self.number,
            found.support,
            (weakest, found.support_along(self.normals @ weakest)),
            tuple((axis, found.places_along(self.normals @ axis)) for axis in others),
            found.fine_inliers,
            found.fine_inliers / max(found.met_fine, 1),
        )


def _step(
    prior: InertialState,
    root: F64,
    at: InertialState,
    found: Correspondences,
    weak: WeakDirections | None,
    number: int,
) -> _Step:
    """Return the posterior of correspondences found from a state."""
    pose = pose_jacobian(found, at.rotation)
    if weak is not None:
        pose = weak.reduced(pose, found.is_settled)
    h = residual_jacobian(pose, found.times, at.rotation)
    weighted = h * found.weights[:, None]
    information = weighted.T @ h
    state, posterior = update_with_information(
        prior, root, at, information, -(weighted.T @ found.distances)
    )
    return _Step(state, posterior, information, pose[:, 3:], found, number)


def _is_small(change: F64) -> bool:
    """Return whether a step hardly changes the pose, nor the twist that deskews the points."""
    twist = np.abs(change[TWIST]).max()
    return bool(np.abs(change[POSE]).max() < tuning.CONVERGED and twist < tuning.CONVERGED_TWIST)


Views = Sequence[tuple[InertialState, NDArray[np.int64]]]
"""States, and which of the source's points are seen from each."""

MatchAgain = Callable[[Views], list[Correspondences]]
"""Gives the correspondences of each view."""


_STEPS: Final = (tuning.WEAK_STEP, -tuning.WEAK_STEP)


@dataclass(frozen=True, slots=True, eq=False)
class WeakDirections:
    """Directions of the pose that a sweep constrains less than its points suggest.

    Attributes
    ----------
    scale : ndarray, shape (6,)
        Errors of turn and place [rad, m] for a unit of a direction.
    axes : ndarray, shape (6, K)
        The directions, orthonormal in these units.
    shares : ndarray, shape (K,)
        How much of what facing surfaces claim is real, 0 to 1.
    """

    scale: F64
    axes: F64
    shares: F64

    def reduced(self, pose: F64, is_settled: NDArray[np.bool_]) -> F64:
        """Return derivatives (M, 6) by turn and place, of residuals that claim no more than so.

        ``is_settled`` (M,) tells whose surfaces are no longer new.

        A residual of which the share f is real measures 1/f times as coarsely: information falls
        by f^2 and the gradient by f, so that where it is zero stays.
        """
        scaled = pose * self.scale
        along = scaled @ self.axes
        facing = (np.abs(along) > tuning.WEAK_FACING) & is_settled[:, None]
        lost = along * np.where(facing, 1.0 - self.shares, 1.0)
        return np.asarray((scaled - lost @ self.axes.T) / self.scale)


def weak_directions(
    state: InertialState, found: Correspondences, match_again: MatchAgain
) -> WeakDirections | None:
    """Return the directions that a sweep hardly fixes, None where it fixes all.

    Parameters
    ----------
    state : InertialState
        From which the correspondences were found.
    found : Correspondences
    match_again : callable
    """
    pose = pose_jacobian(found, state.rotation)
    # a turn counts as the way that it moves the points
    arm = float(np.sqrt((found.points**2).sum(axis=1).mean()))
    scale = np.repeat((1.0 / max(arm, tuning.WEAK_LEAST_ARM), 1.0), 3)
    scaled = pose * scale
    strength, axes = np.linalg.eigh((scaled * found.weights[:, None]).T @ scaled)
    weak = strength < tuning.WEAK_SHARE * strength[-1]
    if not weak.any():
        return None
    axes = axes[:, weak]
    trials = [_Trial(state, found, scaled @ axis, scale * axis) for axis in axes.T]
    there = iter(match_again([view for trial in trials for view in trial.views]))
    shares = np.array([trial.real_share([next(there) for _ in trial.views]) for trial in trials])
    return WeakDirections(scale, axes, shares)


class _Trial:
    """A sweep moved both ways along a direction (6,) of the pose [rad, m].

    ``levers`` (M,) are the derivatives of the residuals along it.
    """

    def __init__(
        self, state: InertialState, found: Correspondences, levers: F64, axis: F64
    ) -> None:
        self._axis = axis
        facing = np.flatnonzero((np.abs(levers) > tuning.WEAK_FACING) & found.is_settled)
        self._facing = levers[facing], found.distances[facing], found.scales[facing]
        self._variances = found.variances[facing]
        self._some = np.unique(found.index[facing])
        move = np.zeros(ERRORS)
        self._moved = []
        for step in _STEPS if len(facing) else ():
            move[POSE] = step * axis
            self._moved.append(state.boxplus(move))

    @property
    def views(self) -> Views:
        """What is to be matched: nothing where no surface faces the direction."""
        return [(moved, self._some) for moved in self._moved]

    def real_share(self, there: list[Correspondences]) -> float:
        """Return how much of the information about the direction the moved points confirm."""
        levers, distances, scales = self._facing
        claimed = pulled = noise = 0.0
        for step, moved, seen in zip(_STEPS, self._moved, there, strict=bool(there)):
            expected = distances + step * levers
            claimed += step * float(
                (robust_weights(expected, scales) / self._variances * levers * expected).sum()
            )
            along = pose_jacobian(seen, moved.rotation) @ self._axis
            pulls = seen.weights * along * seen.distances
            pulls = pulls[(np.abs(along) > tuning.WEAK_FACING) & seen.is_settled]
            pulled += step * float(pulls.sum())
            noise += step**2 * float((pulls**2).sum())
        if claimed <= 0.0:
            return 0.0
        share = (pulled - tuning.WEAK_SIGMAS * np.sqrt(noise)) / claimed
        return float(np.clip(share, 0.0, 1.0))


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
