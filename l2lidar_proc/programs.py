"""Starts the nodes; see :mod:`l2lidar_node.programs`."""

from __future__ import annotations

from l2lidar_node.programs import run


def deskew_node() -> int:
    """Run the deskew node."""
    return run("l2lidar_proc.ros.deskew_node")


def companion_node() -> int:
    """Run deskew and odometry in one process."""
    return run("l2lidar_proc.ros.companion_node")


def odometry_node() -> int:
    """Run the odometry node."""
    return run("l2lidar_proc.ros.odometry_node")


def slam_node() -> int:
    """Run the SLAM node."""
    return run("l2lidar_proc.ros.slam_node")
