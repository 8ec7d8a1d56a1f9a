"""Uncertainty beyond the filter's: of the map, and of its frame.

:class:`MapDrift` remembers how uncertain the pose was of each sweep that mapped something. The
covariance of a pose is that of the surfaces that it is aligned with, plus that of the alignment
(VoxelMap, Yuan et al. 2022, carries the like in its planes). Alignment with what the last few
sweeps have mapped only tells the pose relative to these sweeps.

:class:`FrameJump`: a map begun after a loss lies where the prediction had come to.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import InertialState, pose_covariance, skew
from l2lidar_proc.odometry.intrinsics.corrections import Corrections, IntrinsicErrors
from l2lidar_proc.odometry.registration.correspondences import Support


@dataclass(frozen=True, slots=True, eq=False)
class MapError:
    """What the map in use adds to the covariance of poses, as known at one instant.

    Attributes
    ----------
    drift, expected_drift : ndarray, shape (6, 6)
        Covariance of a shift and a turn of the map about its origin [m, rad], its axes: as large
        as it has to be allowed for, and as it is expected to be.
    behind : float
        Way on which the surfaces were opened that hold the latest sweep [m].
    errors, errors_began : IntrinsicErrors
        As of :class:`MapDrift`.
    swung : float
        The worse known of the beam angles' errors, added up along ``behind`` [rad m].
    lean : ndarray, shape (3,)
        By which the map has bent since it was begun, as gravity shows [rad].
    up : ndarray, shape (3,), optional
        Unit, map axes; None while gravity does not show it.
    first_pose : ndarray, shape (6, 6)
        As of :class:`MapDrift`.
    """

    drift: F64
    expected_drift: F64
    behind: float
    errors: IntrinsicErrors
    errors_began: IntrinsicErrors
    swung: float
    lean: F64
    up: F64 | None
    first_pose: F64

    def at(self, place: F64) -> F64:
        """Return what the map may add to the covariance (6, 6) of a pose at a place (3,) [m].

        It has room for a unit that is as wrong as units are, for searches and for decisions.
        What a unit's calibration is wrong by adds up with the distance; and with the way, where
        the map of the place that was there first is forgotten. The map bends where it grows: the
        attitude errs with the way as the vertical does.
        """
        away = float(np.linalg.norm(place))
        left = 1.0 - np.exp(-max(away, self.behind) / tuning.UNIT_FROM_M)  # 0 defines the frame
        share = max(tuning.UNIT_SHARE * away, tuning.UNIT_WAY_SHARE * self.behind)
        shift = (tuning.UNIT_SHIFT * left) ** 2 + share**2
        bend = tuning.MAP_BEND**2 * max(away, self.behind)
        unit = np.diag([shift] * 3 + [(tuning.UNIT_TURN * left) ** 2 + bend] * 3)
        return self._with(place, unit, self.drift)

    def reported_at(self, place: F64) -> F64:
        """Return what the map is expected to add to the covariance (6, 6) of a pose, to report it.

        As :meth:`at`, but for a unit as good as its clouds show it to be. Beam angles that move
        the halves of the fan apart turn the map against its first pose at once; alpha, which moves
        them apart in height, only lets it lean, and so does a bias of the ranges. Those that do
        not move them apart, and hence are hardly known, turn it about the vertical as it grows,
        and bend the way by that; gravity and the ground do not let it lean. What a scale of the
        ranges is wrong by moves places along the line from the origin, and nothing else. What only
        the IMU holds is part of the drift.
        """
        now, began = self.errors, self.errors_began
        better, worse = now.beams
        away = float(np.linalg.norm(place))
        way = max(away, self.behind)
        left = 1.0 - np.exp(-way / tuning.UNIT_FROM_M)
        turn = (tuning.MAP_TURN * left) ** 2 + tuning.MAP_TURN_BEND**2 * way
        first = tuning.BEAM_TURN * max(better, began.beams[0]) * left
        shift = (tuning.MAP_SHIFT * left) ** 2 + (tuning.MAP_SHARE * way) ** 2
        swing = (tuning.BEAM_SWING * max(self.swung, worse * away)) ** 2
        up = np.eye(3) if self.up is None else np.outer(self.up, self.up)
        level = np.eye(3) if self.up is None else np.eye(3) - up
        unit = np.diag([shift] * 3 + [turn] * 3)
        unit[:3, :3] += swing * way**2 * level  # as if all of it had come about at the beginning
        unit[:3, :3] += tuning.RANGE_SCALE**2 * np.outer(place, place)
        unit[3:, 3:] += swing * up
        unit += _bent(
            place, (tuning.RANGE_BIAS_TURN * max(now.ranges, began.ranges) * left) ** 2 * level
        )
        leaning = (tuning.ALPHA_TURN * max(now.alpha, began.alpha) * left) ** 2 * level
        return self._with(place, unit, self.expected_drift, first**2 * np.eye(3) + leaning)

    def _with(self, place: F64, unit: F64, drift: F64, first: F64 | float = 0.0) -> F64:
        """Return the covariance (6, 6) at a place of a map with a drift and of a unit's faults.

        ``first`` is that of the turn (3, 3) by these of the first pose against the map [rad^2].
        """
        moved = _adjoint(place)
        begun = drift + self.first_pose
        begun[3:, 3:] += first
        unit[3:, 3:] += np.outer(self.lean, self.lean)
        return np.asarray(moved @ begun @ moved.T + unit)


_ALLOWED, _EXPECTED = 0, 1
"""Of the two drifts, the one that has to be allowed for and the one that is expected."""

_MAPPED: Final = np.dtype(
    [
        ("drift", np.float32, (2, 6, 6)),
        ("way", np.float64),
        ("swing", np.float64),
    ]
)
"""How uncertain the map was where some sweeps in a row extended it.

``drift`` holds the two covariances, ``way`` is how far the sensor had come in this map [m], and
``swing`` the worse of the beam angles' errors, added up along that way [rad m].
"""


class MapDrift:
    """Uncertainty of the map in use, as a small motion of the whole map.

    Covariances (6, 6) are of a shift and a turn of the map about its origin [m, rad], in its axes.
    There are two of everything. One is as large as has to be allowed for, for decisions: poses err
    as their covariances say, and the velocity along a free direction always alike. The other is as
    large as is expected, to be reported: places err as the innovations show, turns all the same,
    and the velocity until something corrects it.

    Attributes
    ----------
    first_pose : ndarray, shape (6, 6)
        Covariance of the first pose against the map that followed it [m, rad], map axes. Zero at
        rest. In motion, velocity and gyro bias of the first sweeps were hardly known.
    corrections : Corrections
        Of the sweeps to come.
    began : Corrections
        Of the sweeps that mapped the surroundings of the origin.
    errors, errors_began : IntrinsicErrors
        What clouds with these corrections may be wrong by, as is known now.
    is_doubted : bool
        Whether the drift is known to be larger than expected: then as much as has to be allowed
        for is expected.
    """

    def __init__(self) -> None:
        self._history = np.zeros(64, _MAPPED)
        self.corrections = Corrections(np.zeros(3), 0.0)
        unknown = IntrinsicErrors((tuning.BEAM_SIGMA, tuning.BEAM_SIGMA), 0.0, 0.0)
        self.errors = self.errors_began = unknown
        self.clear()

    def clear(self) -> None:
        """Forget everything: a new map begins, without error by definition."""
        self.first_pose: F64 = np.zeros((6, 6))
        self.is_doubted = False
        self._group = tuning.DRIFT_GROUP  # sweeps that share an entry of the history
        self._known = 0
        self._current: F64 = np.zeros((2, 6, 6))
        self._reported: F64 = np.zeros((2, 6, 6))  # the same, but falling over some sweeps
        # covariance of place and velocity [m^2/s], map axes
        self._with_velocity: F64 = np.zeros((3, 3))
        self._way, self._before = 0.0, np.zeros(3)
        self._swing = 0.0
        self._behind = 0.0  # way on which the surfaces were opened that hold the latest sweep [m]
        self._swung = 0.0  # the worse of the beam angles, added up until then [rad m]
        self.began = self.corrections
        self._vertical: F64 | None = None  # gravity when it was first known [m/s^2]
        self._lean: F64 = np.zeros(3)  # by which the map has bent since, as gravity shows [rad]
        self._up: F64 | None = None  # as gravity shows it now, unit; None while it does not

    def shift_first_pose(self, shift: F64) -> None:
        """Let the first pose be as uncertain as by a shift (3,) [m] besides, map axes."""
        wider = self.first_pose.copy()
        wider[:3, :3] += np.outer(shift, shift)
        self.first_pose = wider

    def meet(
        self,
        support: Support,
        place: F64 | None = None,
        weakly: tuple[F64, Support] | None = None,
        strongly: tuple[tuple[F64, Support], ...] = (),
    ) -> None:
        """Take the surfaces that hold the latest sweep.

        Parameters
        ----------
        support : Support
            All of them.
        place : ndarray, shape (3,), optional
            Of the sensor, map frame [m]; needed with what follows.
        weakly : tuple of ndarray and Support, optional
            The direction (3,), unit, map axes, that they hold least, and the support of those that
            hold it. The others, however old, say nothing about it.
        strongly : tuple of tuple of ndarray and Support
            Likewise other directions, orthogonal to it.
        """
        self._with_velocity = np.zeros((3, 3))  # errs like the surfaces, whatever the velocity
        sweeps, shares = support
        if not len(sweeps) or not self._known:
            return
        rows = self._rows(sweeps)
        self._current = self._mean_drift(support)
        self._behind = float(shares @ self._history["way"][rows])
        self._swung = float(shares @ self._history["swing"][rows])
        if place is not None:
            for direction, holding in (*strongly, *([weakly] if weakly else [])):
                along = np.zeros((6, 6))
                along[:3, :3] = np.outer(direction, direction)
                self._combine(place, self._current, self._mean_drift(holding), along)
        self._fall()

    def _fall(self) -> None:
        """Let the reported uncertainty grow at once and fall over some sweeps.

        A single sweep may seem to match old surfaces although the next one does not.
        """
        strength, axes = np.linalg.eigh(self._reported - self._current)
        left = tuning.DRIFT_FALL * np.maximum(strength, 0.0)[:, None]
        self._reported = self._current + (axes * left) @ np.swapaxes(axes, 1, 2)

    def _rows(self, sweeps: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.clip(sweeps // self._group, 0, self._known - 1)

    def _mean_drift(self, support: Support) -> F64:
        """Return the drifts (2, 6, 6) that surfaces have on average."""
        sweeps, shares = support
        drifts = self._history["drift"][self._rows(sweeps)].astype(np.float64)
        return np.asarray(np.tensordot(shares, drifts, 1))

    def _combine(self, place: F64, most: F64, some: F64, along: F64) -> F64:
        """Let errors (2, 6, 6) be ``some`` along a projection (6, 6) of a place, else ``most``.

        Return what they are there.
        """
        moved, back = _adjoint(place), _adjoint(-place)
        across = np.eye(6) - along
        there = across @ moved @ most @ moved.T @ across + along @ moved @ some @ moved.T @ along
        self._current = back @ there @ back.T
        return np.asarray(there)

    def meet_partly(
        self,
        support: Support,
        place: F64,
        free: F64,
        velocity: F64,
        seconds: float,
        strongly: tuple[tuple[F64, Support], ...] = (),
    ) -> None:
        """Take surfaces that leave some directions free: along these nothing is held.

        What is registered along them is where the sensor is relative to what the last sweeps put
        into the map with the same wrong velocity. So the place errs by what was reported of it
        before, also if the sweep before seemed to be held, and by the sum of the errors of the
        velocity. These are expected to last until something corrects it
        (:meth:`correct_velocity`).

        Parameters
        ----------
        support : Support
            As in :meth:`meet`.
        place : ndarray, shape (3,)
            Of the sensor, map frame [m].
        free : ndarray, shape (3, K)
            The directions, orthonormal, map axes.
        velocity : ndarray, shape (3, 3)
            Covariance of the velocity, map axes [m^2/s^2].
        seconds : float
            Since the sweep before.
        strongly : tuple of tuple of ndarray and Support
            As in :meth:`meet`.
        """
        reported, shared = self._reported, self._with_velocity
        self.meet(support, place, None, strongly)
        self._reported = reported
        along = np.zeros((6, 6))
        along[:3, :3] = free @ free.T
        now = self._combine(place, self._current, reported, along)
        for direction in free.T:
            way = seconds * float(np.sqrt(direction @ velocity @ direction))
            sigma = float(np.sqrt(max(direction @ now[_ALLOWED, :3, :3] @ direction, 0.0)))
            now[_ALLOWED, :3, :3] += (2.0 * sigma + way) * way * np.outer(direction, direction)
        grown = (shared + shared.T) * seconds + velocity * seconds**2
        strength, axes = np.linalg.eigh(free.T @ grown @ free)
        axes = np.asarray(free @ axes)
        now[_EXPECTED, :3, :3] += (axes * np.maximum(strength, 0.0)) @ axes.T
        self._with_velocity = shared + along[:3, :3] @ velocity * seconds
        back = _adjoint(-place)
        self._current = back @ now @ back.T
        self._fall()

    def correct_velocity(self, prior: F64, posterior: F64) -> None:
        """Let an error of the place depend less on a velocity that was corrected.

        With the gain K of the correction, ``I - K`` of the velocity's error is left, and of its
        covariance with anything else.

        Parameters
        ----------
        prior, posterior : ndarray, shape (3, 3)
            Covariances of the velocity, map axes [m^2/s^2].
        """
        if self._with_velocity.any():
            left = np.linalg.solve(prior, posterior)  # the transpose of I - K
            self._with_velocity = np.asarray(self._with_velocity @ left)

    def record(self, sweep: int, place: F64, covariance: F64, expected_share: float = 1.0) -> None:
        """Remember how uncertain the pose was that added a sweep.

        Parameters
        ----------
        sweep : int
            Its number in this map.
        place : ndarray, shape (3,)
            Where it was, map frame [m].
        covariance : ndarray, shape (6, 6)
            Of place and turn relative to the surfaces around, map axes [m, rad].
        expected_share : float
            Of the covariance of the place. NIS does not show what turns the map: surfaces that
            err alike from sweep to sweep.
        """
        row = self._row_for(sweep)
        worse = self.errors.beams[1]
        if self._known:
            step = float(np.linalg.norm(place - self._before))
            self._way += step
            self._swing += step * worse
        if self._way < tuning.UNIT_FROM_M:
            self.began = self.corrections
        self._before = place
        moved = _adjoint(-place)
        added = moved @ covariance @ moved.T
        scale = np.repeat((np.sqrt(expected_share), 1.0), 3)
        less = moved @ (covariance * np.outer(scale, scale)) @ moved.T
        found = self._current + np.stack((added, less))
        # of sweeps that share an entry, the least certain: sight may have been lost in between
        if row < self._known:
            here = _adjoint(place)[:3]
            drift = self._history["drift"][row]
            more = here @ (found - drift) @ here.T
            is_less_certain = np.trace(more, axis1=1, axis2=2) > 0.0
            drift[is_less_certain] = found[is_less_certain]
        fresh = self._history[self._known : row + 1]
        fresh["drift"], fresh["way"], fresh["swing"] = found, self._way, self._swing
        self._known = max(self._known, row + 1)

    def _row_for(self, sweep: int) -> int:
        """Return the row of a sweep in the history, which grows, or is merged, to hold it."""
        while sweep // self._group >= tuning.DRIFT_ENTRIES:
            self._share_entries()
        row = sweep // self._group
        if row >= len(self._history):
            rows = min(2 * row, tuning.DRIFT_ENTRIES)
            self._history = _padded(self._history, rows)
        return row

    def _share_entries(self) -> None:
        """Let twice as many sweeps share an entry: the history stays bounded.

        Of two that become one, the less certain counts.
        """
        pairs = self._history.reshape(-1, 2)
        drifts = pairs["drift"]  # entry, of the two, which drift, 6, 6
        sizes = np.trace(drifts[..., :3, :3], axis1=-2, axis2=-1)
        worse = np.argmax(sizes, axis=1)[:, None, :, None, None]
        merged = pairs[:, 1].copy()
        merged["drift"] = np.take_along_axis(drifts, worse, axis=1)[:, 0]
        self._group *= 2
        self._known = -(-self._known // 2)
        self._history = _padded(merged, len(self._history))

    def more_certain(self, place: F64) -> NDArray[np.bool_] | None:
        """Return which sweeps (S,) were far more certain of a place (3,) [m] than the latest.

        None where the latest is certain enough.
        """
        if not self._known:
            return None
        latest = self._history["drift"][self._known - 1, _ALLOWED].astype(np.float64)
        return self._surer(place, latest, tuning.APART_LEAST)

    def more_certain_than_held(self, place: F64) -> NDArray[np.bool_] | None:
        """Return the sweeps (S,) up to the last that was far more certain of a place (3,) [m].

        More certain than the surfaces that hold it now. None where the place is
        certain enough, so that no other surfaces need be looked for.
        """
        surer = self._surer(place, self._reported[_ALLOWED], tuning.REVISIT_FROM_SIGMA)
        if surer is not None and surer.any():
            surer[: np.flatnonzero(surer)[-1]] = True
        return surer

    def _surer(self, place: F64, drift: F64, least: float) -> NDArray[np.bool_] | None:
        """Return which sweeps (S,) were surer of a place than a drift (6, 6) of at least so much.

        ``least`` is a standard deviation [m]; None where the drift is less.
        """
        here = _adjoint(place)[:3]
        squared = float(np.trace(here @ drift @ here.T))
        if squared < least**2:
            return None
        history = self._history["drift"][: self._known, _ALLOWED].astype(np.float64)
        all_squared = np.einsum("jk,njk->n", here.T @ here, history)
        return np.repeat(all_squared < tuning.APART_SHARE**2 * squared, self._group)

    def lean(self, gravity: F64, covariance: F64) -> None:
        """Record how far gravity has turned in the map: so far the map has bent.

        Registration against the map itself cannot show that, nor undo it. The angle that an
        accelerometer bias at the beginning can explain does not count.

        Parameters
        ----------
        gravity : ndarray, shape (3,)
            Map axes [m/s^2]; zero where it is not trusted.
        covariance : ndarray, shape (3, 3)
        """
        squared = float(gravity @ gravity)
        if squared == 0.0:
            self._up = None
            return
        if self._vertical is None:
            if np.linalg.eigvalsh(covariance)[-1] < tuning.LEAN_KNOWN**2 * squared:
                self._vertical = gravity
            return
        self._up = -gravity / np.sqrt(squared)
        turn = rotations.cross(self._vertical, gravity) / squared
        angle = float(np.linalg.norm(turn))
        self._lean = turn * max(1.0 - tuning.LEAN_FROM / max(angle, 1e-12), 0.0)

    @property
    def error(self) -> MapError:
        """What it amounts to by now; it stays as it is when more sweeps come."""
        return MapError(
            drift=self._reported[_ALLOWED],
            expected_drift=self._reported[_ALLOWED if self.is_doubted else _EXPECTED],
            behind=self._behind,
            errors=self.errors,
            errors_began=self.errors_began,
            swung=self._swung,
            lean=self._lean,
            up=self._up,
            first_pose=self.first_pose,
        )

    def at(self, place: F64) -> F64:
        """Return :meth:`MapError.at` a place (3,) [m] as of now."""
        return self.error.at(place)

    def reported_at(self, place: F64) -> F64:
        """Return :meth:`MapError.reported_at` a place (3,) [m] as of now."""
        return self.error.reported_at(place)


def _padded(history: NDArray[np.void], rows: int) -> NDArray[np.void]:
    """Return a history (N,) with further, empty rows: (rows,)."""
    out = np.zeros(rows, _MAPPED)
    out[: len(history)] = history
    return out


def _bent(place: F64, turn: F64) -> F64:
    """Return what a covariance (3, 3) of the turn at a place makes of a pose there: (6, 6).

    The map was not turned at once but has bent on the way, and a unit that became known on the way
    has bent it in part of it only. So the place is less tied to the turn than by :func:`_adjoint`.
    """
    moved = _adjoint(place)[:, 3:]
    whole = moved @ turn @ moved.T
    whole[:3, 3:] *= tuning.BEND_CORRELATION
    whole[3:, :3] *= tuning.BEND_CORRELATION
    return np.asarray(whole)


def _adjoint(place: F64) -> F64:
    """Return the adjoint (6, 6): what a shift and a turn about the origin do at a place (3,)."""
    moved = np.eye(6)
    moved[:3, 3:] = -skew(place)
    return moved


@dataclass(frozen=True, slots=True, eq=False)
class FrameJump:
    """Uncertainty of where a map lies in the map frame; zero for the first map, which defines it.

    Alignment with the map does not observe it, so it stays for good.

    Attributes
    ----------
    place : ndarray, shape (3,)
        Where the latest jump happened, map frame [m].
    covariance : ndarray, shape (6, 6)
        Of x, y, z and of the turns about the frame's axes, there [m, rad].
    """

    place: F64 = field(default_factory=lambda: np.zeros(3))
    covariance: F64 = field(default_factory=lambda: np.zeros((6, 6)))

    def at(self, place: F64) -> F64:
        """Return the covariance (6, 6) at another place (3,): a turn moves what is far away."""
        moved = _adjoint(place - self.place)
        return np.asarray(moved @ self.covariance @ moved.T)

    def added(self, state: InertialState, covariance: F64, drift: F64) -> FrameJump:
        """Return this and a further jump.

        Parameters
        ----------
        state : InertialState
            Where it happens.
        covariance : ndarray, shape (18, 18)
            Of the state, relative to the map before.
        drift : ndarray, shape (6, 6)
            Of that map itself, at the state's place.
        """
        jump = pose_covariance(state, covariance)
        return FrameJump(state.position, self.at(state.position) + jump + drift)

    def unseen(self, state: InertialState) -> FrameJump:
        """Return this and what may have happened from a state on while no time was told."""
        way = tuning.UNSEEN_POSITION + tuning.UNSEEN_S * float(np.linalg.norm(state.velocity))
        jump = np.diag(np.square([way] * 3 + [tuning.UNSEEN_ROTATION] * 3))
        return FrameJump(state.position, self.at(state.position) + jump)
