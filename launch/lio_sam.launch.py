"""Starts the driver, deskew and LIO-SAM (branch ros2) as they work together, and RViz.

docs/slam.md tells how to build LIO-SAM.
"""

import os

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    IncludeLaunchDescription,
    OpaqueFunction,
    SetEnvironmentVariable,
)
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from l2lidar_node.ros.launching import (
    DRIVER_REMAPPINGS,
    file_given,
    parameters_given,
    required,
)

LIO_SAM_NODES = ("imuPreintegration", "imageProjection", "featureExtraction", "mapOptimization")
# The first is that of the Fast DDS of Jazzy, the second that of newer ones.
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")


def check_packages(context):
    """Refuse to start if a package is not installed."""
    needed = ["lio_sam", "tf2_ros"]
    if context.launch_configurations["rviz"] == "true":
        needed.append("rviz2")
    for package in needed:
        try:
            get_package_prefix(package)
        except PackageNotFoundError:
            raise RuntimeError(
                f"package '{package}' is not installed or not sourced; docs/slam.md of "
                "l2lidar_node says how to build LIO-SAM"
            ) from None


def shared_memory(context):
    """Return the Fast DDS profile for LIO-SAM's messages, unless the user has set one."""
    profile = file_given(context, "fastdds_profile")
    if any(os.environ.get(name) for name in PROFILE_VARIABLES):
        return []
    return [SetEnvironmentVariable(name, profile) for name in PROFILE_VARIABLES]


def launch_setup(context):
    """Return deskew and LIO-SAM."""
    given = context.launch_configurations
    base, lidar = given["base_frame"], f"{given['l2_name']}_link"
    parameters = [
        file_given(context, "lio_sam_params_file"),
        {"lidarFrame": lidar, "baselinkFrame": base},
    ]
    known = parameters_given(context, ["calibration_file"])
    return [
        *(
            Node(
                package="lio_sam",
                executable=f"lio_sam_{name}",
                name=f"lio_sam_{name}",
                namespace="",
                parameters=parameters,
                output="screen",
                on_exit=required(),
            )
            for name in LIO_SAM_NODES
        ),
        Node(
            package="l2lidar_node",
            executable="deskew_node",
            name="deskew_node",
            namespace="",
            parameters=[
                file_given(context, "proc_params_file"),
                file_given(context, "deskew_params_file"),
                *([known] if known else []),
            ],
            remappings=DRIVER_REMAPPINGS,
            output="screen",
            on_exit=required(),
        ),
    ]


def generate_launch_description():
    """Return driver, deskew, LIO-SAM and RViz."""
    share = FindPackageShare("l2lidar_node")
    consumer = PathJoinSubstitution([share, "config", "consumers", "lio_sam"])
    lidar_frame = [LaunchConfiguration("l2_name"), "_link"]
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "rviz",
                default_value="true",
                choices=["true", "false"],
                description="whether to start RViz",
            ),
            DeclareLaunchArgument(
                "l2_name", default_value="l2lidar", description="prefix of the sensor's frames"
            ),
            DeclareLaunchArgument(
                "base_frame",
                default_value="base_link",
                description="frame that LIO-SAM moves in odom; must differ from the cloud frame, "
                "or its TF has an empty frame",
            ),
            DeclareLaunchArgument(
                "publish_base_tf",
                default_value="true",
                choices=["true", "false"],
                description="whether to put the sensor at the origin of base_frame; false if "
                "a robot's description has its mount",
            ),
            DeclareLaunchArgument(
                "calibration_file",
                default_value="",
                description="file of l2lidar calibrate for this unit, for the driver and deskew; "
                "empty uses their parameter files",
            ),
            DeclareLaunchArgument(
                "lio_sam_params_file",
                default_value=PathJoinSubstitution([consumer, "params.yaml"]),
                description="parameters of LIO-SAM",
            ),
            DeclareLaunchArgument(
                "proc_params_file",
                default_value=PathJoinSubstitution([share, "config", "l2lidar_proc.yaml"]),
                description="parameters of deskew",
            ),
            DeclareLaunchArgument(
                "deskew_params_file",
                default_value=PathJoinSubstitution([consumer, "deskew.yaml"]),
                description="deskew parameters that override proc_params_file",
            ),
            DeclareLaunchArgument(
                "fastdds_profile",
                default_value=PathJoinSubstitution([share, "config", "fastdds_lio_sam.xml"]),
                description="Fast DDS profile, unless the environment sets one",
            ),
            DeclareLaunchArgument(
                "rviz_config",
                default_value=PathJoinSubstitution([share, "rviz", "lio_sam.rviz"]),
                description="RViz layout",
            ),
            OpaqueFunction(function=check_packages),
            OpaqueFunction(function=shared_memory),
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "rviz.launch.py"]),
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                name="map_to_odom",
                arguments=["--frame-id", "map", "--child-frame-id", "odom"],
            ),
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                name="base_to_l2lidar",
                arguments=[
                    "--frame-id",
                    LaunchConfiguration("base_frame"),
                    "--child-frame-id",
                    lidar_frame,
                ],
                condition=IfCondition(LaunchConfiguration("publish_base_tf")),
            ),
            OpaqueFunction(function=launch_setup),
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "l2lidar.launch.py"]),
                launch_arguments={
                    "override_params_file": PathJoinSubstitution([consumer, "driver.yaml"])
                }.items(),
            ),
        ]
    )
