"""Directions of the pose that a sweep does not fix, however many points it has.

A wall fixes nothing along itself, yet its points seem to: normals a few degrees off, by noise or
because the wall was mapped from a pose that turned, and the rounded rims of what has just been
seen, add up to a few percent of the strongest direction. They agree with every place along the
wall, so the pose stays where it was predicted, and velocity, biases and gravity are learned from
that. A direction that is weak by the eigenvalues (Zhang et al. 2016) is therefore tested:

* only surfaces that face it count, as in X-ICP (Tuna et al. 2024), and only if the map has had
  them for some sweeps: the rim of what has just been seen moves along with the view;
* the sweep is moved both ways along the direction and matched again: what the residuals pull back,
  divided by what they should if the surfaces were there, is the share of the information that is
  real. The rest is the noise of the gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, POSE, InertialState
from l2lidar_proc.odometry.correspondences import (
    Correspondences,
    pose_jacobian,
    robust_weights,
)

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
