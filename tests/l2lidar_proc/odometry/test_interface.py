"""Which sweeps follow, which are late, and which begin another time line."""

from __future__ import annotations

import pytest

from l2lidar_proc import tuning
from l2lidar_proc.odometry.interface import SweepOrder, sweep_order


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        (1, SweepOrder.FOLLOWS),
        (tuning.TIME_JUMP_NS, SweepOrder.FOLLOWS),
        (tuning.TIME_JUMP_NS + 1, SweepOrder.OTHER_TIME_LINE),
        (0, SweepOrder.LATE),
        (1 - tuning.LONG_GAP_NS, SweepOrder.LATE),
        (-tuning.LONG_GAP_NS, SweepOrder.OTHER_TIME_LINE),
    ],
)
def test_the_order_changes_at_its_limits(step: int, expected: SweepOrder) -> None:
    assert sweep_order(step) is expected
