"""When what was recorded is due in a replay, whatever was done to the host's clock meanwhile."""

from __future__ import annotations

from collections import deque
from typing import Final

from l2lidar_node.types import HostNs

LONGEST_PAUSE_NS: Final = 60_000_000_000
"""A longer one may be a step that nobody noted, and nobody wants to wait for the end of either."""

_BACKLOG_NS: Final = 10_000_000_000
"""Longest that datagrams wait in the kernel until they are read."""


class TimeLine:
    """Line of time without the steps of the clock that a recording's times are from.

    Datagrams have the time of their arrival, and a step is noted when it has been noticed. So
    just before and after the note there are times by either clock. An entry is on the line where
    the clock places it that places it nearest to what was before.

    Parameters
    ----------
    start : HostNs
        What the clock shows until the line begins.
    """

    def __init__(self, start: HostNs) -> None:
        self._begin: int | None = None
        self._latest = int(start)
        self._ahead = 0  # of the clock: what it shows minus the place on the line
        self._coming: deque[int] = deque()
        self._last_step = 0
        self._forget_at = 0

    @property
    def has_begun(self) -> bool:
        """Whether :meth:`begin` was called."""
        return self._begin is not None

    @property
    def now(self) -> HostNs:
        """What the clock shows at the latest place on the line; never goes back but by a step."""
        return HostNs(self._latest + self._ahead)

    def foresee(self, by_ns: int) -> None:
        """Record a step whose note is among the next entries."""
        self._coming.append(by_ns)

    def step(self) -> None:
        """Record that the note of the next foreseen step is reached."""
        by_ns = self._coming.popleft()
        if self.has_begun:
            self._ahead += by_ns
            self._last_step = by_ns
            self._forget_at = self._latest + _BACKLOG_NS

    def begin(self, time: HostNs) -> None:
        """Begin the line at an instant; steps before it do not matter."""
        self._begin = self._latest = time

    def place(self, time: HostNs) -> int:
        """Return how long after the beginning an entry of this time is due [ns].

        Never less than before, and 0 before the line begins.
        """
        if self._begin is None:
            return 0
        if self._latest > self._forget_at:
            self._last_step = 0
        ahead = self._ahead
        clocks = [ahead, ahead - self._last_step]
        for by_ns in self._coming:
            ahead += by_ns
            clocks.append(ahead)
        later = min((time - clock - self._latest for clock in clocks), key=abs)
        if later > LONGEST_PAUSE_NS:
            self._ahead += later - LONGEST_PAUSE_NS
            later = LONGEST_PAUSE_NS
        elif later < -_BACKLOG_NS:
            self._ahead += later
        self._latest += max(later, 0)
        return self._latest - self._begin
