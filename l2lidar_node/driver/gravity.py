"""Compares what the accelerometer measures with gravity and with the onboard orientation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from l2lidar_node.types import ImuSample

GRAVITY: Final = 9.80665  # [m/s^2]


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
    """Averages samples; cheap enough for every one of them."""

    def __init__(self) -> None:
        self._count = 0
        self._x = self._y = self._z = 0.0
        self._last: ImuSample | None = None

    def add(self, sample: ImuSample) -> None:
        """Take one sample."""
        x, y, z = sample.linear_acceleration
        self._count += 1
        self._x += x
        self._y += y
        self._z += z
        self._last = sample

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
