"""Starts RViz with one of the layouts of this package, beside a driver that runs elsewhere."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from l2lidar_node.ros.launching import RVIZ_REMAPPINGS, file_given


def launch_setup(context):
    """Return RViz."""
    arguments = ["-d", file_given(context, "rviz_config")]
    fixed_frame = context.launch_configurations["fixed_frame"]
    if fixed_frame:
        arguments += ["-f", fixed_frame]
    return [
        Node(
            package="rviz2",
            executable="rviz2",
            name="rviz2",
            namespace=LaunchConfiguration("namespace"),
            arguments=arguments,
            parameters=[{"use_sim_time": context.launch_configurations["use_sim_time"] == "true"}],
            remappings=RVIZ_REMAPPINGS,
            output="screen",
        )
    ]


def generate_launch_description():
    """Return RViz."""
    layouts = PathJoinSubstitution([FindPackageShare("l2lidar_node"), "rviz"])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "namespace",
                default_value="",
                description="namespace of all nodes and topics, one for each sensor",
            ),
            DeclareLaunchArgument(
                "rviz_config",
                default_value=PathJoinSubstitution([layouts, "rvizl2lidar.rviz"]),
                description="RViz layout",
            ),
            DeclareLaunchArgument(
                "fixed_frame",
                default_value="",
                description="RViz's fixed frame; empty uses that of the layout",
            ),
            DeclareLaunchArgument(
                "use_sim_time",
                default_value="false",
                choices=["true", "false"],
                description="whether time comes from /clock, as in a replay",
            ),
            OpaqueFunction(function=launch_setup),
        ]
    )
