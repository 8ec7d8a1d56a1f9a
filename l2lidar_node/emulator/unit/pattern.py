"""Cheap measurements without a world, for load and clock tests: a shell seen standing still."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.unit.flash import CALIBRATION, RANGE_MAX_M, RANGE_MIN_M
from l2lidar_node.protocol import wire

_HEAD_PERIOD_S: Final = 0.229769
_FLAT_PERIOD_S: Final = 0.02
_WIDE_START_RAD: Final = -0.105  # of the mirror; 192 degrees instead of 180
_STATE: Final = (4639, 229769, 0.0, 0.0, 0.0, 43.7, 154.16, 51.38, 60.8)
"""Inside state of a published unit, in the order of :data:`wire.INSIDE_STATE`."""


class PatternScanner:
    """Points on a shell of 3 m radius with bars every 15 degrees, 4 % without return.

    Parameters
    ----------
    wide : bool
        Field of view of 192 instead of 180 degrees.
    flat : bool
        2D packets instead of 3D ones: one plane, no head angle.
    empty : bool
        No slot returns anything.
    """

    def __init__(self, wide: bool = False, flat: bool = False, empty: bool = False) -> None:
        self._flat = flat
        dtype = wire.POINTS_2D_PAYLOAD if flat else wire.POINTS_3D_PAYLOAD
        slots = wire.POINTS_PER_2D_PACKET if flat else wire.POINTS_PER_3D_PACKET
        self._period_s = _FLAT_PERIOD_S if flat else wire.MIRROR_PERIOD_S
        start = _WIDE_START_RAD if wide else 0.0
        row = np.zeros(1, dtype)
        row["state"] = _STATE
        row["calibration"] = CALIBRATION
        row["scan_period"] = self._period_s
        row["range_min"], row["range_max"] = RANGE_MIN_M, RANGE_MAX_M
        row["angle_min"] = start
        row["angle_increment"] = (math.pi - 2.0 * start) / slots
        row["time_increment"] = self._period_s / (2 * slots)
        row["point_num"] = slots
        slot = np.arange(slots)
        raw = 365.625 + (3.0 + 0.05 * ((slot * 12 // slots) % 2)) / 0.000978
        row["ranges"] = 0 if empty else np.where(slot % 25 == 24, 0, np.rint(raw))
        row["intensities"] = 60 + 120 * slot // slots
        if not flat:
            row["com_horizontal_angle_step"] = (
                2.0 * math.pi * row["time_increment"] / _HEAD_PERIOD_S
            )
        self._row = row

    def packets(self, first: int, count: int) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        """Return packets and their start times; see :class:`sources.Source`."""
        t_s = np.arange(first, first + count, dtype=np.float64) * self._period_s
        payloads = np.repeat(self._row, count)
        if not self._flat:
            angle = 2.0 * math.pi * t_s / _HEAD_PERIOD_S
            payloads["com_horizontal_angle_start"] = np.mod(angle, 2.0 * math.pi)
        return payloads, np.asarray(t_s)


class StillInertial:
    """Samples of an IMU that lies level and still, without noise."""

    def samples(self, first: int, count: int) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        """Return samples and their times; see :class:`sources.Source`."""
        payloads = np.zeros(count, wire.IMU_PAYLOAD)
        payloads["quaternion_wxyz"] = (wire.QUATERNION_NORM, 0.0, 0.0, 0.0)
        payloads["linear_acceleration"] = (0.0, 0.0, 9.81)
        return payloads, np.asarray(np.arange(first, first + count) / wire.IMU_RATE_HZ)
