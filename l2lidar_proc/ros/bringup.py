"""The parts of a launch that are this package's: deskew and odometry."""

from __future__ import annotations

from l2lidar_node.ros.bringup import Parameters, Part, companion
from l2lidar_proc.config import DeskewNodeConfig, OdometryNodeConfig


def deskew(wanted: str = "", values: Parameters | None = None) -> Part:
    """Return the deskew node; see :func:`l2lidar_node.ros.bringup.companion`."""
    return companion("deskew_node", DeskewNodeConfig, wanted, values)


def odometry(wanted: str = "", values: Parameters | None = None) -> Part:
    """Return the odometry node; see :func:`l2lidar_node.ros.bringup.companion`."""
    return companion("odometry_node", OdometryNodeConfig, wanted, values)
