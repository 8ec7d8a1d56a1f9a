"""Starts the driver, and RViz with the sensor's frame fixed."""

from launch import LaunchDescription

from l2lidar_node.ros.bringup import driver, rviz, start
from l2lidar_node.ros.launch_arguments import DRIVER_ARGUMENTS, RVIZ_ARGUMENTS, arguments


def generate_launch_description() -> LaunchDescription:
    """Return the driver and RViz."""
    return LaunchDescription(
        [
            *arguments(*DRIVER_ARGUMENTS, *RVIZ_ARGUMENTS, rviz="true"),
            start(driver(), rviz()),
        ]
    )
