"""Order of sweeps in time: which follow, which are late, which begin another time line."""

from __future__ import annotations

from enum import Enum

from l2lidar_proc import tuning


class SweepOrder(Enum):
    """How a sweep lies in time relative to the one before."""

    FOLLOWS = "later"
    LATE = "late or repeated"  # it is refused
    OTHER_TIME_LINE = "far back or far ahead"  # the clock was set


def sweep_order(step_ns: int) -> SweepOrder:
    """Return how a sweep lies in time relative to the one before.

    Parameters
    ----------
    step_ns : int
        From the sweep before to this one [ns].
    """
    if -tuning.LONG_GAP_NS < step_ns <= 0:
        return SweepOrder.LATE
    if 0 < step_ns <= tuning.TIME_JUMP_NS:
        return SweepOrder.FOLLOWS
    return SweepOrder.OTHER_TIME_LINE
