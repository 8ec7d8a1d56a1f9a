"""Verification: registers two submaps and decides whether they show the same place.

Point to plane against the target's surfaces, from many starts. A result counts only if the two
submaps agree where they overlap, do not contradict each other's free space, fit both ways round,
and fit nowhere else nearly as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import F64
from l2lidar_proc.slam import places
from l2lidar_proc.slam.config import LoopConfig
from l2lidar_proc.slam.places import Place
from l2lidar_proc.slam.se3 import (
    SHIFT,
    TURN,
    error,
    exp,
    inverse,
    magnitude,
    planar,
    transformed,
    yaw_of,
)
from l2lidar_proc.slam.submap import SubmapView

_REACH_M: Final = (0.8, 0.2)  # farthest point from its plane in the first step, in the last
_SCALE_M: Final = 0.06  # distance at which a point loses three quarters of its weight
_NEAR_M: Final = 0.10  # a point this near a surface lies on it
_TOUCH_M: Final = 0.13  # or this near a point, for what is not flat: one voxel and a bit
_CLEAR_M: Final = 0.25  # a point this far from all others is in front of a surface, if not on it
_THING_M: Final = 0.45  # points of one thing are this close; they are spread at 0.3 m
_THING_POINTS: Final = 4  # of which there are so many around each
_POINTS: Final = (400, 1500)  # registered from every start, and to finish the best
_STEPS: Final = (8, 12)
_DONE: Final = 2e-4
_FEWEST: Final = 60  # points that must meet the target for a result
_STARTS: Final = 8  # at least
_HEIGHT_STEP_M: Final = 0.4
_SAME: Final = (np.radians(3.0), 0.3)  # [rad, m] results closer than this are one
_NOISE_SHARE: Final = 0.02  # true places disagree by 0.4 to 4 % in our scenes
_HOPELESS: Final = 0.7  # a place that agrees with less is not compared more closely
_SIMILAR_OVERLAP: Final = 0.7  # a rival place needs this part of the best one's overlap
_BOTH_WAYS: Final = (np.radians(0.5), 0.03)  # [rad, m] between the results of either way round
_OBSERVED: Final = 0.01  # part of the points that must speak for a direction
_UNOBSERVED_M: Final = 30.0
_SHARED: Final = 20.0  # neighbors err together: so many points count as one
_NOISE_M: Final = (
    0.03  # distance of a point from its surface, 1 sigma, drift in the submap included
)
_FLOOR: Final = (np.radians(0.05), 0.01)  # [rad, m] no loop is better than this

REASONS: Final = ("overlap", "agreement", "free space", "one way", "ambiguous", "no fit")
"""Why a pair is not verified."""


@dataclass(frozen=True, slots=True)
class Window:
    """Search window around a guess.

    Attributes
    ----------
    plan_m, height_m, yaw_rad : float
        Half widths.
    """

    plan_m: float
    height_m: float
    yaw_rad: float


@dataclass(frozen=True, slots=True)
class Fit:
    """Fit of two submaps at a pose.

    Attributes
    ----------
    overlap : float
        Part of the points that lie in space the other one saw, 0 to 1.
    agreement : float
        Part of these on its surfaces, of all of them or of the upright ones, whichever is less.
    free : float
        Part of these where it saw through, whichever is more.
    """

    overlap: float
    agreement: float
    free: float


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Two submaps of one place.

    Attributes
    ----------
    T_target_query : ndarray, shape (4, 4)
    covariance : ndarray, shape (6, 6)
        Turn, then translation, axes of the query; large along what the place does not fix.
    fit : Fit
        Of the query in the target.
    rival : float
        How much of the best place's fit the second best has: see :func:`likeness`.
    observed : bool
        Whether the place fixes the translation in all directions.
    """

    T_target_query: F64
    covariance: F64
    fit: Fit
    rival: float
    observed: bool


def verify(
    query: SubmapView, target: SubmapView, guess: F64, window: Window, config: LoopConfig
) -> Match | str:
    """Return how two submaps match, or which of :data:`REASONS` speaks against it.

    Parameters
    ----------
    query, target : SubmapView
    guess : ndarray, shape (4, 4)
        Query coordinates to target coordinates.
    window : Window
        All of it is searched.
    config : LoopConfig
    """
    found = []
    for start in _starts(query, target, guess, window):
        pose, information = _registered(query.source[: _POINTS[0]], target, start, _STEPS[0])
        if information is not None:
            found.append((pose, fit_of(query, target, pose, _POINTS[0])))
    if not found:
        return "no fit"
    found.sort(key=lambda item: -item[1].agreement * item[1].overlap)
    best = found[0][1]
    rivals = [
        fit.agreement
        for pose, fit in found
        if _are_apart(pose, found[0][0]) and fit.overlap > _SIMILAR_OVERLAP * best.overlap
    ]
    rival = likeness(max(rivals, default=0.0), best.agreement)
    pose, information = _registered(query.source[: _POINTS[1]], target, found[0][0], _STEPS[1])
    if information is None:
        return "no fit"
    fit = fit_of(query, target, pose, _POINTS[1])
    back, backwards = _registered(target.source[: _POINTS[1]], query, inverse(pose), _STEPS[1])
    if backwards is None:
        return "one way"
    reverse = fit_of(target, query, back, _POINTS[1])
    if min(fit.overlap, reverse.overlap) < config.min_overlap:
        return "overlap"
    if min(fit.agreement, reverse.agreement) < config.min_agreement:
        return "agreement"
    if max(fit.free, reverse.free) > config.max_free_space:
        return "free space"
    if rival > config.max_second_best:
        return "ambiguous"
    covariance, directions = _covariance(information)
    difference = error(pose, inverse(back))
    difference[SHIFT] = directions @ difference[SHIFT]
    turn, way = magnitude(difference)
    if turn > _BOTH_WAYS[0] or way > _BOTH_WAYS[1]:
        return "one way"
    middle = pose @ exp(0.5 * difference)
    return Match(middle, covariance, fit, rival, bool(np.trace(directions) > 2.5))


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Fit of two submaps after registration from one guess.

    Attributes
    ----------
    T_target_query : ndarray, shape (4, 4)
    fit, reverse : Fit
        Of the query in the target, and of the target in the query.
    obstructed : float or None
        Part of the points that make up things where the other one saw none, the way round that
        has more; None where they fit too badly to look.
    """

    T_target_query: F64
    fit: Fit
    reverse: Fit
    obstructed: float | None = None

    @property
    def contradiction(self) -> float:
        """Part of the points that lie on no surface of the other submap, and of things."""
        apart = 1.0 - 0.5 * (self.fit.agreement + self.reverse.agreement)
        return apart + (self.obstructed or 0.0)


def compare(query: SubmapView, target: SubmapView, guess: F64) -> Comparison | None:
    """Return how two submaps fit near a guess; None if they hardly meet. A tenth of a verdict.

    Parameters
    ----------
    query, target : SubmapView
    guess : ndarray, shape (4, 4)
        Query coordinates to target coordinates.
    """
    pose, information = _registered(query.source[: _POINTS[0]], target, guess, _STEPS[1])
    if information is None:
        return None
    rough = fit_of(query, target, pose, _POINTS[0])
    if rough.agreement < _HOPELESS:
        return Comparison(pose, rough, rough)
    there = _marked(query, target, pose, _POINTS[1])
    back = _marked(target, query, inverse(pose), _POINTS[1])
    return Comparison(
        pose,
        _fit(there, query),
        _fit(back, target),
        max(_things(there, target), _things(back, query)),
    )


def likeness(rival: float, best: float) -> float:
    """Return how alike two agreements are, 0 to 1, by what disagrees: 2 % always may."""
    return min((1.0 - best + _NOISE_SHARE) / (1.0 - rival + _NOISE_SHARE), 1.0)


def fit_of(query: SubmapView, target: SubmapView, pose: F64, count: int) -> Fit:
    """Return how well the first so many points of a submap fit another one at a pose."""
    return _fit(_marked(query, target, pose, count), query)


def _fit(marks: _Marks, query: SubmapView) -> Fit:
    """Return how well a submap fits whose first points are marked."""
    on, free = marks.on, marks.free
    known = on | marks.met | free
    if not known.any():
        return Fit(0.0, 0.0, 1.0)
    agreement, seen_through = float(on[known].mean()), float(free[known].mean())
    standing = known & query.is_upright[: len(known)]
    if np.count_nonzero(standing) >= _FEWEST // 2:
        agreement = min(agreement, float(on[standing].mean()))
        seen_through = max(seen_through, float(free[standing].mean()))
    return Fit(float(known.mean()), agreement, seen_through)


def obstructions(query: SubmapView, target: SubmapView, pose: F64, count: int) -> float:
    """Return the part of a submap's points that make up things where another one saw none.

    Single points are in the way everywhere: on edges, and where the poses of a submap are bent.
    What counts is several of them side by side: a cupboard that is not there.
    """
    return _things(_marked(query, target, pose, count), target)


def _things(marks: _Marks, target: SubmapView) -> float:
    """Return the part of marked points that make up things; see :func:`obstructions`."""
    points = marks.points[~marks.on]
    points = points[(marks.distance > _CLEAR_M) & target.is_open(points)]
    beside = ((points[:, None] - points) ** 2).sum(axis=2) < _THING_M**2
    return float((beside.sum(axis=1) >= _THING_POINTS).sum() / max(len(marks.on), 1))


class _Marks(NamedTuple):
    """Classification of a submap's points (N,) at a pose in another one.

    Attributes
    ----------
    on, met, free : ndarray, shape (N,), bool
        Which lie on it, which in cells of its surfaces, which where it saw through.
    points : ndarray, shape (N, 3)
        In its frame [m].
    distance : ndarray, shape (M,)
        Of those not on it from its nearest point [m], inf beyond ``_CLEAR_M``.
    """

    on: NDArray[np.bool_]
    met: NDArray[np.bool_]
    free: NDArray[np.bool_]
    points: F64
    distance: F64


def _marked(query: SubmapView, target: SubmapView, pose: F64, count: int) -> _Marks:
    """Return the marks of a submap's first points at a pose in another one."""
    points = transformed(pose, query.source[:count])
    index, _, distances = target.surfaces.match(points)
    met = np.zeros(len(points), np.bool_)
    met[index] = True
    on = np.zeros(len(points), np.bool_)
    on[index] = np.abs(distances) < _NEAR_M
    off = np.flatnonzero(~on)
    distance, _ = target.tree.query(points[off], distance_upper_bound=_CLEAR_M)
    on[off] = distance < _TOUCH_M
    free = target.is_free(points) & ~on
    return _Marks(on, met, free, points, distance[distance >= _TOUCH_M])


def _starts(query: SubmapView, target: SubmapView, guess: F64, window: Window) -> list[F64]:
    """Return poses from which to register: the guess, peaks of the plan, and some around."""
    x, y, z = guess[:3, 3]
    here = Place(float(x), float(y), yaw_of(guess), 0.0)
    peaks = places.near(
        query.structure, target.structure, here, window.plan_m, window.yaw_rad, _STARTS
    )
    levels = int(window.height_m / _HEIGHT_STEP_M)
    heights = z + _HEIGHT_STEP_M * np.arange(-levels, levels + 1)
    starts = [guess]
    for rank, peak in enumerate(peaks):
        for height in heights if rank < 3 else (z,):
            starts.append(planar(peak.x, peak.y, peak.yaw, float(height)))
    around = np.arange(max(_STARTS - len(starts), 0)) * (2.0 * np.pi / _STARTS)
    radius = min(0.5, window.plan_m)
    return starts + [
        planar(x + radius * np.cos(angle), y + radius * np.sin(angle), here.yaw, z)
        for angle in around
    ]


def _registered(source: F64, target: SubmapView, start: F64, steps: int) -> tuple[F64, F64 | None]:
    """Return pose and information (6, 6) of points on surfaces; no information if few meet any."""
    pose, information = start, None
    for step in range(steps):
        index, normals, distances = target.surfaces.match(transformed(pose, source))
        reach = max(_REACH_M[0] * 0.6**step, _REACH_M[1])
        near = np.flatnonzero(np.abs(distances) < reach)
        if len(near) < min(_FEWEST, len(source) // 4):
            return pose, None
        points, distances = source[index[near]], distances[near]
        normals = normals[near] @ pose[:3, :3]
        scale = max(_SCALE_M, 0.4 * reach)
        weights = 1.0 / (1.0 + (distances / scale) ** 2) ** 2
        h = np.concatenate((rotations.cross(points, normals), normals), axis=1)
        weighted = h * weights[:, None]
        information = weighted.T @ h
        damped = information + 1e-3 * np.diag(np.diag(information)) + 1e-6 * np.eye(6)
        change = -np.linalg.solve(damped, weighted.T @ distances)
        pose = pose @ exp(change)
        if np.abs(change).max() < _DONE and reach <= _REACH_M[1]:
            break
    return pose, information


def _covariance(information: F64) -> tuple[F64, F64]:
    """Return the covariance of a registration, and a projection on the directions it fixes.

    The points' information is spread over far fewer independent errors than there are points; a
    direction of the translation for which hardly any point speaks is not fixed at all.
    """
    strength, axes = np.linalg.eigh(information[SHIFT, SHIFT])
    fixed = strength > _OBSERVED * strength.sum()
    directions = np.asarray(axes[:, fixed] @ axes[:, fixed].T)
    keep = np.eye(6)
    keep[SHIFT, SHIFT] = directions
    sound = keep @ information @ keep / (_SHARED * _NOISE_M**2)
    sound[SHIFT, SHIFT] += (np.eye(3) - directions) / _UNOBSERVED_M**2
    sound[TURN, TURN] += np.eye(3) / np.radians(5.0) ** 2
    covariance = np.linalg.inv(sound)
    covariance[TURN, TURN] += np.eye(3) * _FLOOR[0] ** 2
    covariance[SHIFT, SHIFT] += np.eye(3) * _FLOOR[1] ** 2
    return np.asarray(covariance), directions


def _are_apart(one: F64, other: F64) -> bool:
    turn, way = magnitude(error(one, other))
    return turn > _SAME[0] or way > _SAME[1]
