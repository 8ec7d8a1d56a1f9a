"""Localization: searches for the pose in a saved map, then tracks it; the map is constant.

What is estimated is ``T_map_odom`` with its covariance, all six components: the vertical of an
odometry that began in motion is off by degrees. The covariance grows with the odometry's way and
shrinks with each look at the map that fits; along what a place does not fix it keeps growing.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from itertools import islice
from typing import Final

import numpy as np

from l2lidar_node.types import F64
from l2lidar_proc.slam.config import SlamConfig
from l2lidar_proc.slam.hypotheses import PlaceHypotheses
from l2lidar_proc.slam.loops import odometry_covariance, unknown_covariance
from l2lidar_proc.slam.nodes import CovarianceGrowth, Health, Map, OdometrySweep, SlamState
from l2lidar_proc.slam.place_search import PlaceSearch
from l2lidar_proc.slam.se3 import (
    SHIFT,
    adjoint,
    error,
    exp,
    inverse,
    leveled,
    magnitude,
    planar,
)
from l2lidar_proc.slam.submap import SubmapBuilder, SubmapView, ViewCache
from l2lidar_proc.slam.verification import Match, Window, verify

_LOOK_BACK: Final = 3  # steps whose sweeps a look is made of
_VOTES: Final = 3  # looks that must agree before a place is announced
_AGREE: Final = (np.radians(2.0), 0.25)  # [rad, m] between looks that mean the same place
_DRIFT: Final = 0.01  # part of the way by which they may differ more
_NEAR_M: Final = 8.0
_MOST_TARGETS: Final = 2
_GATE: Final = 22.5  # chi2 of 6 degrees of freedom, 99.9 %
_BENT: Final = (np.radians(0.1), 0.02)  # [rad, m] a saved map is not exact either
_GIVEN: Final = (np.radians(15.0), 1.0)  # [rad, m] of a pose that a person gives
_UNIQUE_M: Final = 0.3  # a second place that far off would have been told: "ambiguous"
_JUMP: Final = np.radians(5.0)
_FEWEST_SWEEPS: Final = 3
_MOST_SWEEPS: Final = 200
_ELSEWHERE: Final = (np.radians(4.0), 0.05)  # [rad, m] nearer sweeps show the same again


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """A pose in the map that fits.

    Attributes
    ----------
    T_map_odom : ndarray, shape (4, 4)
    way : float
        Of the odometry then [m].
    """

    T_map_odom: F64
    way: float


class Localizer:
    """Finds and tracks the pose in a saved map.

    Parameters
    ----------
    config : SlamConfig
    saved : Map

    Attributes
    ----------
    T_map_odom : ndarray, shape (4, 4), or None
        None while the place is unknown. Replaced, never changed in place.
    state : SlamState
    covariance : ndarray, shape (6, 6)
        Of the body's pose in the map: turn, then translation, map axes.
    counts : Counter of str
        Looks that did not fit, by reason.
    """

    def __init__(self, config: SlamConfig, saved: Map) -> None:
        self.config = config
        self._map = saved
        self.T_map_odom: F64 | None = None
        self.state = SlamState.SEARCHING
        self.covariance = np.zeros((6, 6))
        self.counts: Counter[str] = Counter()
        self._eligible = saved.largest_part()
        self._eligible &= np.array([node.submap is not None for node in saved.nodes])
        self._views = ViewCache()
        self._hypotheses = PlaceHypotheses(PlaceSearch(self._view_of), config.loop)
        self._sweeps: deque[tuple[float, OdometrySweep]] = deque(maxlen=_MOST_SWEEPS)
        self._latest: OdometrySweep | None = None
        self._growth = CovarianceGrowth()
        self._way = 0.0
        self._looked_at = 0.0
        self._confirmed_at = 0.0
        self._looks: list[Look] = []
        self._against: list[Look] = []  # that agree with each other, not with the place
        self._jump: Look | None = None
        self._may_search = config.localization.relocalize == "auto"

    # ---- input

    def add(self, sweep: OdometrySweep) -> bool:
        """Take a sweep, in order of time; return whether the map was looked at."""
        grown = self._growth.add(sweep)
        if sweep.health is Health.CUT:
            self._cut()
        elif self._latest is not None:
            self._carry_on(self._latest, sweep, grown)
        self._latest = sweep
        if sweep.health in (Health.GOOD, Health.DEGENERATE) and self._is_new(sweep):
            self._sweeps.append((self._way, sweep))
        step = self.config.localization.query_step_m
        while self._sweeps and self._way - self._sweeps[0][0] > _LOOK_BACK * step:
            self._sweeps.popleft()
        if self._way - self._looked_at < step or len(self._sweeps) < _FEWEST_SWEEPS:
            return False
        self._looked_at = self._way
        self._look()
        return True

    def relocalize(self) -> None:
        """Forget the pose and search for it, regardless of the setting."""
        self._forget()
        self._may_search = True

    def set_pose(self, x: float, y: float, yaw: float) -> bool:
        """Take a pose of the body from a person; return False before the first sweep.

        Height, roll and pitch come from the map and from gravity.
        """
        if self._latest is None:
            return False
        poses = self._map.poses
        distance = np.hypot(poses[:, 0, 3] - x, poses[:, 1, 3] - y)
        z = float(poses[int(np.argmin(distance)), 2, 3])
        body = self._latest.T_odom_body
        self._forget()
        self.T_map_odom = planar(x, y, yaw, z) @ inverse(leveled(body))
        self.covariance = np.diag(np.repeat(np.square(_GIVEN), 3))
        self._confirmed_at = self._looked_at = self._way
        self.state = SlamState.TENTATIVE
        return True

    def take_over(self, T_map_odom: F64, covariance: F64) -> None:
        """Take a place that is known already, with its covariance as in :attr:`covariance`."""
        self._forget()
        self.T_map_odom, self.covariance = T_map_odom, covariance
        self.state = SlamState.LOCALIZED

    @property
    def place(self) -> tuple[F64, F64] | None:
        """``T_map_odom`` and its covariance where they are known, else None."""
        if self.T_map_odom is None or self.state is not SlamState.LOCALIZED:
            return None
        return self.T_map_odom, self.covariance

    @property
    def sigma(self) -> float:
        """Standard deviation of the place in its worst direction [m]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[SHIFT, SHIFT])[-1]))

    # ---- steps

    def _carry_on(self, before: OdometrySweep, sweep: OdometrySweep, grown: F64) -> None:
        _, way = magnitude(error(before.T_odom_body, sweep.T_odom_body))
        self._way += way
        if self.T_map_odom is None:
            return
        ad = adjoint(_only_turn(self.T_map_odom))
        # a little at each sweep: as much as an edge of the whole step would have
        step = self.config.localization.query_step_m
        whole = odometry_covariance(step, 0.0, np.zeros((6, 6)), self.config)
        self.covariance = self.covariance + whole * (way / step) + ad @ grown @ ad.T
        unconfirmed = self._way - self._confirmed_at
        if self.state is SlamState.LOCALIZED and (
            unconfirmed > self.config.localization.dead_reckoning_m
        ):
            self.state = SlamState.DEAD_RECKONING
        if self.sigma > self.config.localization.lost_sigma_m and self.state in (
            SlamState.LOCALIZED,
            SlamState.DEAD_RECKONING,
        ):
            self.state = SlamState.LOST
            self._looks = []
            self._hypotheses.clear()

    def _cut(self) -> None:
        """Start over after the odometry was lost: hold the last pose without trusting it."""
        self._sweeps.clear()
        self._looks = []
        self._hypotheses.clear()
        if self.T_map_odom is not None:
            self.state, self.covariance = SlamState.LOST, unknown_covariance()

    def _is_new(self, sweep: OdometrySweep) -> bool:
        """Return whether a sweep is from elsewhere than the last few that are kept.

        Sweeps leave with the way: those of a sensor at rest would pile up.
        """
        last = [kept for _, kept in islice(reversed(self._sweeps), _FEWEST_SWEEPS)]
        off = [magnitude(error(kept.T_odom_body, sweep.T_odom_body)) for kept in last]
        return len(last) < _FEWEST_SWEEPS or all(
            turn > _ELSEWHERE[0] or way > _ELSEWHERE[1] for turn, way in off
        )

    def _forget(self) -> None:
        self.T_map_odom, self.state = None, SlamState.SEARCHING
        self._looks, self._against, self._jump = [], [], None
        self._hypotheses.clear()

    def _look(self) -> None:
        origin, query = self._query()
        unconfirmed = self._way - self._confirmed_at
        if (
            self.state is SlamState.TENTATIVE
            and self.T_map_odom is not None
            and unconfirmed > self.config.localization.dead_reckoning_m
            and self._may_search
        ):
            self._forget()  # a given pose that nothing speaks for
        if self.state in (SlamState.LOCALIZED, SlamState.DEAD_RECKONING) or (
            self.T_map_odom is not None and self.state is SlamState.TENTATIVE
        ):
            self._keep(origin, query)
        elif self._may_search:
            self._find(origin, query)

    def _query(self) -> tuple[F64, SubmapView]:
        """Return the frame in odom and the view of what was seen over the last steps."""
        submaps = self.config.submaps
        builder = SubmapBuilder(submaps.map_voxel_m, submaps.map_range_m)
        origin = leveled(self._sweeps[len(self._sweeps) // 2][1].T_odom_body)
        for _, sweep in self._sweeps:
            builder.add(inverse(origin) @ sweep.T_odom_body, sweep.points)
        return origin, SubmapView(builder.finish())

    def _keep(self, origin: F64, query: SubmapView) -> None:
        """Correct a known pose by registration with the map."""
        assert self.T_map_odom is not None
        predicted = self.T_map_odom @ origin
        places = self._map.poses[:, :3, 3]
        distance = np.linalg.norm(places - predicted[:3, 3], axis=1)
        near = np.flatnonzero(self._eligible & (distance < _NEAR_M))
        window = self._window()
        for target in near[np.argsort(distance[near])][:_MOST_TARGETS].tolist():
            guess = inverse(self._map.poses[target]) @ predicted
            match = verify(query, self._view_of(target), guess, window, self.config.loop)
            if isinstance(match, str):
                self.counts[match] += 1
                continue
            if self._correct(origin, predicted, target, match):
                return

    def _window(self) -> Window:
        sigma = 3.0 * np.sqrt(np.diag(self.covariance))
        return Window(
            float(np.clip(np.hypot(sigma[3], sigma[4]), 0.5, 5.0)),
            float(np.clip(sigma[5], 0.2, 1.0)),
            float(np.clip(sigma[2], np.radians(1.0), np.radians(45.0))),
        )

    def _correct(self, origin: F64, predicted: F64, target: int, match: Match) -> bool:
        """Apply a look to ``T_map_odom``; return whether it was believed."""
        measured = self._map.poses[target] @ match.T_target_query
        # both covariances in the axes of the map, about the place of the query
        ad = adjoint(_only_turn(measured))
        noise = ad @ match.covariance @ ad.T
        noise += np.diag(np.repeat(np.square(_BENT), 3))
        # the error is in the axes of the prediction, which may be turned against what was measured
        off = adjoint(_only_turn(predicted)) @ error(predicted, measured)
        spread = self.covariance + noise
        if self.state is not SlamState.TENTATIVE and off @ np.linalg.solve(spread, off) > _GATE:
            self.counts["odometry"] += 1
            return self._contradicted(origin, measured, noise)
        self._against = []
        gain = self.covariance @ np.linalg.inv(spread)
        change = gain @ off
        moved = predicted @ exp(adjoint(_only_turn(predicted)).T @ change)
        believed = Look(moved @ inverse(origin), self._way)
        turn, way = magnitude(off)
        if self.state is not SlamState.TENTATIVE and (
            way > self.config.localization.max_jump_m or turn > _JUMP
        ):
            waiting, self._jump = self._jump, believed
            if waiting is None or not _same(waiting, believed, origin):
                self.counts["jump waits"] += 1
                return True
        self._jump = None
        self.T_map_odom = believed.T_map_odom
        self.covariance = (np.eye(6) - gain) @ self.covariance
        self.covariance = 0.5 * (self.covariance + self.covariance.T)
        self._confirmed_at = self._way
        if self.state is SlamState.TENTATIVE:
            self._looks.append(believed)
            if not _same(self._looks[0], believed, origin):
                self._looks = [believed]
            if len(self._looks) < _VOTES:
                return True
        self.state, self._looks = SlamState.LOCALIZED, []
        return True

    def _contradicted(self, origin: F64, measured: F64, noise: F64) -> bool:
        """Take an observation that contradicts the known pose; accept the third that agrees.

        Then the place was known less well than its covariance says.
        """
        look = Look(measured @ inverse(origin), self._way)
        if self._against and not _same(self._against[-1], look, origin):
            self._against = []
        if not self._against or look.way > self._against[-1].way:  # one for each step
            self._against.append(look)
        if len(self._against) < _VOTES:
            return False
        self.T_map_odom, self.covariance = look.T_map_odom, noise
        self._confirmed_at, self._against, self._jump = self._way, [], None
        self.state = SlamState.LOCALIZED
        return True

    def _find(self, origin: F64, query: SubmapView) -> None:
        """Search the whole map; announce a place when the looks leave only one."""
        found = self._hypotheses.look(
            origin, query, self._map.nodes, self._map.poses, self._eligible
        )
        if self.state is not SlamState.LOST:
            self.state = SlamState.TENTATIVE if len(self._hypotheses) else SlamState.SEARCHING
        if isinstance(found, str):
            self.counts[found] += 1
            return
        self.T_map_odom = found.T_map_query @ inverse(origin)
        ad = adjoint(_only_turn(found.T_map_query))
        self.covariance = bounded(ad @ found.match.covariance @ ad.T, _UNIQUE_M)
        self.covariance += np.diag(np.repeat(np.square(_BENT), 3))
        self._confirmed_at, self._looks = self._way, []
        self.state = SlamState.LOCALIZED
        self._hypotheses.clear()

    def _view_of(self, number: int) -> SubmapView:
        submap = self._map.nodes[number].submap
        assert submap is not None
        return self._views.of(number, submap)


def bounded(covariance: F64, sigma: float) -> F64:
    """Return a covariance (6, 6) of which each direction of the translation is known to so much.

    Along a street few points speak for a direction, and registration leaves it open; that no
    other place along it fits says how far off it may be.
    """
    information = np.linalg.inv(covariance)
    information[SHIFT, SHIFT] += np.eye(3) / sigma**2
    return np.asarray(np.linalg.inv(information))


def _same(one: Look, other: Look, at: F64) -> bool:
    """Return whether two looks put a pose (4, 4) of the odometry at the same place."""
    turn, way = magnitude(error(one.T_map_odom @ at, other.T_map_odom @ at))
    between = abs(other.way - one.way)
    return bool(turn < _AGREE[0] and way < _AGREE[1] + _DRIFT * between)


def _only_turn(pose: F64) -> F64:
    out = np.eye(4)
    out[:3, :3] = pose[:3, :3]
    return out
