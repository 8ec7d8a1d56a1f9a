"""Corrections of a unit's beam angles and ranges, and the errors that they leave."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from l2lidar_node.types import F64
from l2lidar_proc import tuning


class Corrections(NamedTuple):
    """What is added to what a unit reports, as far as its errors are known.

    Attributes
    ----------
    angles : ndarray, shape (3,)
        To ``xi_angle``, ``beta_angle`` and ``alpha_angle_bias`` [rad].
    ranges : float
        [m]
    """

    angles: F64
    ranges: float

    def differ_from(self, others: Corrections) -> bool:
        """Return whether clouds with these are so different that a map should begin again.

        By BEAM_CHANGE [rad] of any angle, or RANGE_BIAS_CHANGE [m], of ``tuning``.

        Parameters
        ----------
        others : Corrections
        """
        angle = float(np.abs(self.angles - others.angles).max())
        shift = abs(self.ranges - others.ranges)
        return angle > tuning.BEAM_CHANGE or shift > tuning.RANGE_BIAS_CHANGE


class IntrinsicErrors(NamedTuple):
    """What corrected clouds may be wrong by, 1 sigma.

    Attributes
    ----------
    beams : tuple of float
        Of xi and beta, along their best known direction and the other [rad].
    alpha : float
        [rad]
    ranges : float
        [m]
    """

    beams: tuple[float, float]
    alpha: float
    ranges: float
