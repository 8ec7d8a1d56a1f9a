"""Places that a state has passed: kept for a while, and moved along with what corrects the state.

The difference of two of them then depends on the velocity, not on the place. They are moved along
the way only. Across it, each sweep has measured where it was, better than a velocity tells that is
carried back over seconds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64, I64
from l2lidar_proc.motion.filter import ACCEL_BIAS, GRAVITY, POSITION, VELOCITY, InertialState


def correction_of_passed(before: InertialState, after: InertialState, stamps: I64) -> F64:
    """Return by how much a correction of the state moves what it has placed before, (N, 3) [m].

    The error of the velocity is taken for constant, as that of gravity and of the bias.

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
        Unit vector of the way, map axes.
    """

    def __init__(self, layout: np.dtype[np.void]) -> None:
        self._kept: NDArray[np.void] = np.zeros(0, layout)
        self.along: F64 = np.zeros(3)

    def __len__(self) -> int:
        """Return the number of places kept."""
        return len(self._kept)

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
