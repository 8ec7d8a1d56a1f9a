"""The clock of this host, and when somebody set it."""

from __future__ import annotations

import time
from typing import Final

from l2lidar_node.types import HostNs

_LEAST_NS: Final = 1_000_000  # smaller steps are left to the estimator of the device's clock
_SURE_NS: Final = 100_000  # two clocks that were read within that time were read at once
_TRIES: Final = 5


class HostClock:
    """The clock that arrivals are told in, CLOCK_REALTIME.

    People and time servers set it, nobody sets CLOCK_BOOTTIME. Both run at the same rate, even
    while time servers adjust it and while the host is suspended, so their difference changes only
    when this clock is set, and by as much.
    """

    def __init__(self) -> None:
        self._ahead_ns = _ahead_ns()

    def now(self) -> HostNs:
        """Return the time it shows."""
        return HostNs(time.time_ns())

    def step_ns(self) -> int:
        """Return by how much it was set since the last call; 0 when it was not."""
        before, after = self._ahead_ns, _ahead_ns()
        if after is None:
            return 0
        self._ahead_ns = after
        step = 0 if before is None else after - before
        return step if abs(step) >= _LEAST_NS else 0


def _ahead_ns() -> int | None:
    """Return by how much CLOCK_REALTIME is ahead; None where other programs always intervene."""
    for _ in range(_TRIES):
        before = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        shown = time.time_ns()
        elapsed = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - before
        if elapsed < _SURE_NS:
            return shown - before - elapsed // 2
    return None
