"""Settings of the odometry that cannot work are refused by name."""

from __future__ import annotations

from typing import Any

import pytest

from l2lidar_node.settings import SettingError, build
from l2lidar_proc.odometry.config import OdometryNodeConfig


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"surface_sizes": ()}, "surface_sizes"),
        ({"surface_sizes": (1.0, 0.2)}, "surface_sizes"),
        ({"min_range": 5.0, "max_range": 1.0}, "min_range"),
        ({"base_frame": "/base link"}, "base_frame"),
        ({"odom_frame": ""}, "odom_frame"),
        ({"base_frame": "odom"}, "odom_frame"),
        ({"odometry_topic": "my odometry"}, "odometry_topic"),
    ],
)
def test_settings_that_cannot_work_are_refused_by_name(values: Any, name: str) -> None:
    with pytest.raises(SettingError, match=f"parameter '{name}': .*expected"):
        build(OdometryNodeConfig, values)


def test_settings_refuse_what_cannot_be() -> None:
    with pytest.raises(SettingError, match="map_file"):
        build(OdometryNodeConfig, {"map_file": "map.txt"})
    with pytest.raises(SettingError, match="did you mean 'base_frame'"):
        build(OdometryNodeConfig, {"base_fram": "x"})
    with pytest.raises(SettingError, match="imu_xyz"):
        build(OdometryNodeConfig, {"imu_xyz": (1.0,)})
