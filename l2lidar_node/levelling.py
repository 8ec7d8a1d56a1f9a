"""Knows the rotation into a levelled frame from the sensor's own orientation, one per packet.

This is what upstream's ``imu_adjust`` does. It is no motion compensation: it turns each packet as
a whole, knows no translation, and its result is level with gravity instead of fixed to the sensor.
The companion package deskews properly and needs this off.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs, ImuSample

MAX_AGE_NS: Final = 80_000_000  # upstream's tolerance between a packet and its orientation
_HISTORY: Final = 8192  # samples, 32 s: more than the longest sweep


class Levelling:
    """Remembers the latest orientations and makes rotations of them.

    Parameters
    ----------
    roll_pitch_only : bool
        Leave out the yaw, which is arbitrary and drifts.
    """

    def __init__(self, roll_pitch_only: bool) -> None:
        self.roll_pitch_only = roll_pitch_only
        self._samples: deque[ImuSample] = deque(maxlen=_HISTORY)

    def add(self, sample: ImuSample) -> None:
        """Remember a sample; they come in ascending order."""
        self._samples.append(sample)

    def clear(self) -> None:
        """Forget all samples, for example because the time line began anew."""
        self._samples.clear()

    def __call__(self, starts: list[HostNs]) -> NDArray[np.float64]:
        """Return the rotations of packets from the cloud frame into the levelled frame.

        Parameters
        ----------
        starts : list of HostNs, length P
            When the packets began, ascending; what is older than the first is forgotten.

        Returns
        -------
        ndarray, shape (P, 3, 3)
            By the orientation nearest to each start; NaN where none is within
            :data:`MAX_AGE_NS`.
        """
        while self._samples and self._samples[0].stamp < starts[0] - MAX_AGE_NS:
            self._samples.popleft()
        if not self._samples:
            return np.full((len(starts), 3, 3), np.nan)
        instants = np.array(starts, np.int64)
        stamps = np.array([sample.stamp for sample in self._samples], np.int64)
        after = np.searchsorted(stamps, instants).clip(max=len(stamps) - 1)
        before = (after - 1).clip(min=0)
        is_before_nearer = instants - stamps[before] <= stamps[after] - instants
        nearest = np.where(is_before_nearer, before, after)
        wxyz = np.array([sample.orientation_wxyz for sample in self._samples])
        rotations = _rotations(wxyz[nearest])
        if self.roll_pitch_only:
            rotations = _without_yaw(rotations)
        rotations[np.abs(stamps[nearest] - instants) > MAX_AGE_NS] = np.nan
        return rotations


def _rotations(wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrices, (P, 3, 3), of unit quaternions, (P, 4)."""
    w, x, y, z = wxyz.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def _without_yaw(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotations, (P, 3, 3), turned back about the vertical by their yaw."""
    yaw = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    cos, sin, zero = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))
    rows = [[cos, sin, zero], [-sin, cos, zero], [zero, zero, zero + 1.0]]
    return np.asarray(np.array(rows).transpose(2, 0, 1) @ rotations)
