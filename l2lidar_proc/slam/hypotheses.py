"""Pose hypotheses: tracks where the sensor may be until one hypothesis remains.

Rooms look alike, but not in everything, and a wrong place has to go on being alike while the
sensor moves. So places are not judged by one look: each is carried on by the odometry, and all of
them are held against the same last looks. What counts is how much contradicts a place, both ways:
what is seen and is not in the map, and what is in the map and is not seen. Points that fit no
surface are many, everywhere; things where the other one saw none are rare where the place is
right, and tell rooms apart that differ in their furniture alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64
from l2lidar_proc.slam import places
from l2lidar_proc.slam.config import LoopConfig
from l2lidar_proc.slam.nodes import Node
from l2lidar_proc.slam.place_search import Found, PlaceSearch, nearest
from l2lidar_proc.slam.se3 import error, inverse, magnitude, planar, yaw_of
from l2lidar_proc.slam.submap import SubmapView
from l2lidar_proc.slam.verification import Comparison, Window, compare, verify

_LOOKS: Final = 8  # against which all places are held
_FEWEST: Final = 3  # before a place may be announced
_PEAKS: Final = 16  # of the plan that are compared
_RAISED: Final = 4  # of these are also tried at other heights, if none fits
_HEIGHTS_M: Final = (0.4, -0.4, 0.8, -0.8)
_REFINED: Final = 3  # places around which is looked more closely, if none is verified
_PEAKS_BESIDE: Final = 6
_BESIDE: Final = (np.radians(5.0), 3.0)  # [rad, m]
_HOPELESS: Final = 0.16  # contradicted more than this, a place is not followed
_UNKNOWN: Final = 0.25  # what a look counts that does not overlap, or leads elsewhere
_LEFT: Final = (np.radians(5.0), 0.5)  # [rad, m] from where the odometry says, it leads elsewhere
_SAME: Final = (np.radians(4.0), 0.5)  # [rad, m] places closer than this are one
_NOISE: Final = 0.005  # contradicts every place, and more or less by chance
_OBSTRUCTED: Final = 0.02  # more things than this, and it is another place
_NO_THING: Final = 0.008  # of a place is obstructed by chance, where rooms are equal
_EXCEPTIONS: Final = 4  # one look of so many may speak for the rival
_WINDOW: Final = Window(1.0, 0.4, np.radians(4.0))  # around a place, searched before it is told


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """An observation over a few meters, and its pose in odom (4, 4)."""

    number: int
    origin: F64
    query: SubmapView


@dataclass(frozen=True, slots=True, eq=False)
class _Verdict:
    """Score of a hypothesis by one observation: contradiction, obstruction, verification."""

    contradiction: float = _UNKNOWN
    obstructed: float | None = None
    is_verified: bool = False


@dataclass(slots=True, eq=False)
class _Place:
    """A hypothesis: ``T_map_odom``, and its scores by observation."""

    T_map_odom: F64
    verdicts: dict[int, _Verdict] = field(default_factory=dict)

    @property
    def contradiction(self) -> float:
        return float(np.mean([verdict.contradiction for verdict in self.verdicts.values()]))

    @property
    def obstruction(self) -> float:
        seen = [v.obstructed for v in self.verdicts.values() if v.obstructed is not None]
        return float(np.mean(seen)) if seen else 0.0


class PlaceHypotheses:
    """The hypotheses, and the observations they are compared with.

    Parameters
    ----------
    search : PlaceSearch
    config : LoopConfig
    """

    def __init__(self, search: PlaceSearch, config: LoopConfig) -> None:
        self._search, self._config = search, config
        self._looks: deque[_Look] = deque(maxlen=_LOOKS)
        self._places: list[_Place] = []
        self._number = 0

    def __len__(self) -> int:
        """Return the number of places that are followed."""
        return len(self._places)

    def clear(self) -> None:
        """Forget everything."""
        self._looks.clear()
        self._places = []

    def look(
        self,
        origin: F64,
        query: SubmapView,
        nodes: Sequence[Node],
        poses: F64,
        eligible: NDArray[np.bool_],
    ) -> Found | str:
        """Take a look, and return the one place that is left, or why there is none.

        Parameters
        ----------
        origin : ndarray, shape (4, 4)
            Of the query in the odometry's frame, z up.
        query : SubmapView
        nodes : sequence of Node
        poses : ndarray, shape (N, 4, 4)
            Of the nodes in the map.
        eligible : ndarray, shape (N,)
            Nodes that belong to the map and have points.
        """
        among = np.flatnonzero(eligible)
        if not len(among):
            return "no map"
        self._number += 1
        look = _Look(self._number, origin, query)
        self._looks.append(look)
        oldest = self._looks[0].number
        for place in self._places:
            place.verdicts = {n: v for n, v in place.verdicts.items() if n >= oldest}
            self._judge(place, look, poses, among, carry=True)
        if len(self._looks) <= _FEWEST or self._number % 2:
            self._find_more(look, nodes, poses, among)
        self._sort_out(origin)
        return self._decided(look, poses, among)

    # ---- steps

    def _judge(
        self, place: _Place, look: _Look, poses: F64, among: NDArray[np.int64], *, carry: bool
    ) -> Comparison | None:
        """Hold a place against a look; ``carry`` moves it to where the look fits best."""
        predicted = place.T_map_odom @ look.origin
        place.verdicts[look.number] = _Verdict()
        node = nearest(predicted, poses, among)
        if node is None:
            return None
        guess = inverse(poses[node]) @ predicted
        found = compare(look.query, self._search.view_of(node), guess)
        if found is None or _apart(guess, found.T_target_query, _LEFT):
            return None
        fits, config = (found.fit, found.reverse), self._config
        if min(fit.overlap for fit in fits) < config.min_overlap:
            return None
        is_verified = (
            min(fit.agreement for fit in fits) >= config.min_agreement
            and max(fit.free for fit in fits) <= config.max_free_space
        )
        place.verdicts[look.number] = _Verdict(
            min(found.contradiction, _UNKNOWN), found.obstructed, is_verified
        )
        if carry:
            place.T_map_odom = poses[node] @ found.T_target_query @ inverse(look.origin)
        return found

    def _find_more(
        self, look: _Look, nodes: Sequence[Node], poses: F64, among: NDArray[np.int64]
    ) -> None:
        """Add the places of the map that look like this one and are not followed yet."""
        starts = self._search.candidates(look.query, nodes, poses, among, _PEAKS)
        raised = [start.copy() for start in starts[:_RAISED] for _ in _HEIGHTS_M]
        for start, height in zip(raised, _HEIGHTS_M * _RAISED, strict=False):
            start[2, 3] += height
        self._follow(starts, look, poses, among)
        if not self._places:
            self._follow(raised, look, poses, among)
        if not any(place.verdicts[look.number].is_verified for place in self._places):
            self._follow(self._beside(look, poses, among), look, poses, among)

    def _follow(
        self, starts: list[F64], look: _Look, poses: F64, among: NDArray[np.int64]
    ) -> None:
        """Add the places (4, 4) of a look that nothing speaks against."""
        for start in starts:
            if any(not _apart(p.T_map_odom @ look.origin, start, _SAME) for p in self._places):
                continue
            place = _Place(start @ inverse(look.origin))
            self._judge(place, look, poses, among, carry=True)
            for old in reversed(list(self._looks)[:-1]):
                if place.contradiction > _HOPELESS:
                    break
                self._judge(place, old, poses, among, carry=False)
            if place.contradiction <= _HOPELESS:
                self._places.append(place)

    def _beside(self, look: _Look, poses: F64, among: NDArray[np.int64]) -> list[F64]:
        """Return what the finer plan shows around the likeliest places, none of which fits well.

        Along a street the coarse one may be meters off, and registration stays there.
        """
        found = []
        likely = sorted(self._places, key=lambda one: one.verdicts[look.number].contradiction)
        for place in likely[:_REFINED]:
            here = place.T_map_odom @ look.origin
            node = nearest(here, poses, among)
            if node is None:
                continue
            guess = inverse(poses[node]) @ here
            x, y, z = guess[:3, 3].tolist()
            peaks = places.near(
                look.query.structure,
                self._search.view_of(node).structure,
                places.Place(x, y, yaw_of(guess), 0.0),
                _BESIDE[1],
                _BESIDE[0],
                _PEAKS_BESIDE,
            )
            found += [poses[node] @ planar(peak.x, peak.y, peak.yaw, z) for peak in peaks]
        return found

    def _sort_out(self, origin: F64) -> None:
        """Drop places that are contradicted, and the worse of two that have become one."""
        kept: list[_Place] = []
        for place in sorted(self._places, key=lambda one: one.contradiction):
            here = place.T_map_odom @ origin
            if place.contradiction <= _HOPELESS and all(
                _apart(other.T_map_odom @ origin, here, _SAME) for other in kept
            ):
                kept.append(place)
        self._places = kept

    def _decided(self, look: _Look, poses: F64, among: NDArray[np.int64]) -> Found | str:
        if not self._places:
            return "no fit"
        best, *rivals = self._places
        verified = sum(verdict.is_verified for verdict in best.verdicts.values())
        if verified < _FEWEST or not best.verdicts[look.number].is_verified:
            return "too few looks"
        if best.obstruction > _OBSTRUCTED:
            return "obstructed"
        if any(self._is_rival(best, rival) for rival in rivals):
            return "ambiguous"
        here = best.T_map_odom @ look.origin
        node = nearest(here, poses, among)
        assert node is not None
        target = self._search.view_of(node)
        match = verify(look.query, target, inverse(poses[node]) @ here, _WINDOW, self._config)
        if isinstance(match, str):
            return match
        return Found(node, match, poses[node] @ match.T_target_query)

    def _is_rival(self, best: _Place, rival: _Place) -> bool:
        """Return whether the looks do not tell two places apart."""
        if _ratio(best.obstruction, rival.obstruction, _NO_THING) < self._config.max_second_best:
            return False
        looks = sorted(best.verdicts)
        excess = np.array(
            [rival.verdicts[n].contradiction - best.verdicts[n].contradiction for n in looks]
        )
        ratio = _ratio(best.contradiction, rival.contradiction, _NOISE)
        return bool(
            ratio > self._config.max_second_best
            or (excess <= 0.0).sum() > len(looks) // _EXCEPTIONS
        )


def _ratio(best: float, rival: float, floor: float) -> float:
    return (best + floor) / (rival + floor)


def _apart(one: F64, other: F64, bounds: tuple[float, float]) -> bool:
    turn, way = magnitude(error(one, other))
    return turn > bounds[0] or way > bounds[1]
