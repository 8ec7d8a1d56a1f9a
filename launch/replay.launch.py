"""Plays a capture of raw packets through the driver, deskew and odometry."""

from pathlib import Path

from launch import LaunchDescription

from l2lidar_node.ros.bringup import driver, for_deskew, rviz, start
from l2lidar_node.ros.launch_arguments import BOOL, RVIZ_ARGUMENTS, Argument, arguments
from l2lidar_proc.ros.bringup import deskew, odometry

# The driver gives the recording's time on /clock.
RECORDED_TIME = {"use_sim_time": True}


def _needs(given):
    is_followed, is_loop = (given[name] == "true" for name in ("deskew_odometry", "loop"))
    if is_followed and is_loop:
        raise ValueError(
            "loop:=true takes the sensor back to where the recording began, "
            "which no odometry can follow; add deskew_odometry:=false"
        )
    try:
        rate = float(given["rate"])
    except ValueError:
        raise ValueError(f"rate:={given['rate']} is not a number") from None
    if not Path(given["file"]).expanduser().is_file():
        raise ValueError(f"file:={given['file']}: there is no such file")
    return {
        **(for_deskew() if is_followed else {}),
        "replay_file": given["file"],
        "replay_rate": rate,
        "replay_loop": is_loop,
    }


def generate_launch_description() -> LaunchDescription:
    """Return a driver that reads a file, deskew and odometry, and RViz where asked for."""
    return LaunchDescription(
        [
            Argument(None, "capture (pcap) to play").declare("file"),
            Argument("1.0", "speed, 0 for as fast as possible").declare("rate"),
            Argument("false", "whether to begin again at the end, without odometry", BOOL).declare(
                "loop"
            ),
            Argument("true", "whether to start deskew and odometry", BOOL).declare(
                "deskew_odometry"
            ),
            *arguments("namespace", "name", "l2_name", "l2_ip", "log_level"),
            *arguments("params_file", "proc_params_file"),
            *arguments(*RVIZ_ARGUMENTS, rviz_config="rviz/slam.rviz"),
            start(
                driver(_needs),
                deskew("deskew_odometry", RECORDED_TIME),
                odometry("deskew_odometry", RECORDED_TIME),
                rviz(RECORDED_TIME),
            ),
        ]
    )
