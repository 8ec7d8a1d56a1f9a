"""Plays a capture of raw packets through the driver, deskew and odometry."""

from launch import LaunchDescription
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration

from l2lidar_node.ros.bringup import companion, driver, for_deskew, rviz
from l2lidar_node.ros.launch_arguments import BOOL, RVIZ_ARGUMENTS, Argument, arguments

# The driver gives the recording's time on /clock.
RECORDED_TIME = {"use_sim_time": True}


def _needs(given):
    values = for_deskew() if given["deskew_odometry"] == "true" else {}
    return {
        **values,
        "replay_file": given["file"],
        "replay_rate": float(given["rate"]),
        "replay_loop": given["loop"] == "true",
    }


def generate_launch_description() -> LaunchDescription:
    """Return a driver that reads a file, deskew and odometry, and RViz where asked for."""
    wanted = IfCondition(LaunchConfiguration("deskew_odometry"))
    return LaunchDescription(
        [
            Argument(None, "capture (pcap) to play").declare("file"),
            Argument("1.0", "speed, 0 for as fast as possible").declare("rate"),
            Argument("false", "whether to begin again at the end", BOOL).declare("loop"),
            Argument("true", "whether to start deskew and odometry", BOOL).declare(
                "deskew_odometry"
            ),
            *arguments("namespace", "name", "l2_name", "l2_ip", "log_level"),
            *arguments("params_file", "proc_params_file"),
            *arguments(*RVIZ_ARGUMENTS, rviz_config="rviz/slam.rviz"),
            driver(_needs),
            companion("deskew_node", wanted, RECORDED_TIME),
            companion("odometry_node", wanted, RECORDED_TIME),
            rviz(RECORDED_TIME),
        ]
    )
