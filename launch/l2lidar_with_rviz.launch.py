"""Starts the driver, and RViz with the sensor's frame fixed."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, SetLaunchConfiguration
from launch.conditions import IfCondition
from launch.substitutions import (
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    """Return the driver and RViz."""
    share = FindPackageShare("l2lidar_node")
    l2_name = LaunchConfiguration("l2_name")
    return LaunchDescription(
        [
            # TF applies the mount: points that are level already would be turned once more.
            DeclareLaunchArgument(
                "imu_adjust",
                default_value="false",
                choices=["true", "false"],
                description="whether to level the points with the onboard IMU; true only for a "
                "sensor whose mount in TF is level",
            ),
            DeclareLaunchArgument(
                "rviz",
                default_value="true",
                choices=["true", "false"],
                description="whether to start RViz",
            ),
            DeclareLaunchArgument(
                "l2_name",
                default_value="",
                description="prefix of the frames, one for each sensor; empty uses params_file",
            ),
            SetLaunchConfiguration(
                "fixed_frame",
                [l2_name, "_link"],
                condition=IfCondition(NotEqualsSubstitution(l2_name, "")),
            ),
            # First: where there is no rviz2, nothing has been started yet.
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "rviz.launch.py"]),
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
            IncludeLaunchDescription(PathJoinSubstitution([share, "launch", "l2lidar.launch.py"])),
        ]
    )
