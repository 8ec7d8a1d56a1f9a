"""Starts an example robot with the L2 on its front face, looking ahead."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description():
    """Return robot_state_publisher, driver and RViz."""
    share = Path(get_package_share_directory("l2lidar_node"))
    urdf = share / "urdf" / "examples" / "l2_forward_mount_example.urdf"
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "namespace",
                default_value="",
                description="namespace of all nodes and topics, one for each sensor",
            ),
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
                "rviz_config",
                default_value=str(share / "rviz" / "rvizl2lidar_example.rviz"),
                description="RViz layout",
            ),
            DeclareLaunchArgument(
                "emulator_options",
                default_value="--ready --mount forward",
                description="command line options of the virtual L2, in one string",
            ),
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    {
                        "robot_description": ParameterValue(
                            urdf.read_text(encoding="utf-8"), value_type=str
                        )
                    }
                ],
                output="screen",
            ),
            IncludeLaunchDescription(
                str(share / "launch" / "rviz.launch.py"),
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
            IncludeLaunchDescription(str(share / "launch" / "l2lidar.launch.py")),
        ]
    )
