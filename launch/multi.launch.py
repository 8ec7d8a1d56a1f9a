"""Starts a driver for each sensor that one YAML file names, and deskew and odometry with each.

The file is an ordinary parameter file whose sections are headed with the full names of the
drivers; ``config/multi.yaml`` is an example.
"""

import itertools

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
)
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

from l2lidar_node.ros.launching import file_given
from l2lidar_node.ros.parameter_files import parameters_by_node

EMULATOR_PORT = 6101  # the first virtual L2's; each takes two


def launch_setup(context):
    """Return a group for each sensor."""
    given = context.launch_configurations
    file = file_given(context, "sensors_file")
    sensors = {
        name.rpartition("/")[0].strip("/"): values
        for name, values in parameters_by_node(file).items()
        if name.rpartition("/")[2] == "l2lidar_node" and name.count("/") > 1 and "*" not in name
    }
    if not sensors:
        raise RuntimeError(
            f"sensors_file:={given['sensors_file']} has no driver; expected sections "
            "'/<namespace>/l2lidar_node', below them 'ros__parameters:'"
        )
    follows = given["deskew_odometry"] == "true"
    ports = itertools.count(EMULATOR_PORT)
    groups = []
    for namespace, values in sensors.items():
        name = values.get("l2_name", namespace.replace("/", "_"))
        arguments = {"namespace": namespace, "l2_name": name, "params_file": file}
        if follows:
            arguments |= {"proc_params_file": file, "odom_frame": f"{name}_odom"}
        if given["emulator"] == "true":
            arguments |= {"l2_port": str(next(ports)), "host_port": str(next(ports))}
        started = "deskew_odometry.launch.py" if follows else "l2lidar.launch.py"
        share = FindPackageShare("l2lidar_node")
        include = IncludeLaunchDescription(
            PathJoinSubstitution([share, "launch", started]), launch_arguments=arguments.items()
        )
        groups.append(GroupAction([include]))
    return groups


def generate_launch_description():
    """Return drivers, and optionally deskew and odometry."""
    example = PathJoinSubstitution([FindPackageShare("l2lidar_node"), "config", "multi.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "sensors_file",
                default_value=example,
                description="parameter file with a section '/<namespace>/l2lidar_node' for each "
                "sensor",
            ),
            DeclareLaunchArgument(
                "deskew_odometry",
                default_value="false",
                choices=["true", "false"],
                description="whether to start deskew and odometry with each",
            ),
            DeclareLaunchArgument(
                "emulator",
                default_value="false",
                choices=["true", "false"],
                description="whether to start a virtual L2 for each and listen to it",
            ),
            OpaqueFunction(function=launch_setup),
        ]
    )
