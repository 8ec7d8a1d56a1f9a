"""Starts the driver as a named LiDAR-inertial odometry wants its input."""

from launch import LaunchDescription

from l2lidar_node.ros.bringup import driver, rviz, start
from l2lidar_node.ros.launch_arguments import (
    DRIVER_ARGUMENTS,
    RVIZ_ARGUMENTS,
    Argument,
    arguments,
    share,
)

CONSUMERS = ("lio_sam", "fast_lio", "point_lio", "rko_lio", "glim", "kiss_icp")


def generate_launch_description() -> LaunchDescription:
    """Return the driver with ``config/consumers/<consumer>/driver.yaml`` over its parameters."""
    return LaunchDescription(
        [
            Argument(None, "what the clouds are for", CONSUMERS).declare("consumer"),
            *arguments(*DRIVER_ARGUMENTS, *RVIZ_ARGUMENTS),
            start(
                driver(
                    files=lambda given: [
                        share(f"config/consumers/{given['consumer']}/driver.yaml")
                    ]
                ),
                rviz(),
            ),
        ]
    )
