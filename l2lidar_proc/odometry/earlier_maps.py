"""Relocalization in earlier maps, and in the older part of the map in use.

:class:`EarlierMaps` keeps the maps that were in use until the odometry was lost. A map begun after
a loss lies in the same map frame, at the predicted pose, and stays as uncertain as that for good.

:class:`MapRevisit` looks for the older part of the map in use. Where a narrow view sees one wall
only, the pose drifts; what it then adds to the map lies beside what was there before, and agrees
with the drifted pose. As it turns away from the wall, what shows the drift is in sight for less
than a second. A sweep that sees through walls of the map shows that its pose is wrong, even where
it fits; the part of the map that it sees through is older than what holds it.

When a sweep meets such a map, the odometry goes on in it and the pose jumps back. A wrong jump is
worse than none, so a meeting counts only if it fixes the place in every direction and the next one
says the same. What shows where the pose is on its level may be in sight for one sweep only: there,
one that is likely counts by itself. Such a sweep need not fix the height.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

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
from l2lidar_proc.odometry.local_map.free_space import SeenThrough
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.registration.alignment import Alignment, unobserved_directions
from l2lidar_proc.odometry.registration.correspondences import Source
from l2lidar_proc.odometry.registration.pose_hypotheses import is_explained_by_drift, level_basis
from l2lidar_proc.odometry.uncertainty import FrameJump


@dataclass(frozen=True, slots=True, eq=False)
class EarlierMap:
    """A map that was in use until the odometry was lost, or the older part of the one in use.

    Attributes
    ----------
    matcher : SweepMatcher
    jump : FrameJump
        How uncertain its place in the map frame is.
    """

    matcher: SweepMatcher
    jump: FrameJump


@dataclass(frozen=True, slots=True, eq=False)
class Relocalization:
    """An alignment of a sweep with an earlier map, or with the older part of the one in use.

    Attributes
    ----------
    map : EarlierMap
    alignment : Alignment
        Of the sweep with it.
    """

    map: EarlierMap
    alignment: Alignment


class EarlierMaps:
    """The largest of the maps in use until the odometry was lost, oldest first."""

    def __init__(self) -> None:
        self._maps: list[EarlierMap] = []
        self._next_search = 0
        self._lost_at = 0
        self._meetings = _Meetings()

    def restart(self, stamp: HostNs) -> None:
        """Go on at an instant of another time line."""
        self._meetings.clear()
        self._lost_at = self._next_search = int(stamp)

    def keep(self, matcher: SweepMatcher, jump: FrameJump, stamp: HostNs) -> None:
        """Keep a map that is left at an instant, and no more than a few of the largest."""
        self._meetings.clear()
        self._lost_at = int(stamp)
        self._next_search = self._lost_at + tuning.EARLIER_PAUSE_NS
        self._maps.append(EarlierMap(matcher, jump))
        if len(self._maps) > tuning.EARLIER_MAPS:
            self._maps.remove(min(self._maps, key=lambda kept: len(kept.matcher.surfaces)))

    def is_due(self, stamp: HostNs) -> bool:
        """Return whether the maps should be searched now: ever more rarely."""
        return bool(self._maps) and int(stamp) >= self._next_search

    def search(
        self, source: Source, motion: SweepMotion, jump: FrameJump
    ) -> Relocalization | None:
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
            if self._meetings.add(kept, _moves(motion.state, found.state)) > 1:
                self._meetings.clear()
                # those after it began where it was lost: what they tell of it is no news any more
                del self._maps[self._maps.index(kept) :]
                return Relocalization(kept, found)
            self._next_search = stamp + 1
            return None
        self._meetings.clear()
        return None


class _RecentEvent:
    """Whether an event is less than a time ago.

    Parameters
    ----------
    time_ns : int
    """

    def __init__(self, time_ns: int) -> None:
        self._time_ns = time_ns
        self._noted: int | None = None

    def note(self, stamp: int) -> None:
        """Note the event of an instant [ns]."""
        self._noted = int(stamp)

    def clear(self) -> None:
        """Forget the event."""
        self._noted = None

    def at(self, stamp: int) -> bool:
        """Return whether it was recent at an instant [ns] after it."""
        return self._noted is not None and stamp < self._noted + self._time_ns


class OlderPart(NamedTuple):
    """The older part of the map in use.

    Attributes
    ----------
    matcher : SweepMatcher
    is_due : bool
        Whether all of it is to be searched, not only on the level of the predicted place.
    is_contradicted : bool
        Whether sweeps have seen through surfaces of the map where the pose puts them.
    """

    matcher: SweepMatcher
    is_due: bool
    is_contradicted: bool


class _LevelFit(NamedTuple):
    """Where a sweep fits the older part of the map, on its level.

    Attributes
    ----------
    stamp : int
        [ns]
    shift : ndarray, shape (3,)
        From the predicted place [m], map axes.
    velocity : ndarray, shape (3, 3)
        Covariance of the velocity, map axes [m^2/s^2].
    fixes_height : bool
    """

    stamp: int
    shift: F64
    velocity: F64
    fixes_height: bool

    def agrees_with(self, before: _LevelFit) -> bool:
        """Return whether this sweep and one before it fit at one place.

        The sensor may have moved between the two otherwise than predicted, as far as its velocity
        was not known.
        """
        change = self.shift - before.shift
        way = float(np.linalg.norm(change))
        if self.fixes_height and before.fixes_height:
            return way < tuning.EARLIER_SAME.position
        seconds = (self.stamp - before.stamp) * 1e-9
        variance = max(float(change @ before.velocity @ change), 0.0) / max(way, 1e-9) ** 2
        return way < tuning.REVISIT_SAME_M + seconds * float(np.sqrt(variance))


class _LevelFits:
    """Where the latest sweeps fit the older part of the map, on their level.

    A right place stays where it is from sweep to sweep, a wrong one wanders with what is in sight.
    """

    def __init__(self) -> None:
        self._latest: deque[_LevelFit] = deque()

    def clear(self) -> None:
        """Forget them, as where the pose has jumped."""
        self._latest.clear()

    def add(self, fit: _LevelFit) -> None:
        """Take the fit of a sweep; forget those of long before it."""
        latest = self._latest
        latest.append(fit)
        while latest[0].stamp <= fit.stamp - tuning.REVISIT_MET_NS:
            latest.popleft()

    @property
    def disagree(self) -> bool:
        """Whether they are at several places."""
        return self._agreeing() < len(self._latest)

    @property
    def are_one_place(self) -> bool:
        """Whether the last two agree; three, where others before them do not."""
        return self._agreeing() >= (tuning.REVISIT_AGREEING if self.disagree else 2)

    @property
    def are_one_unlikely_place(self) -> bool:
        """Whether enough of the last agree for a place that an unlikely drift would lead to."""
        return self._agreeing() >= tuning.REVISIT_UNLIKELY_AGREEING

    def _agreeing(self) -> int:
        """Return how many of the last agree, each with the one before."""
        pairs = itertools.pairwise(reversed(self._latest))
        agreeing = itertools.takewhile(lambda pair: pair[0].agrees_with(pair[1]), pairs)
        return 1 + len(list(agreeing))


class MapRevisit:
    """Search of the older part of the map in use while the pose is less certain than that.

    Attributes
    ----------
    is_contradicted : bool
        Whether the latest sweep sees through surfaces of the map where its pose puts it. Looked
        at only while the pose is so uncertain.
    """

    def __init__(self) -> None:
        self._is_uncertain = self.is_contradicted = False
        self._meetings, self._fits = _Meetings(), _LevelFits()
        self._met = _RecentEvent(tuning.REVISIT_MET_NS)
        self._unobserved = _RecentEvent(tuning.REVISIT_SIGHT_NS)
        self._returned = _RecentEvent(tuning.REVISIT_MET_NS)
        self._contradicted = _RecentEvent(tuning.REVISIT_MET_NS)
        self.restart(HostNs(0))

    def restart(self, stamp: HostNs) -> None:
        """Begin anew at an instant of another time line."""
        self._next_search = int(stamp)
        self._certain_at: int | None = None  # stamp until which the pose was certain enough
        for event in (self._met, self._unobserved, self._returned, self._contradicted):
            event.clear()
        self._contradicting = 0  # sweeps before this were the first at the surfaces that did so
        self._forget_meetings()

    def _forget_meetings(self) -> None:
        self._meetings.clear()
        self._fits.clear()

    def note_unobserved(self, stamp: HostNs) -> None:
        """Note that the sweep of a stamp left a direction of the place free."""
        self._unobserved.note(stamp)

    def part_due(
        self, matcher: SweepMatcher, state: InertialState, source: Callable[[], Source]
    ) -> OlderPart | None:
        """Return the older part of the map if it should be searched now.

        All of it is searched more and more rarely, to a limit; the level of the predicted place
        also while a surface that fixes the place may come into sight, or the pose is contradicted.

        Parameters
        ----------
        matcher : SweepMatcher
            In use. Not that of a carrier that drives: one niche of a corridor looks like the next.
        state : InertialState
        source : callable
            Returns the points of the sweep; they are needed only where the place is uncertain.
        """
        stamp = int(state.stamp)
        self.is_contradicted = matcher.drift.is_doubted = False
        is_due = stamp >= self._next_search
        if not (is_due or self._is_uncertain or self._unobserved.at(stamp)):
            return None
        older = matcher.drift.more_certain_than_held(state.position)
        self._is_uncertain = not (older is None or matcher.is_young or matcher.driving)
        if older is None or not self._is_uncertain:
            self._certain_at, self._next_search = stamp, stamp + tuning.REVISIT_LOOK_NS
            self._forget_meetings()
            return None
        self._note_seen_through(matcher.seen_through(source(), state), stamp)
        contradicted = self._contradicted.at(stamp)
        matcher.drift.is_doubted = contradicted
        if contradicted:
            older[: self._contradicting] = True
        if is_due:
            self._next_search = stamp + self._pause(stamp)
        else:
            is_tried = contradicted or self._unobserved.at(stamp)
            uncertain = matcher.drift.at(state.position)
            if not (is_tried and _is_loose_on_level(state, uncertain, contradicted=contradicted)):
                return None
        return OlderPart(matcher.part_of(older), is_due, contradicted)

    def _note_seen_through(self, seen: SeenThrough, stamp: int) -> None:
        """Note whether the sweep of a stamp contradicts its pose, and by how old a part."""
        self.is_contradicted = seen.share > tuning.RAYS_THROUGH
        if self.is_contradicted:
            self._contradicted.note(stamp)
            self._contradicting = 1 + int(np.quantile(seen.sweeps, tuning.REVISIT_SEEN))

    def _pause(self, stamp: int) -> int:
        """Return the time [ns] from a search of all of the older part until the next."""
        if self._certain_at is None:
            self._certain_at = stamp
        pause = int(tuning.EARLIER_PAUSE_SHARE * (stamp - self._certain_at))
        return min(max(tuning.EARLIER_PAUSE_NS, pause), tuning.REVISIT_PAUSE_NS)

    def search(
        self, source: Source, part: OlderPart, motion: SweepMotion, jump: FrameJump
    ) -> Relocalization | None:
        """Return the way back into the older part of the map if two sweeps meet it.

        One is enough where it relocalizes the pose by a likely drift, unless it has just returned.
        What drifted away since is not in that part. A wrong velocity moved the pose, so the
        velocity is as uncertain as that makes it.

        Parameters
        ----------
        source : Source
            Deskewed by the motion.
        part : OlderPart
            As :meth:`part_due` returns it.
        motion : SweepMotion
        jump : FrameJump
            Of the map in use.
        """
        stamp = int(motion.state.stamp)
        found, counts = self._found_in(part, source, motion)
        if found is None:
            if self._met.at(stamp):
                self._next_search = stamp + 1
            else:
                self._meetings.clear()
            return None
        if not counts:
            self._met.note(stamp)
            self._next_search = stamp + 1
            return None
        self._forget_meetings()
        self._returned.note(stamp)
        self._contradicted.clear()
        part.matcher.drift.is_doubted = False
        way = float(np.linalg.norm(found.state.position - motion.state.position))
        covariance = found.covariance.copy()
        covariance[VELOCITY, VELOCITY] += (way / tuning.REVISIT_DRIFT_S) ** 2 * np.eye(3)
        found = dataclasses.replace(found, covariance=covariance)
        return Relocalization(EarlierMap(part.matcher, jump), found)

    def _found_in(
        self, part: OlderPart, source: Source, motion: SweepMotion
    ) -> tuple[Alignment | None, bool]:
        """Return how a sweep meets the older part of the map, and whether that counts already.

        It does where the latest sweeps agree, more of them where the drift would be an unlikely
        one; and at once where it relocalizes the pose by a likely drift, unless it has just
        returned, and no other sweep has fitted elsewhere. A pose that is known to be wrong is
        searched with each sweep, so that one may fit by chance.
        """
        older, place = part.matcher, motion.state.position
        uncertain = _kept_level(motion.state, older.drift.at(place))
        expected = older.drift.reported_at(place)[:3, :3]
        if part.is_due:
            drift, kept = FrameJump(place, uncertain), EarlierMap(older, FrameJump())
            found = _met_in(kept, source, motion, drift, lean=tuning.REVISIT_LEAN)
            if found is not None and _is_elsewhere(found, motion, len(source.points), expected):
                agreeing = self._meetings.add(None, _moves(motion.state, found.state))
                is_explained = is_explained_by_drift(found.state.position - place, expected)
                least = 2 if is_explained else tuning.REVISIT_UNLIKELY_AGREEING
                return found, agreeing >= least
        if not _is_loose_on_level(motion.state, uncertain, contradicted=part.is_contradicted):
            return None, False
        loose = with_loose_pose(motion.state, motion.covariance, uncertain)
        freed = dataclasses.replace(motion, covariance=loose)
        found = older.relocalize(source, freed, uncertain[:3, :3])
        if found is None:
            return None, False
        move = found.state.position - place
        if not is_explained_by_drift(move, expected, tuning.RELOCALIZE_UNLIKELY):
            return None, False
        stamp, fits = int(motion.state.stamp), self._fits
        free = unobserved_directions(found.information[POSITION, POSITION])
        fits.add(_LevelFit(stamp, move, motion.covariance[VELOCITY, VELOCITY], not free.size))
        is_doubted = part.is_contradicted or self._returned.at(stamp) or fits.disagree
        is_likely = is_explained_by_drift(move, expected, tuning.RELOCALIZE_LIKELY)
        if not is_explained_by_drift(move, expected):
            return found, fits.are_one_unlikely_place
        return found, (is_likely and not is_doubted) or fits.are_one_place


def _kept_level(state: InertialState, uncertain: F64) -> F64:
    """Return a drift (6, 6) of the map without the turns that gravity rules out.

    A few points that fix the place may also fit a pose that leans by degrees. Gravity would then
    accelerate it along the lean.
    """
    kept = np.eye(6)
    kept[3:, 3:] = _free_turns(state.gravity)
    return np.asarray(kept @ uncertain @ kept.T)


def _free_turns(gravity: F64) -> F64:
    """Return the projection (3, 3) on turns that gravity (3,) does not show: about the vertical.

    On all of them where gravity is zero, as it is not known.
    """
    squared = float(gravity @ gravity)
    return np.outer(gravity, gravity) / squared if squared else np.eye(3)


def _is_loose_on_level(state: InertialState, uncertain: F64, *, contradicted: bool) -> bool:
    """Return whether a place, so uncertain (6, 6), may have drifted far on its level."""
    if not state.gravity.any():
        return False
    basis = level_basis(state.gravity)
    level = basis.T @ uncertain[:3, :3] @ basis
    least = tuning.RELOCALIZE_CONTRADICTED_SIGMA if contradicted else tuning.RELOCALIZE_FROM_SIGMA
    return bool(np.linalg.eigvalsh(level)[-1] > least**2)


def _is_elsewhere(found: Alignment, motion: SweepMotion, points: int, expected: F64) -> bool:
    """Return whether a sweep is explained by a map, at another place than that of its motion.

    Where the two agree the younger part of the map is not wrong, and worth more than a jump. Where
    they are farther apart than the covariance (3, 3) of the drift explains, something else looks
    alike.
    """
    move = found.state.position - motion.state.position
    return (
        float(np.linalg.norm(move)) > tuning.REVISIT_LEAST_M
        and is_explained_by_drift(move, expected, tuning.RELOCALIZE_UNLIKELY)
        and found.matched > tuning.REVISIT_MATCHED * points
        and found.inlier_ratio > tuning.REVISIT_INLIERS
    )


class _Meetings:
    """Meetings with maps, one after the other."""

    def __init__(self) -> None:
        self._last: tuple[EarlierMap | None, F64] | None = None
        self._agreeing = 0

    def clear(self) -> None:
        """Forget them, as after a search that found nothing."""
        self._last, self._agreeing = None, 0

    def add(self, met: EarlierMap | None, moves: F64) -> int:
        """Take a meeting that moves the poses by a transform (4, 4).

        Return how many of the latest agree, each with the one before; 1 if this one is alone.
        """
        last, self._last = self._last, (met, moves)
        agrees = last is not None and last[0] is met and _are_one(last[1], moves)
        self._agreeing = self._agreeing + 1 if agrees else 1
        return self._agreeing


def _moves(state: InertialState, found: InertialState) -> F64:
    """Return how a state found for another moves the map's poses (4, 4)."""
    return np.asarray(found.pose @ np.linalg.inv(state.pose))


def _met_in(
    kept: EarlierMap,
    source: Source,
    motion: SweepMotion,
    jump: FrameJump,
    lean: float = tuning.EARLIER_SIGMA.rotation,
) -> Alignment | None:
    """Return how a sweep meets an earlier map, if it does beyond doubt.

    ``lean`` is by how much the pose that the search has found may lean, 1 sigma [rad]: as much as
    it may turn after a loss, as the attitude may have been lost too.
    """
    state = motion.state
    between = jump.at(state.position) - kept.jump.at(state.position)
    if np.trace(between) < 0.0:  # the kept one is the younger
        between = -between
    loose = with_loose_pose(state, motion.covariance, between)
    rough, _ = kept.matcher.match(source, dataclasses.replace(motion, covariance=loose))
    if rough is None:
        return None
    # velocity and gravity turn with the pose, which the search alone does not know
    there = moved(state, _moves(state, rough.state))
    turn = there.rotation @ state.rotation.T
    axes = np.eye(len(motion.covariance))
    for block in (POSITION, VELOCITY, GRAVITY):
        axes[block, block] = turn
    covariance = axes @ motion.covariance @ axes.T
    covariance[POSE, :] = covariance[:, POSE] = 0.0
    free = _free_turns(there.gravity)
    turns = tuning.EARLIER_SIGMA.rotation**2 * free + lean**2 * (np.eye(3) - free)
    covariance[ROTATION, ROTATION] = there.rotation.T @ turns @ there.rotation
    covariance[POSITION, POSITION] = tuning.EARLIER_SIGMA.position**2 * np.eye(3)
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


def _are_one(one: F64, other: F64) -> bool:
    """Return whether two transforms (4, 4) of the frame are the same, but for drift."""
    change = np.linalg.inv(one) @ other
    turn = float(np.arccos(np.clip((np.trace(change[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    way = float(np.linalg.norm(change[:3, 3]))
    return turn < tuning.EARLIER_SAME.rotation and way < tuning.EARLIER_SAME.position
