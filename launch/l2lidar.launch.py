"""Starts the driver, and with ``emulator:=true`` a virtual L2 for it to listen to."""

import shlex

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, LogInfo, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare

from l2lidar_node.ros.launching import (
    DRIVER_REMAPPINGS,
    RESPAWN_DELAY_S,
    file_given,
    parameters_given,
    required,
)

# Arguments that are parameters of the driver.
TEXT = (
    "l2_name", "l2_ip", "host_ip", "serial_port", "sweep_cut", "point_layout", "qos_reliability",
    "record_file", "calibration_file",
)  # fmt: skip
TYPED = ("l2_port", "host_port", "imu_adjust", "enable_IMU_publishing")
LOOPBACK = {"l2_ip": "127.0.0.1", "l2_port": 6101, "host_ip": "127.0.0.1", "host_port": 6201}


def launch_setup(context):
    """Return the driver and its virtual L2."""
    given = context.launch_configurations
    files = [file_given(context, "params_file")]
    if given["override_params_file"]:
        files.append(file_given(context, "override_params_file"))
    parameters = parameters_given(context, TEXT, TYPED)
    emulator = []
    if given["emulator"] == "true":
        parameters = {**LOOPBACK, **parameters, "l2_ip": "127.0.0.1", "host_ip": "127.0.0.1"}
        emulator = virtual_l2(given["emulator_options"], parameters)
    is_respawned = given["respawn"] == "true"
    return [
        *emulator,
        Node(
            package="l2lidar_node",
            executable="l2lidar_node",
            name=LaunchConfiguration("name"),
            namespace=LaunchConfiguration("namespace"),
            parameters=[*files, *([parameters] if parameters else [])],
            remappings=DRIVER_REMAPPINGS,
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            output="screen",
            respawn=is_respawned,
            respawn_delay=RESPAWN_DELAY_S,
            on_exit=required(is_respawned),
        ),
    ]


def virtual_l2(options, parameters):
    """Return the emulator, and a line about the time it takes to spin up."""
    words = shlex.split(options)
    actions = [
        ExecuteProcess(
            cmd=[
                ExecutableInPackage("l2lidar_emulator", "l2lidar_node"),
                *("--lidar-port", str(parameters["l2_port"])),
                *("--host-port", str(parameters["host_port"])),
                *words,
            ],
            name="l2lidar_emulator",
            output="screen",
            on_exit=required(),
        )
    ]
    if "--ready" not in words:
        text = "the virtual L2 spins up first: points arrive after 25 s times --boot-scale"
        actions.insert(0, LogInfo(msg=text))
    return actions


def generate_launch_description():
    """Return the driver, or with ``emulator:=true`` the driver and a virtual L2."""
    share = FindPackageShare("l2lidar_node")
    from_file = "empty uses params_file"
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "namespace",
                default_value="",
                description="namespace of all nodes and topics, one for each sensor",
            ),
            DeclareLaunchArgument(
                "name", default_value="l2lidar_node", description="name of the driver node"
            ),
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution([share, "config", "l2lidar_node.yaml"]),
                description="parameters of the driver",
            ),
            DeclareLaunchArgument(
                "override_params_file",
                default_value="",
                description="driver parameters that override params_file",
            ),
            DeclareLaunchArgument(
                "l2_name",
                default_value="",
                description=f"prefix of the frames, one for each sensor; {from_file}",
            ),
            DeclareLaunchArgument(
                "l2_ip", default_value="", description=f"address of the L2; {from_file}"
            ),
            DeclareLaunchArgument(
                "l2_port", default_value="", description=f"UDP port of the L2; {from_file}"
            ),
            DeclareLaunchArgument(
                "host_ip",
                default_value="",
                description=f"address of this host towards the L2; {from_file}",
            ),
            DeclareLaunchArgument(
                "host_port", default_value="", description=f"UDP port of this host; {from_file}"
            ),
            DeclareLaunchArgument(
                "serial_port",
                default_value="",
                description=f"serial device of the L2 instead of the network; {from_file}",
            ),
            DeclareLaunchArgument(
                "imu_adjust",
                default_value="",
                choices=["", "true", "false"],
                description=f"whether to level the points with the onboard IMU; {from_file}",
            ),
            DeclareLaunchArgument(
                "enable_IMU_publishing",
                default_value="",
                choices=["", "true", "false"],
                description=f"whether to publish IMU samples; {from_file}",
            ),
            DeclareLaunchArgument(
                "sweep_cut",
                default_value="",
                choices=["", "packets", "turn", "half_turn", "duration"],
                description=f"where a cloud ends; {from_file}",
            ),
            DeclareLaunchArgument(
                "point_layout", default_value="", description=f"fields of the clouds; {from_file}"
            ),
            DeclareLaunchArgument(
                "qos_reliability",
                default_value="",
                choices=["", "best_effort", "reliable"],
                description=f"reliability of clouds and IMU samples; {from_file}",
            ),
            DeclareLaunchArgument(
                "record_file",
                default_value="",
                description=f"capture of the raw packets to write; {from_file}",
            ),
            DeclareLaunchArgument(
                "calibration_file",
                default_value="",
                description=f"file of l2lidar calibrate for this unit; {from_file}",
            ),
            DeclareLaunchArgument(
                "emulator",
                default_value="false",
                choices=["true", "false"],
                description="whether to start a virtual L2 and listen to it",
            ),
            DeclareLaunchArgument(
                "emulator_options",
                default_value="--ready",
                description="command line options of the virtual L2, in one string; with "
                "--boot-scale 1 instead of --ready it spins up, and points arrive after 25 s",
            ),
            DeclareLaunchArgument(
                "respawn",
                default_value="true",
                choices=["true", "false"],
                description="whether to restart a node that died; if not, the launch ends",
            ),
            DeclareLaunchArgument(
                "log_level",
                default_value="info",
                choices=["debug", "info", "warn", "error", "fatal"],
                description="least severe message to print",
            ),
            OpaqueFunction(function=launch_setup),
        ]
    )
