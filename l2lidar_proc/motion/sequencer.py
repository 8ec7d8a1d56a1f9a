"""Holds sweeps until IMU samples cover their end, or their time is up."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import Final

from l2lidar_node.types import HostNs, Sweep

_MOST: Final = 20  # sweeps that wait at once; beyond that the oldest goes as it is
_JUMP_NS: Final = 1_000_000_000


class Reason(Enum):
    """Why a sweep goes on."""

    COVERED = "IMU samples cover it"
    WAITED = "it waited long enough"
    CROWDED = "too many sweeps wait"
    CLOCK_JUMP = "the clock jumped"


@dataclass(frozen=True, slots=True)
class Release:
    """A sweep that waits no longer.

    Attributes
    ----------
    sweep : Sweep
    reason : Reason
    waited_ns : int
        How long it was held.
    """

    sweep: Sweep
    reason: Reason
    waited_ns: int


class Sequencer:
    """First in, first out; nothing is lost.

    Parameters
    ----------
    wait_ns : int
        Longest time a sweep is held.
    """

    def __init__(self, wait_ns: int) -> None:
        self.wait_ns = wait_ns
        self._waiting: deque[tuple[Sweep, int]] = deque()
        self._jumped: list[tuple[Sweep, int]] = []
        self._last_start: HostNs | None = None

    def __len__(self) -> int:
        """Return how many sweeps wait."""
        return len(self._waiting) + len(self._jumped)

    @property
    def due_ns(self) -> int | None:
        """When the first sweep's time is up, None if none waits."""
        return self._waiting[0][1] + self.wait_ns if self._waiting else None

    def push(self, sweep: Sweep, now: int) -> bool:
        """Take a sweep that arrives at ``now`` [ns]; return whether the clock jumped back with it.

        After a jump those that wait belong to another time and are released as they are.
        """
        jumped = self._last_start is not None and sweep.start < self._last_start - _JUMP_NS
        if jumped:
            self.jump()
        self._last_start = sweep.start
        self._waiting.append((sweep, now))
        return jumped

    def jump(self) -> None:
        """Give up on the sweeps that wait, as after a jump of the IMU's clock."""
        self._jumped.extend(self._waiting)
        self._waiting.clear()

    def release(self, newest_imu: HostNs | None, now: int) -> list[Release]:
        """Return the sweeps that need not wait any more, in order.

        Parameters
        ----------
        newest_imu : HostNs or None
            Stamp of the newest IMU sample.
        now : int
            The same clock as in :meth:`push` [ns].
        """
        released = [Release(s, Reason.CLOCK_JUMP, now - since) for s, since in self._jumped]
        self._jumped.clear()
        while self._waiting:
            sweep, since = self._waiting[0]
            if newest_imu is not None and newest_imu >= sweep.end:
                reason = Reason.COVERED
            elif now - since >= self.wait_ns:
                reason = Reason.WAITED
            elif len(self._waiting) > _MOST:
                reason = Reason.CROWDED
            else:
                break
            self._waiting.popleft()
            released.append(Release(sweep, reason, now - since))
        return released
