"""Clock of this host, and detection of its steps and slewing."""

from __future__ import annotations

import time
from typing import Final

from l2lidar_node.types import HostNs

_LEAST_NS: Final = 1_000_000  # smaller steps are left to the estimator of the device's clock
_SURE_NS: Final = 100_000  # two clocks that were read within that time were read at once
_TRIES: Final = 5
_SLEW_ERROR_NS: Final = 1_000  # beyond which the last two reports do not predict the slewing
_SLEW_EVERY_NS: Final = 100_000_000  # between two reports of slewing, at least
_SLEW_JUMP_NS: Final = 50_000  # beyond which a report cannot wait so long
_SLEW_SURE_NS: Final = 10_000  # to which slewing is read, at worst


class HostClock:
    """The clock of arrival times, CLOCK_REALTIME.

    People and time servers set it; CLOCK_BOOTTIME is never set. Both run at the same rate, even
    while time servers adjust it and while the host is suspended, so their difference changes only
    when this clock is set, and by as much.

    Time servers also slew it: they adjust the rate of CLOCK_REALTIME and CLOCK_MONOTONIC, not that
    of CLOCK_MONOTONIC_RAW, which counts the bare oscillator. These two are never set and both stop
    while the host is suspended, so their difference changes by the slewing alone.
    """

    def __init__(self) -> None:
        self._ahead_ns = _ahead_ns()
        self._reports: list[tuple[int, int]] = []  # the last two: instant, slewing

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

    def slewed_ns(self) -> int | None:
        """Return by how much slewing has moved it since a fixed instant [ns].

        None while that is on the straight line through the last two answers, or cannot be read.
        """
        read = self._read_slewing()
        if read is None:
            return None
        at, slewed, error = read
        reports = self._reports
        if reports:
            (t0, s0), (t1, s1) = reports[0], reports[-1]
            since = at - t1
            predicted = s1 + ((s1 - s0) * since // (t1 - t0) if t1 > t0 else 0)
            most = _SLEW_ERROR_NS if since >= _SLEW_EVERY_NS else _SLEW_JUMP_NS
            if abs(slewed - predicted) <= most + error:
                return None
        self._reports = [*reports[-1:], (at, slewed)]
        return slewed

    def _read_slewing(self) -> tuple[int, int, int] | None:
        """Return an instant, how far the clock was slewed, and how far that may be off [ns].

        The best of a few readings, or the first that is good enough; None where other programs
        always intervene.
        """
        best: tuple[int, int, int] | None = None
        for _ in range(_TRIES):
            before = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
            raw = time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)
            elapsed = time.clock_gettime_ns(time.CLOCK_MONOTONIC) - before
            if elapsed < 2 * _SLEW_SURE_NS and (best is None or elapsed < 2 * best[2]):
                best = before, before + elapsed // 2 - raw, elapsed // 2 + 1
            if elapsed <= _SLEW_ERROR_NS:
                break
        return best


def _ahead_ns() -> int | None:
    """Return by how much CLOCK_REALTIME is ahead; None where other programs always intervene."""
    for _ in range(_TRIES):
        before = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        shown = time.time_ns()
        elapsed = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - before
        if elapsed < _SURE_NS:
            return shown - before - elapsed // 2
    return None
