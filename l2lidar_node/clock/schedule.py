"""Decides when the device's clock is to be set, and whether it was."""

from __future__ import annotations

from typing import Final

from l2lidar_node.config import ClockConfig
from l2lidar_node.types import HostNs

_AGAIN_NS: Final = (
    1_000_000_000  # a single sync that did not take effect is repeated after this long
)
_SLACK_NS: Final = 50_000_000
_END_NS: Final = (1 << 32) * 1_000_000_000  # the device counts seconds in 32 bits
_FASTEST: Final = 2  # device seconds per true second, at most


class SyncSchedule:
    """When to send a time-sync command: never, until one took effect, or periodically.

    Attributes
    ----------
    in_force : bool
        Whether the device's clock counts from a sync of this host; always true if none is wanted.
    """

    def __init__(self, config: ClockConfig) -> None:
        self._wanted = config.enable_l2_host_sync
        self._once = config.l2_sync_mode == "once"
        interval = config.l2_sync_rate_ms * 1_000_000
        self._interval = max(interval, _AGAIN_NS) if self._once else interval
        self.reset()

    def reset(self) -> None:
        """Begin anew, as with a device that has just started."""
        self.in_force = not self._wanted
        self._sent: HostNs | None = None
        self._value = HostNs(0)

    def due(self, now: HostNs) -> bool:
        """Return whether a sync should be sent now; never where the device's clock has no room."""
        if not 0 <= now < _END_NS or not self._wanted or (self._once and self.in_force):
            return False
        return self._sent is None or not 0 <= now - self._sent < self._interval

    def sent(self, value: HostNs, sent: HostNs) -> None:
        """Take note of a sync that left the host."""
        self._value = value
        self._sent = sent

    def host_stepped(self, by_ns: int) -> None:
        """Take note that the host's clock was set."""
        if self._sent is not None:
            self._sent = HostNs(self._sent + by_ns)

    def seen(self, stamp: int, arrival: int) -> None:
        """Look at a stamp: a sync is in force when it counts from the value that was sent."""
        if self.in_force or self._sent is None:
            return
        elapsed = arrival - self._sent
        since = stamp - self._value
        self.in_force = 0 <= since <= _FASTEST * elapsed + _SLACK_NS
