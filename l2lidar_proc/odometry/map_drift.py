"""Uncertainty of the map: what a sweep adds carries that of the pose which added it.

A sweep that is aligned with what the last few sweeps have put into the map learns where it is
relative to them, not where it is. So every cell remembers the sweep that opened it, every sweep
how uncertain its pose was, and a pose is as uncertain as the surfaces that hold it, and by its
alignment with them besides (VoxelMap, Yuan et al. 2022, carries the like in its planes).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import skew
from l2lidar_proc.odometry.correspondences import Support

F64 = NDArray[np.float64]


class MapDrift:
    """How wrong the map may be where it is in use, as a small move of the whole map.

    Covariances (6, 6) are of a shift and a turn of the map about its origin [m, rad], in its axes.
    """

    def __init__(self) -> None:
        self._history = np.zeros((64, 6, 6), np.float32)
        self._ways = np.zeros(64)  # on which they were [m]
        self.clear()

    def clear(self) -> None:
        """Forget everything: a new map begins, without error by definition."""
        self._known = 0
        self._current = np.zeros((6, 6))
        self._way, self._before = 0.0, np.zeros(3)
        self._behind = 0.0  # way on which the surfaces were opened that hold the latest sweep [m]

    def meet(
        self,
        support: Support,
        place: F64 | None = None,
        weakly: tuple[F64, Support] | None = None,
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
        """
        sweeps, shares = support
        if not len(sweeps) or not self._known:
            return
        rows = self._rows(sweeps)
        self._current = np.tensordot(shares, self._history[rows].astype(np.float64), 1)
        self._behind = float(shares @ self._ways[rows])
        if place is None or weakly is None:
            return
        weakest, (sweeps, shares) = weakly
        holding = np.tensordot(shares, self._history[self._rows(sweeps)].astype(np.float64), 1)
        along = np.zeros((6, 6))
        along[:3, :3] = np.outer(weakest, weakest)
        self._combine(place, self._current, holding, along)

    def _rows(self, sweeps: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.clip(sweeps // tuning.DRIFT_GROUP, 0, self._known - 1)

    def _combine(self, place: F64, most: F64, some: F64, along: F64) -> F64:
        """Let the error be ``some`` along a projection (6, 6) of a place, else ``most``.

        Return what it is there.
        """
        moved, back = _carried(place), _carried(-place)
        across = np.eye(6) - along
        there = across @ moved @ most @ moved.T @ across + along @ moved @ some @ moved.T @ along
        self._current = back @ there @ back.T
        return np.asarray(there)

    def meet_partly(self, support: Support, place: F64, free: F64, ways: F64) -> None:
        """Take surfaces that leave some directions free: along these nothing is held.

        What is registered along them is where the sensor is relative to what the last sweeps put
        into the map with the same wrong velocity: that error adds up linearly, not by chance.

        Parameters
        ----------
        support : Support
            As in :meth:`meet`.
        place : ndarray, shape (3,)
            Of the sensor, map frame [m].
        free : ndarray, shape (3, K)
            The directions, orthonormal, map axes.
        ways : ndarray, shape (K,)
            By how much the place may have run away along each since the sweep before, 1 sigma [m].
        """
        before = self._current
        self.meet(support)
        along = np.zeros((6, 6))
        along[:3, :3] = free @ free.T
        now = self._combine(place, self._current, before, along)
        for direction, way in zip(free.T, ways.tolist(), strict=True):
            sigma = float(np.sqrt(max(direction @ now[:3, :3] @ direction, 0.0)))
            now[:3, :3] += (2.0 * sigma + way) * way * np.outer(direction, direction)
        back = _carried(-place)
        self._current = back @ now @ back.T

    def record(self, sweep: int, place: F64, covariance: F64) -> None:
        """Remember how uncertain the pose was that added a sweep.

        Parameters
        ----------
        sweep : int
            Its number in this map.
        place : ndarray, shape (3,)
            Where it was, map frame [m].
        covariance : ndarray, shape (6, 6)
            Of place and turn relative to the surfaces around, map axes [m, rad].
        """
        row = sweep // tuning.DRIFT_GROUP
        if row >= len(self._history):
            grown = np.zeros((2 * row, 6, 6), np.float32)
            grown[: len(self._history)] = self._history
            self._ways = np.concatenate((self._ways, np.zeros(2 * row - len(self._ways))))
            self._history = grown
        if self._known:
            self._way += float(np.linalg.norm(place - self._before))
        self._before = place
        self._ways[self._known : row + 1] = self._way
        moved = _carried(-place)
        self._history[self._known : row + 1] = self._current + moved @ covariance @ moved.T
        self._known = max(self._known, row + 1)

    def at(self, place: F64) -> F64:
        """Return what the map adds to the covariance (6, 6) of a pose at a place (3,) [m].

        What a unit's calibration is wrong by adds up with the distance; and with the way, where
        the map of the place that was there first is forgotten. The map bends where it grows: the
        attitude errs with the way as the vertical does.
        """
        moved = _carried(place)
        away = float(np.linalg.norm(place))
        left = 1.0 - np.exp(-max(away, self._behind) / tuning.UNIT_FROM_M)  # 0 defines the frame
        share = max(tuning.UNIT_SHARE * away, tuning.UNIT_WAY_SHARE * self._behind)
        shift = (tuning.UNIT_SHIFT * left) ** 2 + share**2
        bend = tuning.MAP_BEND**2 * max(away, self._behind)
        unit = np.diag([shift] * 3 + [(tuning.UNIT_TURN * left) ** 2 + bend] * 3)
        return np.asarray(moved @ self._current @ moved.T + unit)


def _carried(place: F64) -> F64:
    """Return what a shift and a turn about the origin do at a place: (6, 6)."""
    moved = np.eye(6)
    moved[:3, 3:] = -skew(place)
    return moved
