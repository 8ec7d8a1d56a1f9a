"""Companion node: deskew and odometry in one process, with shared subscriptions.

Both nodes keep their names, parameters, topics and services.
"""

from __future__ import annotations

import sys

from rclpy.node import Node

from l2lidar_node.ros.program import run_nodes
from l2lidar_proc.ros.deskew_node import DeskewNode
from l2lidar_proc.ros.odometry_node import OdometryNode


def make_nodes() -> list[Node]:
    """Return the odometry, and the deskew that shares its subscriptions and motion."""
    odometry = OdometryNode()
    try:
        return [odometry, DeskewNode(odometry)]
    except BaseException:
        odometry.destroy_node()
        raise


def main(args: list[str] | None = None) -> int:
    """Run both nodes; see :func:`l2lidar_node.ros.program.run_nodes`."""
    return run_nodes("companion_node", make_nodes, args)


if __name__ == "__main__":
    sys.exit(main())
