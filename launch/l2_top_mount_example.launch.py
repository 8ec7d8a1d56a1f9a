"""Starts an example robot with the L2 on its upper face, looking up."""

from launch import LaunchDescription

from l2lidar_node.ros.bringup import driver, robot, rviz, start
from l2lidar_node.ros.launch_arguments import EXAMPLE_ARGUMENTS, RVIZ_ARGUMENTS, arguments


def generate_launch_description() -> LaunchDescription:
    """Return robot_state_publisher, driver and RViz."""
    return LaunchDescription(
        [
            *arguments(*EXAMPLE_ARGUMENTS),
            *arguments(*RVIZ_ARGUMENTS, rviz="true", rviz_config="rviz/rvizl2lidar_example.rviz"),
            start(robot("l2_top_mount_example.urdf"), driver(), rviz()),
        ]
    )
