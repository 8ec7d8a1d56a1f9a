"""Innovation gate: alignment and prediction that contradict each other are found anew."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import POSITION, VELOCITY, InertialState
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.alignment import Alignment
from l2lidar_proc.odometry.correspondences import Source
from l2lidar_proc.odometry.innovations import MOTION, correction
from l2lidar_proc.odometry.matcher import SweepMatcher


class GatedAlignment(NamedTuple):
    """Prediction and alignment that agree with each other.

    Attributes
    ----------
    predicted : SweepMotion
        Its covariance is larger where the prediction was too sure of itself.
    alignment : Alignment or None
        None where the sweep tells nothing that can be believed.
    is_suspect : bool
        Whether the two had contradicted each other.
    """

    predicted: SweepMotion
    alignment: Alignment | None
    is_suspect: bool


class InnovationGate:
    """Finds an alignment anew that contradicts its prediction, or fits badly."""

    def __init__(self) -> None:
        self._next_check = 0  # stamp from which on a sweep that fits badly is aligned again

    def restart(self, stamp: HostNs) -> None:
        """Go on at an instant of another time line."""
        self._next_check = int(stamp)

    def passed(
        self,
        matcher: SweepMatcher,
        source: Source,
        predicted: SweepMotion,
        found: Alignment,
        *,
        blurred: bool,
    ) -> GatedAlignment:
        """Return prediction and alignment, found anew if the two contradict each other.

        A prediction that is too sure of itself makes a compromise of both, at which neither fits.
        The sweep is then aligned as after a prediction that may be wrong by as much.

        Parameters
        ----------
        matcher : SweepMatcher
            That of the alignment.
        source : Source
        predicted : SweepMotion
        found : Alignment
        blurred : bool
            The sweep is blurred: what an alignment makes of that is not the motion of the sensor.
        """
        prior, many = predicted.state, len(source.points)
        wide = inflated_prior(prior, predicted.covariance, found.state, found.covariance)
        fits_badly = matcher.fits_badly(found)
        if (wide is not None or fits_badly) and blurred:
            covariance = predicted.covariance if wide is None else wide
            return GatedAlignment(
                dataclasses.replace(predicted, covariance=covariance), None, True
            )
        is_due = prior.stamp >= self._next_check and fits_badly
        if wide is None and not is_due:
            return GatedAlignment(predicted, found, False)
        self._next_check = prior.stamp + tuning.DOUBT_PAUSE_NS
        covariance = with_loose_motion(predicted.covariance if wide is None else wide)
        loose = dataclasses.replace(predicted, covariance=covariance)
        other = matcher.match(source, loose).alignment
        if other is not None and other.fits_better_than(found, many):
            return GatedAlignment(loose, other, True)
        if wide is None:
            return GatedAlignment(predicted, found, False)
        loose = dataclasses.replace(predicted, covariance=wide)
        other = matcher.match(source, loose).alignment
        if other is not None and found.fits_better_than(other, many):
            return GatedAlignment(predicted, found, True)
        return GatedAlignment(loose, other, True)


def inflated_prior(
    prior: InertialState, covariance: F64, posterior: InertialState, corrected: F64
) -> F64 | None:
    """Return the covariance that a prior must have had, if a correction contradicts it.

    A single correction far beyond what the covariances allow (an innovation gate) means that one
    of the two is wrong. A prior that is too sure of itself would make a compromise of both, at
    which neither fits.

    Parameters
    ----------
    prior, covariance, posterior, corrected
        As for :func:`~l2lidar_proc.odometry.innovations.correction`.

    Returns
    -------
    ndarray, shape (18, 18), or None
        Pose and velocity are as uncertain as the correction shows. None within the gate.
    """
    item = correction(prior, covariance, posterior, corrected)
    nis = item.squared / max(item.freedoms, 1)
    if nis < tuning.NIS_GATE:
        return None
    scale = np.ones(len(covariance))
    scale[MOTION] = np.sqrt(nis)
    return np.asarray(covariance * np.outer(scale, scale))


def with_loose_motion(covariance: F64) -> F64:
    """Return the covariance (18, 18) of a prior whose position and velocity may be wrong."""
    found = covariance.copy()
    found[POSITION, POSITION] += tuning.DOUBT_SIGMA[0] ** 2 * np.eye(3)
    found[VELOCITY, VELOCITY] += tuning.DOUBT_SIGMA[1] ** 2 * np.eye(3)
    return found
