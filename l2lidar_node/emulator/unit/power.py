"""The unit's power-on timeline: from when on it hears commands, sends IMU and point packets."""

from __future__ import annotations

from enum import Enum

from l2lidar_node.emulator.config import PowerConfig


class Readiness(Enum):
    """How far the unit has come since it booted."""

    DEAF = "deaf"  # no link yet
    BOOTING = "booting"  # hears commands, has produced nothing yet
    SPINNING_UP = (
        "spinning up"  # sends IMU packets or waits for a start, no point packet produced yet
    )
    INITIALISED = "initialised"  # has produced a point packet since it booted


class Power:
    """Knows since when the unit is on and from when on each stream flows.

    Attributes
    ----------
    imu_from_ns, points_from_ns : int or None
        True instant from which on the stream flows; None in standby.
    """

    def __init__(self, config: PowerConfig, now_ns: int, waits: bool = False) -> None:
        self._config = config
        self.boot(now_ns, waits)

    def boot(self, now_ns: int, waits: bool) -> None:
        """Switch on at a true instant; one that waits stays in standby until a start command."""
        config = self._config
        self._link_ns = now_ns + self._ns(config.link_s)
        self._awake_ns = now_ns + self._ns(config.imu_s)
        self._initialised_ns: int | None = None
        self.imu_from_ns: int | None = None if waits else self._awake_ns
        self.points_from_ns: int | None = None if waits else now_ns + self._ns(config.points_s)

    def start(self, now_ns: int) -> None:
        """Leave standby; without effect on a unit that runs or spins up already."""
        if self.is_standby and self._config.wakes:
            self.imu_from_ns = max(now_ns + self._ns(self._config.wake_imu_s), self._awake_ns)
            self.points_from_ns = max(
                now_ns + self._ns(self._config.wake_points_s), self._awake_ns
            )

    def stop(self, now_ns: int) -> None:
        """Go to standby: both streams end."""
        self._note(now_ns)
        self.imu_from_ns = self.points_from_ns = None

    @property
    def is_standby(self) -> bool:
        """Whether the motors stand still on request."""
        return self.points_from_ns is None

    def readiness(self, now_ns: int) -> Readiness:
        """Return how far the unit has come at a true instant."""
        self._note(now_ns)
        if now_ns < self._link_ns:
            return Readiness.DEAF
        if now_ns < self._awake_ns:
            return Readiness.BOOTING
        return Readiness.SPINNING_UP if self._initialised_ns is None else Readiness.INITIALISED

    def _note(self, now_ns: int) -> None:
        if (
            self._initialised_ns is None
            and self.points_from_ns is not None
            and now_ns >= self.points_from_ns
        ):
            self._initialised_ns = self.points_from_ns

    def _ns(self, seconds: float) -> int:
        return round(seconds * self._config.boot_scale * 1e9)
