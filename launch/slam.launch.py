"""Starts the driver, odometry and SLAM, and optionally RViz."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from l2lidar_node.ros.launching import (
    RESPAWN_DELAY_S,
    file_given,
    parameters_given,
    required,
)


def launch_setup(context):
    """Return the SLAM node."""
    given = context.launch_configurations
    is_respawned = given["respawn"] == "true"
    parameters = parameters_given(context, ["mode", "data_dir", "map_name"], ["load_map"])
    if given["use_sim_time"] == "true":
        parameters["use_sim_time"] = True
    return [
        Node(
            package="l2lidar_node",
            executable="slam_node",
            name="slam_node",
            namespace=LaunchConfiguration("namespace"),
            parameters=[
                file_given(context, "slam_params_file"),
                *([parameters] if parameters else []),
            ],
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            output="screen",
            respawn=is_respawned,
            respawn_delay=RESPAWN_DELAY_S,
            on_exit=required(is_respawned),
        )
    ]


def generate_launch_description():
    """Return driver, deskew, odometry, SLAM and RViz."""
    share = FindPackageShare("l2lidar_node")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "mode",
                default_value="",
                choices=["", "mapping", "localization"],
                description="mapping: the map grows; localization: it stays; empty uses "
                "slam_params_file",
            ),
            DeclareLaunchArgument(
                "load_map",
                default_value="",
                choices=["", "true", "false"],
                description="whether to start with the saved map; localization always does",
            ),
            DeclareLaunchArgument(
                "data_dir",
                default_value="",
                description="folder of the maps; empty uses slam_params_file",
            ),
            DeclareLaunchArgument(
                "map_name",
                default_value="",
                description="name of the map in data_dir; empty uses slam_params_file",
            ),
            DeclareLaunchArgument(
                "slam_params_file",
                default_value=PathJoinSubstitution([share, "config", "l2lidar_slam.yaml"]),
                description="parameters of SLAM",
            ),
            DeclareLaunchArgument(
                "rviz_config",
                default_value=PathJoinSubstitution([share, "rviz", "map.rviz"]),
                description="RViz layout",
            ),
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "deskew_odometry.launch.py"]),
            ),
            OpaqueFunction(function=launch_setup),
        ]
    )
