"""The onboard orientation: gravity alignment of points, and a check against gravity.

This is upstream's ``imu_adjust``. It is not motion compensation: it rotates each packet as a
whole, ignores translation, and its result is level with gravity instead of fixed to the sensor.
The companion package deskews properly and needs this off.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import HostNs, ImuSample

MAX_AGE_NS: Final = 80_000_000  # upstream's tolerance between a packet and its orientation
_CAPACITY: Final = 16_384  # samples; half of it, 32 s, is more than the longest sweep

_SAMPLE: Final = np.dtype([("stamp", "<i8"), ("wxyz", "<f8", (4,))])
_PACKED: Final = struct.Struct("<q4d")  # the same


class GravityAlignment:
    """Remembers the latest orientations and makes rotations of them.

    Its length is how many it remembers.

    Parameters
    ----------
    roll_pitch_only : bool
        Leave out the yaw, which is arbitrary and drifts.
    """

    def __init__(self, roll_pitch_only: bool) -> None:
        self.roll_pitch_only = roll_pitch_only
        self._samples: NDArray[np.void] = np.empty(_CAPACITY, _SAMPLE)
        self._octets = self._samples.view(np.uint8).data  # to write one in a single call
        self._count = 0

    def __len__(self) -> int:
        """Return the number of samples."""
        return self._count

    def add(self, samples: Sequence[ImuSample]) -> None:
        """Remember samples; they come in ascending order."""
        for sample in samples:
            if self._count == _CAPACITY:
                self._forget(_CAPACITY // 2)
            at = self._count * _PACKED.size
            _PACKED.pack_into(self._octets, at, sample.stamp, *sample.orientation_wxyz)
            self._count += 1

    def clear(self) -> None:
        """Forget all samples, for example because the time line began anew."""
        self._count = 0

    def __call__(self, starts: list[HostNs]) -> NDArray[np.float64]:
        """Return the rotations of packets from the cloud frame into the leveled frame.

        Parameters
        ----------
        starts : list of HostNs, length P
            When the packets began, ascending; what is too old for the first is forgotten.

        Returns
        -------
        ndarray, shape (P, 3, 3)
            By the orientation nearest to each start; NaN where none is within
            :data:`MAX_AGE_NS`.
        """
        stamps = self._samples["stamp"][: self._count]
        self._forget(int(np.searchsorted(stamps, starts[0] - MAX_AGE_NS)))
        if not self._count:
            return np.full((len(starts), 3, 3), np.nan)
        stamps = self._samples["stamp"][: self._count]
        instants = np.array(starts, np.int64)
        after = np.minimum(np.searchsorted(stamps, instants), self._count - 1)
        before = np.maximum(after - 1, 0)
        is_before_nearer = instants - stamps[before] <= stamps[after] - instants
        nearest = self._samples[np.where(is_before_nearer, before, after)]
        turns = rotations.matrices(nearest["wxyz"])
        if self.roll_pitch_only:
            turns = _without_yaw(turns)
        turns[np.abs(nearest["stamp"] - instants) > MAX_AGE_NS] = np.nan
        return turns

    def _forget(self, count: int) -> None:
        """Forget so many of the oldest samples."""
        self._count -= count
        self._samples[: self._count] = self._samples[count : count + self._count]


def _without_yaw(turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotations, (P, 3, 3), turned back about the vertical by their yaw."""
    yaw = np.arctan2(turns[:, 1, 0], turns[:, 0, 0])
    cos, sin, zero = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))
    rows = [[cos, sin, zero], [-sin, cos, zero], [zero, zero, zero + 1.0]]
    return np.asarray(np.array(rows).transpose(2, 0, 1) @ turns)


@dataclass(frozen=True, slots=True)
class GravityReport:
    """What one period's samples say.

    Attributes
    ----------
    samples : int
    norm : float
        Length of the mean specific force [m/s^2]; about 9.8 unless the sensor is thrown about.
    tilt_deg : float
        Angle between the mean specific force and up by the onboard orientation [deg].
    """

    samples: int
    norm: float
    tilt_deg: float


class GravityMonitor:
    """Averages samples."""

    def __init__(self) -> None:
        self._count = 0
        self._x = self._y = self._z = 0.0
        self._last: ImuSample | None = None

    def add(self, samples: Sequence[ImuSample]) -> None:
        """Take samples, at least one."""
        for sample in samples:
            x, y, z = sample.linear_acceleration
            self._x += x
            self._y += y
            self._z += z
        self._count += len(samples)
        self._last = samples[-1]

    def take(self) -> GravityReport | None:
        """Return the report of the samples since the last call; None without any."""
        if self._last is None or not self._count:
            return None
        mean = (self._x / self._count, self._y / self._count, self._z / self._count)
        norm = math.sqrt(sum(component * component for component in mean))
        w, x, y, z = self._last.orientation_wxyz
        up = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
        cosine = sum(a * b for a, b in zip(mean, up, strict=True)) / norm if norm else 0.0
        tilt = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
        report = GravityReport(self._count, norm, tilt)
        self._count = 0
        self._x = self._y = self._z = 0.0
        return report
