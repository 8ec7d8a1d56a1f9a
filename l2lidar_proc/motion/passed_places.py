"""Places passed in the last seconds, which each correction of the state moves as well.

So the distance between two of them depends on the velocity, not on the pose. They are moved along
the direction of travel only: across it, each sweep has measured its own place better than a
velocity that is carried back over seconds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64, I64
from l2lidar_proc.motion.filter import ACCEL_BIAS, GRAVITY, POSITION, VELOCITY, InertialState


def correction_of_passed(before: InertialState, after: InertialState, stamps: I64) -> F64:
    """Return how far a correction of the state moves places seen before it, (N, 3) [m].

    Assumes that the errors of velocity, gravity and bias were constant meanwhile.

    Parameters
    ----------
    before, after : InertialState
        At the same instant.
    stamps : ndarray, shape (N,)
        When the places were seen [ns].
    """
    change = after.boxminus(before)
    force = change[GRAVITY] - after.rotation @ change[ACCEL_BIAS]
    tau = ((int(after.stamp) - stamps) * 1e-9)[:, None]
    return np.asarray(
        change[POSITION] - tau * change[VELOCITY] + 0.5 * tau * tau * force, np.float64
    )


class PassedPlaces:
    """Places of the last seconds, as records of one layout.

    Parameters
    ----------
    layout : dtype
        With ``stamp`` [ns] and ``place`` [m], map frame, shape (3,).

    Attributes
    ----------
    along : ndarray, shape (3,)
        Direction of travel, unit, map axes.
    """

    def __init__(self, layout: np.dtype[np.void]) -> None:
        self._kept: NDArray[np.void] = np.zeros(0, layout)
        self.along: F64 = np.zeros(3)

    def clear(self) -> None:
        """Forget all places."""
        self._kept = self._kept[:0]

    def correct(self, before: InertialState, after: InertialState) -> None:
        """Move the places along with a correction of the state at one instant.

        Parameters
        ----------
        before, after : InertialState
            At the same instant, not before the places'.
        """
        if len(self._kept):
            moves = correction_of_passed(before, after, self._kept["stamp"])
            self._kept["place"] += np.outer(moves @ self.along, self.along)
