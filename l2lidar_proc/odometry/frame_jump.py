"""Uncertainty of the map's own place in the odometry frame, after losses and jumps of time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import POSITION, ROTATION, InertialState, skew

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class FrameJump:
    """How wrong the map's place in the odometry frame may be; nothing at the beginning.

    Alignment with the map cannot tell, so this stays for good.

    Attributes
    ----------
    place : ndarray, shape (3,)
        Where the latest jump happened, odometry frame [m].
    covariance : ndarray, shape (6, 6)
        Of x, y, z and of the turns about the frame's axes, there [m, rad].
    """

    place: F64 = field(default_factory=lambda: np.zeros(3))
    covariance: F64 = field(default_factory=lambda: np.zeros((6, 6)))

    def at(self, place: F64) -> F64:
        """Return the covariance (6, 6) at another place (3,): a turn moves what is far away."""
        carried = np.eye(6)
        carried[:3, 3:] = -skew(place - self.place)
        return np.asarray(carried @ self.covariance @ carried.T)

    def added(self, state: InertialState, covariance: F64, drift: F64) -> FrameJump:
        """Return this and a further jump.

        Parameters
        ----------
        state : InertialState
            Where it happens.
        covariance : ndarray, shape (18, 18)
            Of the state, relative to the map before.
        drift : ndarray, shape (6, 6)
            Of that map itself, at the state's place.
        """
        errors = np.r_[POSITION, ROTATION]
        axes = np.eye(6)
        axes[3:, 3:] = state.rotation
        jump = axes @ covariance[np.ix_(errors, errors)] @ axes.T
        return FrameJump(state.position, self.at(state.position) + jump + drift)

    def unseen(self, state: InertialState) -> FrameJump:
        """Return this and what may have happened from a state on while no time was told."""
        way = tuning.UNSEEN_POSITION + tuning.UNSEEN_S * float(np.linalg.norm(state.velocity))
        jump = np.diag(np.square([way] * 3 + [tuning.UNSEEN_ROTATION] * 3))
        return FrameJump(state.position, self.at(state.position) + jump)
