"""Plays a capture of raw packets through the driver, deskew and odometry."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
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

# The driver gives the recording's time on /clock.
RECORDED_TIME = {"use_sim_time": True}
# Deskew needs the IMU, and points in the sensor's own frame.
FOR_DESKEW = {"enable_IMU_publishing": True, "imu_adjust": False, "sweep_cut": "turn"}


def launch_setup(context):
    """Return the driver, and optionally deskew and odometry."""
    given = context.launch_configurations
    is_followed = given["deskew_odometry"] == "true"
    if is_followed and given["loop"] == "true":
        raise RuntimeError(
            "loop:=true jumps back to the start of the recording, which "
            "no odometry can follow; add deskew_odometry:=false"
        )
    common = {
        "package": "l2lidar_node",
        "namespace": LaunchConfiguration("namespace"),
        "remappings": DRIVER_REMAPPINGS,
        "ros_arguments": ["--log-level", LaunchConfiguration("log_level")],
        "output": "screen",
    }
    known = parameters_given(context, ["calibration_file"])
    replay = {
        **(FOR_DESKEW if is_followed else {}),
        **parameters_given(context, ["l2_name", "l2_ip"]),
        **known,
        "replay_file": file_given(context, "file"),
        "replay_loop": given["loop"] == "true",
    }
    try:
        replay["replay_rate"] = float(given["rate"])
    except ValueError:
        raise RuntimeError(f"rate:={given['rate']} is not a number") from None
    companions = ["companion_node"] if is_followed else []
    return [
        # At the end of the recording map and path stay to be looked at.
        Node(
            executable="l2lidar_node",
            name=LaunchConfiguration("name"),
            parameters=[file_given(context, "params_file"), replay],
            on_exit=required(ends_with_success=False),
            **common,
        ),
        *(
            Node(
                executable=name,
                parameters=[file_given(context, "proc_params_file"), {**RECORDED_TIME, **known}],
                on_exit=required(),
                **common,
            )
            for name in companions
        ),
    ]


def generate_launch_description():
    """Return a driver that reads a file, deskew and odometry, and optionally RViz."""
    share = FindPackageShare("l2lidar_node")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "file", description="capture (pcap), or bag of raw packets, to play"
            ),
            DeclareLaunchArgument(
                "rate", default_value="1.0", description="speed, 0 for as fast as possible"
            ),
            DeclareLaunchArgument(
                "loop",
                default_value="false",
                choices=["true", "false"],
                description="whether to start over at the end, without odometry",
            ),
            DeclareLaunchArgument(
                "deskew_odometry",
                default_value="true",
                choices=["true", "false"],
                description="whether to start deskew and odometry",
            ),
            DeclareLaunchArgument(
                "namespace",
                default_value="",
                description="namespace of all nodes and topics, one for each sensor",
            ),
            DeclareLaunchArgument(
                "name", default_value="l2lidar_node", description="name of the driver node"
            ),
            DeclareLaunchArgument(
                "l2_name",
                default_value="",
                description="prefix of the frames, one for each sensor; empty uses params_file",
            ),
            DeclareLaunchArgument(
                "l2_ip",
                default_value="",
                description="address of the L2 in the capture; empty uses params_file",
            ),
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution([share, "config", "l2lidar_node.yaml"]),
                description="parameters of the driver",
            ),
            DeclareLaunchArgument(
                "proc_params_file",
                default_value=PathJoinSubstitution([share, "config", "l2lidar_proc.yaml"]),
                description="parameters of deskew and odometry",
            ),
            DeclareLaunchArgument(
                "calibration_file",
                default_value="",
                description="file of l2lidar calibrate for this unit, for the driver, deskew and "
                "odometry; empty uses params_file and proc_params_file",
            ),
            DeclareLaunchArgument(
                "log_level",
                default_value="info",
                choices=["debug", "info", "warn", "error", "fatal"],
                description="least severe message to print",
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
                launch_arguments={"use_sim_time": "true"}.items(),
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
            OpaqueFunction(function=launch_setup),
        ]
    )
