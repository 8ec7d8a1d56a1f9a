"""Starts the driver, deskew and odometry, and optionally RViz."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from l2lidar_node.ros.launching import (
    DRIVER_REMAPPINGS,
    RESPAWN_DELAY_S,
    file_for,
    file_given,
    parameters_given,
    required,
)


def launch_setup(context):
    """Return deskew alone, or one process that hosts it and the odometry."""
    given = context.launch_configurations
    is_respawned = given["respawn"] == "true"
    parameters = [file_given(context, "proc_params_file")]
    if given["use_sim_time"] == "true":
        parameters.append({"use_sim_time": True})
    known = parameters_given(context, ["calibration_file"])
    if known:
        parameters.append(known)
    name = {"executable": "deskew_node", "name": "deskew_node"}
    if given["odometry"] == "true":
        # Without a name: the process hosts deskew_node and odometry_node.
        name = {"executable": "companion_node"}
        frames = parameters_given(context, ["odom_frame", "base_frame"])
        if frames:
            parameters.append(file_for("odometry_node", frames))
    return [
        Node(
            package="l2lidar_node",
            namespace=LaunchConfiguration("namespace"),
            parameters=parameters,
            remappings=DRIVER_REMAPPINGS,
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            output="screen",
            respawn=is_respawned,
            respawn_delay=RESPAWN_DELAY_S,
            on_exit=required(is_respawned),
            **name,
        )
    ]


def generate_launch_description():
    """Return driver, deskew, odometry and RViz."""
    share = FindPackageShare("l2lidar_node")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "sweep_cut",
                default_value="turn",
                choices=["packets", "turn", "half_turn", "duration"],
                description="where a cloud ends",
            ),
            DeclareLaunchArgument(
                "odometry",
                default_value="true",
                choices=["true", "false"],
                description="whether to start the odometry node",
            ),
            DeclareLaunchArgument(
                "proc_params_file",
                default_value=PathJoinSubstitution([share, "config", "l2lidar_proc.yaml"]),
                description="parameters of deskew and odometry",
            ),
            DeclareLaunchArgument(
                "odom_frame",
                default_value="",
                description="frame in which poses are given; empty uses proc_params_file",
            ),
            DeclareLaunchArgument(
                "base_frame",
                default_value="",
                description="frame whose pose is given, tied to the cloud frame by /tf_static; "
                "empty uses proc_params_file",
            ),
            DeclareLaunchArgument(
                "calibration_file",
                default_value="",
                description="file of l2lidar calibrate for this unit, for the driver, deskew and "
                "odometry; empty uses params_file and proc_params_file",
            ),
            DeclareLaunchArgument(
                "use_sim_time",
                default_value="false",
                choices=["true", "false"],
                description="whether time comes from /clock, as in a replay",
            ),
            DeclareLaunchArgument(
                "rviz",
                default_value="false",
                choices=["true", "false"],
                description="whether to start RViz",
            ),
            DeclareLaunchArgument(
                "rviz_config",
                default_value=PathJoinSubstitution([share, "rviz", "slam.rviz"]),
                description="RViz layout",
            ),
            # First: where there is no rviz2, nothing has been started yet.
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "rviz.launch.py"]),
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
            # Deskew needs the IMU, and points in the sensor's own frame.
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "l2lidar.launch.py"]),
                launch_arguments={
                    "imu_adjust": "false",
                    "enable_IMU_publishing": "true",
                }.items(),
            ),
            OpaqueFunction(function=launch_setup),
        ]
    )
