"""Starts the driver, deskew and odometry, and RViz where asked for."""

from launch import LaunchDescription

from l2lidar_node.ros.bringup import driver, for_deskew, rviz, start
from l2lidar_node.ros.launch_arguments import (
    BOOL,
    CUTS,
    DRIVER_ARGUMENTS,
    RVIZ_ARGUMENTS,
    Argument,
    arguments,
)
from l2lidar_proc.ros.bringup import deskew, odometry


def generate_launch_description() -> LaunchDescription:
    """Return driver, deskew, odometry and RViz."""
    return LaunchDescription(
        [
            *arguments(*DRIVER_ARGUMENTS, "proc_params_file"),
            *arguments(*RVIZ_ARGUMENTS, rviz_config="rviz/slam.rviz"),
            Argument("turn", "where a cloud ends", CUTS).declare("sweep_cut"),
            Argument("true", "whether to start the odometry node", BOOL).declare("odometry"),
            start(
                driver(lambda given: for_deskew(given["sweep_cut"])),
                deskew(),
                odometry("odometry"),
                rviz(),
            ),
        ]
    )
