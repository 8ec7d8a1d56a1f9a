"""Innovation consistency test: whether predictions are as good as their covariance says.

Each alignment corrects what the IMU predicted. How much it may is known: the covariance of the
correction is the prior's less the posterior's. Over some seconds the corrections tell two things.
Their size shows whether the noise is as assumed: the mean of the normalized innovation squared
(NIS) is 1 for each degree of freedom (Bar-Shalom et al. 2001, section 5.4). Their sum shows
whether the accelerometer, with biases and gravity as estimated, contradicts the alignments:
corrections of the velocity that are all alike do not average out. Neither sees an error along a
direction that nothing measures.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import POSE, VELOCITY, InertialState

F64 = NDArray[np.float64]

_MOTION: Final = slice(POSE.start, VELOCITY.stop)  # turn, place and velocity
_VELOCITY: Final = slice(VELOCITY.start - POSE.start, VELOCITY.stop - POSE.start)


class _Correction(NamedTuple):
    stamp: int
    squared: float  # normalized, of all degrees of freedom
    freedoms: int
    velocity: F64  # correction of the velocity, map axes [m/s], shape (3,)
    allowed: F64  # its covariance, shape (3, 3)


class InnovationTest:
    """Compares the corrections of the last seconds with their covariances."""

    def __init__(self) -> None:
        self._recent: deque[_Correction] = deque()

    def clear(self) -> None:
        """Forget everything, as after a rest or a loss."""
        self._recent.clear()

    def take(
        self,
        prior: InertialState,
        covariance: F64,
        posterior: InertialState,
        corrected: F64,
    ) -> None:
        """Take an alignment.

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
        before = covariance[_MOTION, _MOTION]
        allowed = before - corrected[_MOTION, _MOTION]
        change = posterior.boxminus(prior)[_MOTION]
        unit = np.sqrt(np.maximum(np.diag(before), 1e-18))
        # only directions that were measured: elsewhere nothing was corrected, nor could be
        share, axes = np.linalg.eigh(allowed / np.outer(unit, unit))
        seen = share > tuning.NIS_SEEN
        if not seen.any():
            return
        normalized = (axes[:, seen].T @ (change / unit)) ** 2 / share[seen]
        recent = self._recent
        recent.append(
            _Correction(
                posterior.stamp,
                float(normalized.sum()),
                int(seen.sum()),
                change[_VELOCITY],
                allowed[_VELOCITY, _VELOCITY],
            )
        )
        while recent[-1].stamp - recent[0].stamp > tuning.NIS_WINDOW_NS:
            recent.popleft()

    @property
    def nis(self) -> float:
        """Mean normalized innovation squared for each degree of freedom; 0 before the first."""
        freedoms = sum(item.freedoms for item in self._recent)
        return sum(item.squared for item in self._recent) / max(freedoms, 1)

    @property
    def velocity_nis(self) -> float:
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
    def excess(self) -> float:
        """By how much variances are too small, at least 1."""
        if len(self._recent) < tuning.NIS_LEAST:
            return 1.0
        worse = max(self.nis, self.velocity_nis / tuning.NIS_CHANCE, 1.0)
        return min(worse, tuning.NIS_MOST)

    @property
    def contradicts(self) -> bool:
        """Whether chance does not explain the corrections."""
        return self.excess > tuning.NIS_SUSPECT
