"""Settings that contradict each other are refused by name, those at the limit are taken."""

from __future__ import annotations

from typing import Any

import pytest

from l2lidar_node.settings import SettingError, build
from l2lidar_proc.deskew.config import DeskewNodeConfig


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"range_min": 5.0, "range_max": 1.0},
            "'range_min': 5.0 is out of range, expected at most range_max",
        ),
        ({"vertical_min": 9.0, "vertical_max": -9.0}, "'vertical_min': 9.0 is out of range"),
        ({"intensity_min": 9.0, "intensity_max": 8.0}, "'intensity_min': 9.0 is out of range"),
        (
            {"keep_boxes": (0.0,) * 7},
            "'keep_boxes': 7 numbers are not valid, expected six per box",
        ),
        (
            {"remove_boxes": (0.0,) * 5},
            "'remove_boxes': 5 numbers are not valid, expected six per box",
        ),
        ({"scan_height_min": 0.1}, "'scan_height_min': 0.1 is out of range, .*less"),
        ({"scan_range_min": 30.0}, "'scan_range_min': 30.0 is out of range, .*less"),
        ({"imu_xyz": (1.0, 2.0)}, "'imu_xyz': .*expected three numbers"),
    ],
)
def test_limits_that_leave_nothing_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        build(DeskewNodeConfig, values)


def test_limits_may_meet_where_one_value_is_kept() -> None:
    equal = {"range_min": 3.0, "range_max": 3.0, "intensity_min": 7.0, "intensity_max": 7.0}
    boxes = {"keep_boxes": (0.0,) * 12, "scan_height_min": 0.09, "scan_range_min": 29.9}
    built = build(DeskewNodeConfig, {**equal, **boxes})
    assert built.proc.filters.range_min == built.proc.filters.range_max == 3.0
    assert len(built.proc.filters.keep_boxes) == 12
