"""The parts of a launch that are this package's: deskew and odometry."""

from __future__ import annotations

from launch.actions import OpaqueFunction
from launch.conditions import IfCondition

from l2lidar_node.ros.bringup import Parameters, companion
from l2lidar_proc.config import DeskewNodeConfig
from l2lidar_proc.odometry_config import OdometryNodeConfig


def deskew(
    condition: IfCondition | None = None, values: Parameters | None = None
) -> OpaqueFunction:
    """Return the deskew node; see :func:`l2lidar_node.ros.bringup.companion`."""
    return companion("deskew_node", DeskewNodeConfig, condition, values)


def odometry(
    condition: IfCondition | None = None, values: Parameters | None = None
) -> OpaqueFunction:
    """Return the odometry node; see :func:`l2lidar_node.ros.bringup.companion`."""
    return companion("odometry_node", OdometryNodeConfig, condition, values)
