"""Starts the driver with the parameters that a named LiDAR-inertial odometry needs."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

CONSUMERS = ["lio_sam", "fast_lio", "point_lio", "rko_lio", "glim", "kiss_icp"]


def generate_launch_description():
    """Return the driver with ``config/consumers/<consumer>/driver.yaml`` over its parameters."""
    share = FindPackageShare("l2lidar_node")
    consumer = LaunchConfiguration("consumer")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "consumer", choices=CONSUMERS, description="consumer of the clouds"
            ),
            DeclareLaunchArgument(
                "rviz",
                default_value="false",
                choices=["true", "false"],
                description="whether to start RViz",
            ),
            # First: where there is no rviz2, nothing has been started yet.
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "rviz.launch.py"]),
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "l2lidar.launch.py"]),
                launch_arguments={
                    "override_params_file": PathJoinSubstitution(
                        [share, "config", "consumers", consumer, "driver.yaml"]
                    )
                }.items(),
            ),
        ]
    )
