"""Sweeps of the rest with which a map began: the map may begin again with them.

A carrier that glides while its motors shake the IMU passes for a sensor at rest, and so does one
that creeps. So the sweeps of the first rest are kept for some seconds, as the unit reports them.
If the IMU or later sweeps show that the sensor moves, it may have moved since the start: then the
map begins again with the sweeps as in motion, if that fits. The map also begins again when the
intrinsics of the unit are known better than in the map, during the rest or in the first seconds
after it.
"""

from __future__ import annotations

import dataclasses
from enum import Enum
from typing import NamedTuple

import numpy as np

from l2lidar_node.types import F64, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import InertialState, with_loose_pose
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.initialization.map_initialization import (
    InitializedMap,
    MapInitializer,
    NotBegun,
)
from l2lidar_proc.odometry.intrinsics.lidar_intrinsics import LidarIntrinsics
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.registration.correspondences import Source
from l2lidar_proc.odometry.zero_velocity import ZeroVelocityTest


class Remapping(Enum):
    """Whether the map of a rest has begun again, and whether the rest stands then."""

    NONE = "the map stays as it is"
    CONFIRMED = "the map has begun again, and the rest stands"
    REFUTED = "the map has begun again, and its sweeps show motion"


class EndedRest(NamedTuple):
    """A rest that motion has ended.

    Attributes
    ----------
    sweeps : list of Sweep
        As the unit would have measured them with what is known of it now.
    state : InertialState
        At rest, at any stamp.
    covariance : ndarray, shape (18, 18)
    moved : ndarray, shape (6, 6)
        Covariance of the shift and turn by which this may move poses [m, rad].
    """

    sweeps: list[Sweep]
    state: InertialState
    covariance: F64
    moved: F64


class RemappedRest(NamedTuple):
    """A map that has begun again with a rest that motion has ended.

    Attributes
    ----------
    matcher : SweepMatcher
        With the map; the latest sweep is in it.
    motion : SweepMotion
        Of the latest sweep, in the map.
    fresh : float
        Share of its points that fell where there was no map before.
    """

    matcher: SweepMatcher
    motion: SweepMotion
    fresh: float


class FirstRest:
    """The sweeps of the first rest.

    Parameters
    ----------
    initializer : MapInitializer
    zero_velocity : ZeroVelocityTest
    intrinsics : LidarIntrinsics

    Attributes
    ----------
    initializer : MapInitializer
        Begins the map again; to be replaced by that of each map that goes on from there.
    sweeps : list of Sweep
        As the unit reports them, oldest first; none if the map did not begin at rest, or so long
        ago that the rest is beyond doubt.
    """

    def __init__(
        self,
        initializer: MapInitializer,
        zero_velocity: ZeroVelocityTest,
        intrinsics: LidarIntrinsics,
    ) -> None:
        self.initializer = initializer
        self._zero_velocity = zero_velocity
        self._intrinsics = intrinsics
        self._mapped_with = intrinsics.corrections  # the sweeps in the map
        self.sweeps: list[Sweep] = []
        # its sweeps, and state and covariance at its end, for a moment
        self._ended: tuple[list[Sweep], InertialState, F64] | None = None

    def begin(self, sweeps: list[Sweep]) -> None:
        """Take the sweeps with which a map has begun at rest."""
        self.sweeps, self._mapped_with = sweeps, self._intrinsics.corrections
        self._ended = None

    def note(self, sweep: Sweep) -> None:
        """Take another sweep of this rest, if it is still the first one."""
        if self.sweeps:
            self.sweeps.append(sweep)

    def end(self) -> None:
        """Forget all of it."""
        self.sweeps, self._ended = [], None

    def end_with(self, state: InertialState, covariance: F64, *, moving: int = 0) -> None:
        """Take that motion has ended the rest; its sweeps are kept for a moment.

        Parameters
        ----------
        state : InertialState
            At rest, at any stamp.
        covariance : ndarray, shape (18, 18)
        moving : int
            So many of the latest sweeps show the motion.
        """
        rested = self.sweeps[: len(self.sweeps) - moving]
        self.end()
        self._ended = (rested, state, covariance) if rested else None

    def recalibrated(self, now: InertialState) -> EndedRest | None:
        """Return the rest that has just ended with what is known of the unit now, if that is more.

        Where the sensor sees to one side only, corrected angles and ranges shift it against a map
        without them, and nothing would undo that: in a hall, 34 mm of range shifted it by 37 mm.
        With the same knowledge the rest is returned only once.

        Parameters
        ----------
        now : InertialState
            In motion.
        """
        if self._ended is None:
            return None
        sweeps, state, covariance = self._ended
        far = float(np.linalg.norm(now.position - state.position))
        if now.stamp - sweeps[-1].end > tuning.ENDED_REST_NS or far > tuning.ENDED_REST_M:
            self._ended = None
        if self._ended is None or not self._is_known_better:
            return None
        known, before = self._intrinsics.corrections, self._mapped_with
        angle = float(np.abs(known.angles - before.angles).max())
        turn = tuning.BEAM_DRIFT_TURN * angle
        shift = tuning.BEAM_DRIFT_SHIFT * angle + abs(known.ranges - before.ranges)
        self._mapped_with = known  # tried once with what is known now
        return EndedRest(
            [self._intrinsics.applied_to(one) for one in sweeps],
            state,
            covariance,
            np.diag(np.square([shift] * 3 + [turn] * 3)),
        )

    def mapped_again(self, reported: Sweep, motion: SweepMotion) -> RemappedRest | None:
        """Return the map begun again with a rest that has just ended, if the unit is known better.

        None also where the latest sweep does not meet that map.

        Parameters
        ----------
        reported : Sweep
            The latest, as the unit reports it.
        motion : SweepMotion
            Of that sweep, in the map in use.
        """
        ended = self.recalibrated(motion.state)
        if ended is None:
            return None
        initializer = self.initializer.for_another_map()
        initializer.matcher.drift.corrections = self._intrinsics.corrections
        initializer.map_rest(ended.sweeps, ended.state, ended.covariance)
        matcher, sweep = initializer.matcher, self._intrinsics.applied_to(reported)
        covariance = with_loose_pose(motion.state, motion.covariance, ended.moved)
        loose = dataclasses.replace(motion, covariance=covariance)
        found = matcher.match(matcher.source(sweep, loose), loose).alignment
        if found is None:
            return None
        matcher.meet(found, 0.0)
        motion = motion.with_state(found.state, found.covariance)
        fresh = matcher.extend(matcher.deskewed(sweep, motion), motion, motion.state)
        return RemappedRest(matcher, motion, fresh)

    def end_doubt(self) -> None:
        """Keep no sweeps of a rest that has lasted so long that it was one."""
        if self.sweeps and self.sweeps[-1].end - self.sweeps[0].start > tuning.RETRY_NS:
            self.sweeps = []

    def map_with_known_beams(self, still: SweepMotion, *, doubted: bool) -> Remapping:
        """Begin the map again, if the beams are known better than in it.

        Sweeps that deviate only in the new map do not refute the rest, as people who walk by make
        them deviate too. If the sensor does move, the next sweeps show it.

        Parameters
        ----------
        still : SweepMotion
            Of the latest sweep.
        doubted : bool
            The sweeps deviate: the beams are estimated now, whenever that was done last.
        """
        if not self.sweeps:
            return Remapping.NONE
        if doubted or self._intrinsics.is_due_at_rest(self.sweeps):
            self._intrinsics.learn_at_rest(self.sweeps, still.state.rest_force)
        if not self._is_known_better:
            return Remapping.NONE
        self._mapped_with = self._intrinsics.corrections
        better = [self._intrinsics.applied_to(one) for one in self.sweeps]
        self.initializer.matcher.drift.corrections = self._intrinsics.corrections
        start = still.state, still.covariance
        if self.initializer.begin_again_at_rest(better, *start):
            return Remapping.CONFIRMED
        if doubted:
            return Remapping.REFUTED
        self.initializer.map_rest(better, *start)
        self._zero_velocity.resume(still.state)
        return Remapping.CONFIRMED

    def resume_if_beams_explain(self, still: SweepMotion, seen: Source) -> bool:
        """Resume the rest if unknown beam angles may be why sweeps deviate; return whether so.

        Parameters
        ----------
        still : SweepMotion
            Of the latest sweep.
        seen : Source
            Its points.
        """
        if not self.sweeps or self._intrinsics.is_other:
            return False
        worse = self._intrinsics.errors.beams[1]
        turn, shift = tuning.BEAM_DRIFT_TURN * worse, tuning.BEAM_DRIFT_SHIFT * worse
        rotation, middle = still.state.rotation, seen.points.mean(axis=0)
        if not self._zero_velocity.has_drifted_within(turn, shift, rotation, middle):
            return False
        self._zero_velocity.resume(still.state)
        return True

    def begun_in_motion(
        self, sweeps: list[Sweep], state: InertialState, covariance: F64
    ) -> InitializedMap | None:
        """Return the map begun again as in motion, if the IMU has soon ended what passed for rest.

        Parameters
        ----------
        sweeps : list of Sweep
            All those of the rest.
        state : InertialState
            At rest, at any stamp.
        covariance : ndarray, shape (18, 18)
        """
        if not sweeps or sweeps[-1].end - sweeps[0].start > tuning.RETRY_SHORT_NS:
            return None
        motions = self.initializer.begin_again_in_motion(sweeps, state, covariance)
        if not motions:
            return None
        self._forget_intrinsics()
        return InitializedMap(motions, sweeps, 0, sweeps[0].start)

    def retried(self, sweeps: list[Sweep]) -> InitializedMap | None:
        """Return the map begun again, as in motion, with sweeps that have shown motion.

        None if that does not fit, or leads too far away for what passed for a rest.

        Parameters
        ----------
        sweeps : list of Sweep
            All those of the rest.
        """
        self._forget_intrinsics()
        for may_rest in (False, True):
            motions = self.initializer.begin(sweeps, sweeps[0].start, may_rest)
            if not isinstance(motions, NotBegun):
                way = float(np.linalg.norm(motions[-1].state.position))
                if way < tuning.RETRY_FARTHEST_M:
                    return InitializedMap(motions, sweeps, 0, sweeps[0].start)
        return None

    def _forget_intrinsics(self) -> None:
        """Forget what the beams have shown of themselves: the sensor moved."""
        self._intrinsics.forget()
        self._mapped_with = self._intrinsics.corrections

    @property
    def _is_known_better(self) -> bool:
        """Whether the unit is known to be wrong by more than in the map."""
        return self._intrinsics.corrections.differ_from(self._mapped_with)
