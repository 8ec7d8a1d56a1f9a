"""Innovations: how alignments correct predictions, against the assumed noise.

Each alignment corrects what the IMU predicted. By how much it may is known: the covariance of the
correction is the prior's less the posterior's. The corrections of some seconds show two things.
Their size shows whether the noise is as assumed: the mean of the normalized innovation squared
(NIS) is 1 for each degree of freedom (Bar-Shalom et al. 2001, section 5.4). Their sum shows
whether the accelerometer, with biases and gravity as estimated, contradicts the alignments:
corrections of the velocity that are all alike do not average out. The reported variances are
scaled accordingly, up or down. Neither sees an error along a direction that nothing measures: as
long as there is one, the variances are not scaled down.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

import numpy as np

from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import POSE, VELOCITY, InertialState

MOTION: Final = slice(POSE.start, VELOCITY.stop)
"""Errors of turn, place and velocity."""

_VELOCITY: Final = slice(VELOCITY.start - POSE.start, VELOCITY.stop - POSE.start)


class Correction(NamedTuple):
    """How an alignment has corrected a prediction.

    Attributes
    ----------
    stamp : int
        Of the posterior [ns].
    squared : float
        Normalized and squared, the sum over all degrees of freedom.
    freedoms : int
        Degrees of freedom that were measured.
    velocity : ndarray, shape (3,)
        Correction of the velocity, map axes [m/s].
    allowed : ndarray, shape (3, 3)
        Its covariance.
    """

    stamp: int
    squared: float
    freedoms: int
    velocity: F64
    allowed: F64

    @property
    def nis_per_dof(self) -> float:
        """Normalized innovation squared, for each degree of freedom."""
        return self.squared / max(self.freedoms, 1)


def correction(
    prior: InertialState, covariance: F64, posterior: InertialState, corrected: F64
) -> Correction:
    """Return how an alignment has corrected a prediction.

    Parameters
    ----------
    prior : InertialState
        As predicted.
    covariance : ndarray, shape (18, 18)
        Of the prior.
    posterior : InertialState
        As aligned.
    corrected : ndarray, shape (18, 18)
        Covariance of the posterior.
    """
    before = covariance[MOTION, MOTION]
    allowed = before - corrected[MOTION, MOTION]
    change = posterior.boxminus(prior)[MOTION]
    unit = np.sqrt(np.maximum(np.diag(before), 1e-18))
    # only directions that were measured: elsewhere nothing was corrected, nor could be
    share, axes = np.linalg.eigh(allowed / np.outer(unit, unit))
    seen = share > tuning.NIS_SEEN
    normalized = (axes[:, seen].T @ (change / unit)) ** 2 / share[seen]
    return Correction(
        posterior.stamp,
        float(normalized.sum()),
        int(seen.sum()),
        change[_VELOCITY],
        allowed[_VELOCITY, _VELOCITY],
    )


def _lowered(ratio: float, most: float) -> float:
    """Return the factor, at most 1, on assumed variances; the ratio is that of observed ones."""
    return min(max(tuning.NIS_MARGIN * ratio, 1.0 / most), 1.0)


def observed_scale(covariance: F64, factor: float, unobserved: F64) -> F64:
    """Return the matrix (3, 3) that scales a vector's errors, but not along some directions.

    The variance along these directions stays, and what of the other errors they explain; the rest
    is multiplied by a factor. With G the regression of the errors on those along the directions,
    G + sqrt(factor) (I - G) does so, as G v and (I - G) v are not correlated.

    Parameters
    ----------
    covariance : ndarray, shape (3, 3)
        Of the vector.
    factor : float
        At most 1.
    unobserved : ndarray, shape (3, K)
        Orthonormal.
    """
    if factor >= 1.0:
        return np.eye(3)
    along = covariance @ unobserved
    regression = along @ np.linalg.solve(unobserved.T @ along, unobserved.T)
    return np.asarray(regression + np.sqrt(factor) * (np.eye(3) - regression))


class InnovationTest:
    """Compares the innovations of the last seconds with their covariances."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget everything, as after a rest or a loss."""
        self._recent: deque[Correction] = deque()
        self._unobserved: deque[tuple[int, F64]] = deque()  # stamps, and directions (3, K)

    def note_unobserved(self, stamp: int, directions: F64) -> None:
        """Note that a sweep did not observe the position in every direction.

        Parameters
        ----------
        stamp : int
            Of the sweep [ns].
        directions : ndarray, shape (3, K)
            In which it did not, orthonormal, map axes.
        """
        noted = self._unobserved
        noted.append((stamp, directions))
        while stamp - noted[0][0] > tuning.NIS_WINDOW_NS:
            noted.popleft()

    def take(
        self,
        prior: InertialState,
        covariance: F64,
        posterior: InertialState,
        corrected: F64,
    ) -> None:
        """Take an alignment, given as to :func:`correction`."""
        item = correction(prior, covariance, posterior, corrected)
        if not item.freedoms:
            return
        recent = self._recent
        recent.append(item)
        while recent[-1].stamp - recent[0].stamp > tuning.NIS_WINDOW_NS:
            recent.popleft()

    @property
    def nis_per_dof(self) -> float:
        """Mean normalized innovation squared for each degree of freedom; 0 before the first."""
        freedoms = sum(item.freedoms for item in self._recent)
        return sum(item.squared for item in self._recent) / max(freedoms, 1)

    @property
    def velocity_nis_per_dof(self) -> float:
        """Normalized square of the sum of all corrections of the velocity, for each of its axes.

        1 on average if they are independent; 0 as long as there are few.
        """
        if len(self._recent) < tuning.NIS_LEAST:
            return 0.0
        total = np.sum([item.velocity for item in self._recent], axis=0)
        allowed = np.sum([item.allowed for item in self._recent], axis=0)
        allowed = allowed + tuning.NIS_SPEED_FLOOR**2 * np.eye(3)
        return float(total @ np.linalg.solve(allowed, total)) / 3.0

    @property
    def _ratio(self) -> float | None:
        """What variances are to those assumed; None while there are few corrections."""
        if len(self._recent) < tuning.NIS_LEAST:
            return None
        return max(self.nis_per_dof, self.velocity_nis_per_dof / tuning.NIS_CHANCE)

    @property
    def expected_share(self) -> float:
        """Share of the variances of poses that they are expected to add to the map's drift.

        Also where a direction is not measured: along it the drift is that of the velocity.
        """
        found = self._ratio
        if found is None:
            return 1.0
        return min(max(tuning.NIS_DRIFT_MARGIN * found, 1.0 / tuning.NIS_MOST), 1.0)

    @property
    def variance_factor(self) -> float:
        """Factor by which variances are to be reported larger, or smaller where below 1.

        Smaller only where every direction was measured throughout the window.
        """
        found = self._ratio
        if found is None:
            return 1.0
        if found >= 1.0:
            return min(found, tuning.NIS_MOST)
        return 1.0 if self.unobserved.size else _lowered(found, tuning.NIS_MOST)

    @property
    def velocity_factor(self) -> float:
        """Further factor, at most 1, on the variances of the velocity where they are measured.

        Of use where some direction was not measured throughout the window: along the others the
        velocity is known as well as the innovations show. Poses are not: in narrow views they err
        with the surfaces that they have put into the map themselves.
        """
        found = self._ratio
        if found is None or self.unobserved.shape[1] not in (1, 2):
            return 1.0
        return _lowered(found, tuning.NIS_PARTLY_MOST)

    @property
    def unobserved(self) -> F64:
        """Directions (3, K), orthonormal, map axes, not measured throughout the window."""
        first = self._recent[-1].stamp - tuning.NIS_WINDOW_NS if self._recent else 0
        found = [directions for stamp, directions in self._unobserved if stamp >= first]
        if not found:
            return np.zeros((3, 0))
        together = np.concatenate(found, axis=1)
        strength, axes = np.linalg.eigh(together @ together.T)
        return np.asarray(axes[:, strength > tuning.NIS_UNOBSERVED**2 * len(found)])

    @property
    def contradicts(self) -> bool:
        """Whether chance does not explain the corrections."""
        return self.variance_factor > tuning.NIS_SUSPECT
