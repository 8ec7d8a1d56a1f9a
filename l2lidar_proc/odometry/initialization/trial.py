"""Attempts to begin a map, at rest or with some velocity, and which of two fits better."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import POSITION
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.registration.alignment import Alignment


class Trial(NamedTuple):
    """Result of one attempt to begin the map.

    Attributes
    ----------
    motions : list of SweepMotion
        One for each sweep; empty if the sweeps contradict it.
    met : bool
        Whether any sweep saw what those before it saw.
    last : Alignment or None
        Of the last sweep, where it was aligned.
    missed : bool
        Whether a sweep at rest fits nowhere.
    """

    motions: list[SweepMotion]
    met: bool
    last: Alignment | None = None
    missed: bool = False

    @property
    def is_doubtful(self) -> bool:
        """Whether the sweeps do not fit together as they do at the right velocity."""
        last = self.last
        return not self.motions or (
            last is not None and last.inlier_ratio < tuning.INITIAL_INLIERS
        )

    def leaves_open(self, share: float) -> bool:
        """Return whether the last sweep fixes a direction less than a share of the strongest."""
        return self.last is not None and weakest_share(self.last.information) < share

    def fits_closer(self, other: Trial, margin: float = 0.0) -> bool:
        """Return whether the last sweep of this trial fits closer than that of another one.

        Where no sweep of the other one met another, there is nothing to compare.

        Parameters
        ----------
        other : Trial
        margin : float
            By so much, as a share of the inliers.
        """
        if not (self.motions and other.motions):
            return not other.motions
        if self.last is None or other.last is None:
            return False
        return self.last.inlier_ratio > other.last.inlier_ratio + margin

    def disproves(self, rest: Trial) -> bool:
        """Return whether this trial, in motion, fits so well that the sensor cannot be at rest.

        The IMU of a carrier that glides may say that it is.
        """
        if not (self.motions and self.met):
            return False
        speed = float(np.linalg.norm(self.motions[0].state.velocity))
        is_closer = not rest.met or self.fits_closer(rest, tuning.INITIAL_CLOSER)
        return is_closer and speed > tuning.INITIAL_REST_SPEED

    def fits_better(self, other: Trial) -> bool:
        """Return whether a trial fits better than another one: far closer, or far more firmly.

        At the right velocity surfaces that face along the corridor agree with each other.
        """
        if self.last is None or other.last is None or not self.last.matched:
            return False
        closer = self.last.inlier_ratio - other.last.inlier_ratio
        fixed, others = (weakest_share(last.information) for last in (self.last, other.last))
        return closer > tuning.INITIAL_FAR_CLOSER or (
            closer > 0.0
            and fixed > tuning.INITIAL_FIXED
            and fixed > tuning.INITIAL_BETTER * others
        )


def weakest_share(information: F64) -> float:
    """Return what an alignment says about the place along its weakest direction, by the strongest.

    Parameters
    ----------
    information : ndarray, shape (18, 18)
    """
    strength = np.linalg.eigvalsh(information[POSITION, POSITION])
    return float(strength[0] / max(strength[-1], 1e-9))
