"""Remembers the recent velocities of the sensor and says which serve a sweep."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from l2lidar_node.types import HostNs
from l2lidar_proc.motion.sweep_trajectory import VELOCITY
from l2lidar_proc.rotations import F64, cross

_MOST_SPEED: Final = 1000.0  # [m/s]
_MOST: Final = 400  # two seconds of an odometry at IMU rate


class VelocityHistory:
    """Velocities in ascending order of time.

    Parameters
    ----------
    max_age_ns : int
        Older than this before what it is asked for, a velocity no longer counts.
    """

    def __init__(self, max_age_ns: int = 500_000_000) -> None:
        self.max_age_ns = max_age_ns
        self.source = ""
        self._stamps: deque[int] = deque(maxlen=_MOST)
        self._velocities: deque[F64] = deque(maxlen=_MOST)

    @property
    def newest(self) -> HostNs | None:
        """Stamp of the newest velocity, None when empty."""
        return HostNs(self._stamps[-1]) if self._stamps else None

    def push(self, stamp: HostNs, velocity: ArrayLike, source: str = "odometry") -> bool:
        """Take a velocity; one that is not finite or not later than the newest is refused.

        Parameters
        ----------
        stamp : HostNs
            Instant at which the sensor moved like that.
        velocity : array-like, shape (3,)
            Of the cloud frame's origin over the ground, in cloud axes [m/s].
        source : str
            Where it comes from, for reports; a new source empties the history.
        """
        vector = np.array(velocity, dtype=np.float64)
        if vector.shape != (3,) or not (np.abs(vector) <= _MOST_SPEED).all():
            return False
        if source != self.source:
            self.clear()
            self.source = source
        if self._stamps and stamp <= self._stamps[-1]:
            return False
        self._stamps.append(stamp)
        self._velocities.append(vector)
        return True

    def clear(self) -> None:
        """Forget everything, as after a jump of the clock."""
        self._stamps.clear()
        self._velocities.clear()

    def around(self, start: HostNs, end: HostNs) -> NDArray[np.void]:
        """Return what tells how the sensor moved from ``start`` to ``end``.

        Returns
        -------
        ndarray, shape (M,), dtype VELOCITY
            Those within, and the nearest on either side unless it is older than the limit; M may
            be 0.
        """
        stamps = np.array(self._stamps, dtype=np.int64)
        first = max(int(np.searchsorted(stamps, start, side="right")) - 1, 0)
        last = min(int(np.searchsorted(stamps, end)) + 1, len(stamps))
        if last - first > 1 and stamps[last - 1] - end > self.max_age_ns:
            last -= 1
        if first < len(stamps) and start - stamps[first] > self.max_age_ns:
            first += 1
        if first < last and stamps[first] - end > self.max_age_ns:
            first = last
        found = np.empty(max(last - first, 0), dtype=VELOCITY)
        for row, index in enumerate(range(first, last)):
            found[row] = self._stamps[index], self._velocities[index]
        return found

    def at(self, stamp: HostNs) -> F64 | None:
        """Return the velocity at one instant [m/s], shape (3,), None if none is near."""
        found = self.around(stamp, stamp)
        if not len(found):
            return None
        times = (found["stamp"] - stamp) * 1e-9
        return np.array([np.interp(0.0, times, axis) for axis in found["velocity"].T])


def carried_over(linear: ArrayLike, angular: ArrayLike, T_cloud_body: F64) -> F64:
    """Return the velocity of the cloud frame's origin in cloud axes [m/s], shape (3,).

    Parameters
    ----------
    linear, angular : array-like, shape (3,)
        Velocity [m/s] and rate [rad/s] of a body the sensor is fixed to, in the body's axes.
    T_cloud_body : ndarray, shape (4, 4)
        Body coordinates to cloud coordinates.
    """
    turn = T_cloud_body[:3, :3]
    place_of_cloud = -turn.T @ T_cloud_body[:3, 3]
    moved = np.asarray(linear, dtype=np.float64) + cross(angular, place_of_cloud)
    return np.asarray(turn @ moved)
