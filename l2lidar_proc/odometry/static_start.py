"""Begins the map with the sweeps of a sensor that stands still."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs, Sweep
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.prediction import Predictor
from l2lidar_proc.odometry.sweep_motion import SweepMotion
from l2lidar_proc.odometry.zero_velocity import Standstill, free_to_differ

F64 = NDArray[np.float64]


class StandingStart(NamedTuple):
    """What came of it.

    Attributes
    ----------
    motions : list of SweepMotion
        None that moves; empty if the sweeps tell that the sensor does.
    met : bool
        Whether any sweep saw what those before it saw.
    """

    motions: list[SweepMotion]
    met: bool


def begun(
    sweeps: list[Sweep],
    since: HostNs,
    state: InertialState,
    covariance: F64,
    predictor: Predictor,
    matcher: SweepMatcher,
    standstill: Standstill,
) -> StandingStart:
    """Add sweeps to an empty map where they would be at rest, as long as they agree.

    Parameters
    ----------
    sweeps : list of Sweep
    since : HostNs
        The first motion reaches back to it.
    state : InertialState
        At the reference of the first sweep, where the sensor stands.
    covariance : ndarray, shape (18, 18)
    predictor : Predictor
    matcher : SweepMatcher
    standstill : Standstill
        Anchored at the state.
    """
    motions: list[SweepMotion] = []
    met = False
    for sweep in sweeps:
        before = motions[-1].state if motions else state
        reach = None if motions else since
        motion = predictor.over_sweep(sweep, before, covariance, reach).at_rest(state, covariance)
        if motions:
            source = matcher.source(sweep, motion)
            trial = motion.at_rest(state, free_to_differ())
            found, uncharted = matcher.match(source, trial, opening=True)
            met |= found is not None
            if not (uncharted if found is None else standstill.stays(found)):
                return StandingStart([], False)
        motions.append(motion)
        matcher.extend(motion.deskewed(sweep, matcher.lever), motion, motion.state)
    return StandingStart(motions, met)
