"""Starts the driver alone."""

from launch import LaunchDescription

from l2lidar_node.ros.bringup import driver, start
from l2lidar_node.ros.launch_arguments import DRIVER_ARGUMENTS, arguments


def generate_launch_description() -> LaunchDescription:
    """Return the driver, or with ``emulator:=true`` the driver and a virtual L2."""
    return LaunchDescription([*arguments(*DRIVER_ARGUMENTS), start(driver())])
