"""Innovation gate: alignment and prediction that contradict each other are found anew."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import POSITION, VELOCITY
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.innovations import MOTION, Correction, correction
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.registration.alignment import Alignment
from l2lidar_proc.odometry.registration.correspondences import Source


class Prediction(NamedTuple):
    """A predicted motion, and what it makes of the sweep.

    Attributes
    ----------
    motion : SweepMotion
    source : Source
        The points, deskewed by the motion.
    """

    motion: SweepMotion
    source: Source


class GatedAlignment(NamedTuple):
    """Prediction and alignment that agree with each other.

    Attributes
    ----------
    predicted : SweepMotion
        Its covariance is larger where the prediction was too sure of itself.
    source : Source
        Deskewed by it.
    alignment : Alignment or None
        None where the sweep tells nothing that can be believed.
    is_suspect : bool
        Whether the two had contradicted each other.
    """

    predicted: SweepMotion
    source: Source
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
        given: Prediction,
        found: Alignment | None,
        others: Sequence[Callable[[], Prediction]],
        *,
        blurred: bool,
    ) -> GatedAlignment:
        """Return prediction and alignment, found anew if the two contradict each other.

        A prediction that is too sure of itself makes a compromise of both, at which neither fits.
        The sweep is then aligned as after a prediction that may be wrong by as much. A lesser
        contradiction may be the first sign of the same. Or what the IMU felt did not move the
        sensor: a blow on its housing, or a fault.

        Parameters
        ----------
        matcher : SweepMatcher
            That of the alignment.
        given : Prediction
        found : Alignment or None
            Of its points; None where they did not match.
        others : sequence of callable
            Return other predictions, each from less of the IMU than the one before.
        blurred : bool
            The sweep is blurred: what an alignment makes of that is not the motion of the sensor.
        """
        predicted, source = given
        unchanged = GatedAlignment(predicted, source, found, False)
        stamp = int(predicted.state.stamp)
        if found is None:
            if blurred or matcher.is_young or stamp < self._next_check:
                return unchanged
            if len(source.points) < matcher.config.min_points:
                return unchanged
            return self._again(matcher, given, None, others) or unchanged
        before = predicted.covariance
        item = correction(predicted.state, before, found.state, found.covariance)
        wide = inflated_prior(before, item)
        fits_badly = matcher.fits_badly(found)
        if (wide is not None or fits_badly) and blurred:
            covariance = before if wide is None else wide
            return GatedAlignment(
                dataclasses.replace(predicted, covariance=covariance), source, None, True
            )
        is_doubted = item.nis_per_dof >= tuning.NIS_DOUBT and not matcher.is_young
        is_checked = stamp >= self._next_check
        is_due = is_doubted or (is_checked and (fits_badly or matcher.lost_sight(found)))
        if wide is None:
            better = self._again(matcher, given, found, others) if is_due else None
            return better or unchanged
        inflated = given._replace(motion=dataclasses.replace(predicted, covariance=wide))
        other = matcher.match(source, inflated.motion, on_trial=True).alignment
        if other is not None and found.fits_better_than(other, len(source.points)):
            return unchanged._replace(is_suspect=True)
        better = self._again(matcher, inflated, other, others)
        if better is None and other is not None:
            matcher.note_usual(other)
        return better or GatedAlignment(inflated.motion, source, other, True)

    def _again(
        self,
        matcher: SweepMatcher,
        given: Prediction,
        found: Alignment | None,
        others: Sequence[Callable[[], Prediction]],
    ) -> GatedAlignment | None:
        """Return the closest alignment that is better than the one found, if any is.

        It begins from the same prediction, loosely, and from the first of the others. The rest are
        tried only if neither fits well.
        """
        motion, source = given
        stamp = int(motion.state.stamp)
        covariance = with_loose_motion(motion.covariance)
        loose = Prediction(dataclasses.replace(motion, covariance=covariance), source)
        surfaces = matcher.config.surfaces
        best: tuple[Prediction, Alignment] | None = None
        for number, predict in enumerate((lambda: loose, *others)):
            if number > 1 and best is not None and not matcher.fits_badly(best[1]):
                break
            tried = predict()
            other = matcher.match(tried.source, tried.motion, on_trial=True).alignment
            if other is None or not self._is_better(matcher, other, found, len(source.points)):
                continue
            if best is None or other.misfit(surfaces) < best[1].misfit(surfaces):
                best = tried, other
        if best is None:  # what fits no better elsewhere is right, or a new place
            self._next_check = stamp + tuning.DOUBT_PAUSE_NS
            return None
        self._next_check = stamp  # the next prediction may be as wrong
        matcher.note_usual(best[1])
        return GatedAlignment(*best[0], best[1], True)

    def _is_better(
        self, matcher: SweepMatcher, other: Alignment, found: Alignment | None, points: int
    ) -> bool:
        """Return whether another alignment of so many points is right, and the first one wrong."""
        if found is None:
            return other.is_rich(points) and not matcher.fits_badly(other)
        if other.fits_better_than(found, points):
            return True
        # what seems to fix the place along bare walls is another niche
        is_fixed_anew = matcher.driving and not found.fixes_place
        return not is_fixed_anew and other.fits_closer_than(found, matcher.config.surfaces)


def is_narrow(points: F64) -> bool:
    """Return whether a view is narrow: whether its points (N, 3) lie in much the same direction.

    By the length of their mean direction (mean resultant length; Mardia and Jupp 2000, 9.2).
    """
    ranges = np.linalg.norm(points, axis=1)
    directions = points[ranges > 0.0] / ranges[ranges > 0.0, None]
    if not len(directions):
        return True
    return float(np.linalg.norm(directions.mean(axis=0))) > tuning.NARROW_VIEW


def inflated_prior(covariance: F64, item: Correction) -> F64 | None:
    """Return the covariance that a prior must have had, if a correction contradicts it.

    A single correction far beyond what the covariances allow (an innovation gate) means that one
    of the two is wrong. A prior that is too sure of itself would make a compromise of both, at
    which neither fits.

    Parameters
    ----------
    covariance : ndarray, shape (18, 18)
        Of the prior.
    item : Correction

    Returns
    -------
    ndarray, shape (18, 18), or None
        Pose and velocity are as uncertain as the correction shows. None within the gate.
    """
    if item.nis_per_dof < tuning.NIS_GATE:
        return None
    scale = np.ones(len(covariance))
    scale[MOTION] = np.sqrt(item.nis_per_dof)
    return np.asarray(covariance * np.outer(scale, scale))


def with_loose_motion(covariance: F64) -> F64:
    """Return the covariance (18, 18) of a prior whose position and velocity may be wrong."""
    found = covariance.copy()
    found[POSITION, POSITION] += tuning.DOUBT_POSITION_SIGMA**2 * np.eye(3)
    found[VELOCITY, VELOCITY] += tuning.DOUBT_VELOCITY_SIGMA**2 * np.eye(3)
    return found
