"""Earlier maps: kept when the odometry is lost, and searched until one is matched again.

A map begun after a loss lies in the odometry frame where the prediction had come to, and stays as
uncertain as that for good. When a sweep meets an earlier map, the odometry goes on in that one
and the pose jumps back. A wrong jump is worse than none, so a meeting counts only if it fixes the
place in every direction and the next one says the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import (
    GRAVITY,
    POSE,
    POSITION,
    ROTATION,
    VELOCITY,
    InertialState,
    with_loose_pose,
)
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.alignment import Alignment, unobserved_directions
from l2lidar_proc.odometry.correspondences import Source
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.uncertainty import FrameJump


@dataclass(frozen=True, slots=True, eq=False)
class EarlierMap:
    """A map that was in use until the odometry was lost.

    Attributes
    ----------
    matcher : SweepMatcher
    jump : FrameJump
        How uncertain its place in the odometry frame is.
    """

    matcher: SweepMatcher
    jump: FrameJump


@dataclass(frozen=True, slots=True, eq=False)
class Return:
    """The way back into an earlier map.

    Attributes
    ----------
    map : EarlierMap
    alignment : Alignment
        Of the sweep with it.
    """

    map: EarlierMap
    alignment: Alignment


class EarlierMaps:
    """The maps of the last losses, oldest first."""

    def __init__(self) -> None:
        self._maps: list[EarlierMap] = []
        self._next_search = 0
        self._lost_at = 0
        self._met: tuple[EarlierMap, F64] | None = None  # where its last meeting moves the poses

    def __len__(self) -> int:
        """Return the number of maps kept."""
        return len(self._maps)

    def __iter__(self) -> Iterator[EarlierMap]:
        """Iterate over the maps kept."""
        return iter(self._maps)

    def keep(self, matcher: SweepMatcher, jump: FrameJump, stamp: HostNs) -> None:
        """Keep a map that is left at an instant, and no more than a few of the largest."""
        self._met = None
        self._lost_at = int(stamp)
        self._next_search = self._lost_at + tuning.EARLIER_PAUSE_NS
        self._maps.append(EarlierMap(matcher, jump))
        if len(self._maps) > tuning.EARLIER_MAPS:
            self._maps.remove(min(self._maps, key=lambda kept: len(kept.matcher.surfaces)))

    def is_due(self, stamp: HostNs) -> bool:
        """Return whether the maps should be searched now: ever more rarely."""
        return bool(self._maps) and int(stamp) >= self._next_search

    def search(self, source: Source, motion: SweepMotion, jump: FrameJump) -> Return | None:
        """Return the way back into a map that a sweep meets for the second time.

        Parameters
        ----------
        source : Source
            Deskewed by the motion.
        motion : SweepMotion
            In the map in use.
        jump : FrameJump
            Of the map in use.
        """
        stamp = int(motion.state.stamp)
        pause = int(tuning.EARLIER_PAUSE_SHARE * (stamp - self._lost_at))
        self._next_search = stamp + max(tuning.EARLIER_PAUSE_NS, pause)
        for kept in self._maps:
            found = _met_in(kept, source, motion, jump)
            if found is None:
                continue
            moves = _pose(found.state) @ np.linalg.inv(_pose(motion.state))
            before, self._met = self._met, (kept, moves)
            if before is not None and before[0] is kept and _are_one(before[1], moves):
                self._met = None
                self._maps.remove(kept)
                return Return(kept, found)
            self._next_search = stamp + 1
            return None
        self._met = None
        return None


def _met_in(
    kept: EarlierMap, source: Source, motion: SweepMotion, jump: FrameJump
) -> Alignment | None:
    """Return how a sweep meets an earlier map, if it does beyond doubt."""
    state = motion.state
    between = jump.at(state.position) - kept.jump.at(state.position)
    if np.trace(between) < 0.0:  # the kept one is the younger
        between = -between
    loose = with_loose_pose(state, motion.covariance, between)
    rough, _ = kept.matcher.match(source, dataclasses.replace(motion, covariance=loose))
    if rough is None:
        return None
    # velocity and gravity turn with the pose, which the search alone does not know
    there = moved(state, _pose(rough.state) @ np.linalg.inv(_pose(state)))
    turn = there.rotation @ state.rotation.T
    axes = np.eye(len(motion.covariance))
    for block in (POSITION, VELOCITY, GRAVITY):
        axes[block, block] = turn
    covariance = axes @ motion.covariance @ axes.T
    covariance[POSE, :] = covariance[:, POSE] = 0.0
    covariance[ROTATION, ROTATION] = tuning.EARLIER_SIGMA[0] ** 2 * np.eye(3)
    covariance[POSITION, POSITION] = tuning.EARLIER_SIGMA[1] ** 2 * np.eye(3)
    found, _ = kept.matcher.match(
        source, dataclasses.replace(motion, state=there, covariance=covariance)
    )
    if found is None or unobserved_directions(found.information[POSITION, POSITION]).size:
        return None
    return found


def moved(state: InertialState, transform: F64) -> InertialState:
    """Return a state in another map frame; ``transform`` (4, 4) takes this one's points there."""
    turn, shift = transform[:3, :3], transform[:3, 3]
    return dataclasses.replace(
        state,
        rotation=turn @ state.rotation,
        position=turn @ state.position + shift,
        velocity=turn @ state.velocity,
        gravity=turn @ state.gravity,
    )


def _pose(state: InertialState) -> F64:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = state.rotation, state.position
    return pose


def _are_one(one: F64, other: F64) -> bool:
    """Return whether two transforms (4, 4) of the frame are the same, but for drift."""
    change = np.linalg.inv(one) @ other
    turn = float(np.arccos(np.clip((np.trace(change[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    way = float(np.linalg.norm(change[:3, 3]))
    return turn < tuning.EARLIER_SAME[0] and way < tuning.EARLIER_SAME[1]
