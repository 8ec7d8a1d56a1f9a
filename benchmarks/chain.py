"""Starts the whole chain: a virtual L2, the driver, and deskew and odometry in one process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from l2lidar_node.demo.processes import Program, Programs, assigned, free_udp_ports

EMULATOR: Final = "l2lidar_node.emulator"
DRIVER: Final = "l2lidar_node.ros.driver_node"
DESKEW: Final = "l2lidar_proc.ros.deskew_node"
ODOMETRY: Final = "l2lidar_proc.ros.odometry_node"
COMPANION: Final = "l2lidar_proc.ros.companion_node"  # both in one process, as launched
SLAM: Final = "l2lidar_proc.ros.slam_node"


def start(
    programs: Programs,
    unit: Sequence[str],
    values: Mapping[str, object] | None = None,
    nodes: Sequence[str] = (DRIVER, COMPANION),
    base_frame: str | None = None,
    data_dir: str | None = None,
    folder: Path | None = None,
) -> dict[str, Program]:
    """Start the nodes that there are and then a unit; return them by name.

    Parameters
    ----------
    programs : Programs
    unit : sequence of str
        Options of the virtual L2.
    values : mapping, optional
        Parameters of the driver beside addresses and IMU.
    nodes : sequence of str
        Modules.
    base_frame : str, optional
        Of the odometry in the companion, for a sensor on a robot.
    data_dir : str, optional
        Where slam_node saves its map, if it is among the modules.
    folder : Path, optional
        Another checkout, whose nodes are to run; the unit is always this one's.
    """
    host_port, lidar_port = free_udp_ports(2)
    parameters = {
        "l2_ip": "127.0.0.1", "l2_port": lidar_port, "host_ip": "127.0.0.1",
        "host_port": host_port, "enable_IMU_publishing": "true", "imu_adjust": "false",
        **(values or {}),
    }  # fmt: skip
    arguments = {DRIVER: assigned(parameters)}
    if base_frame is not None:
        arguments[COMPANION] = assigned({"odometry_node:base_frame": base_frame})
    if data_dir is not None:
        arguments[SLAM] = assigned({"data_dir": data_dir})
    started = {
        module.rpartition(".")[2]: programs.start(module, arguments.get(module, []), folder)
        for module in nodes
        if find_spec(module)
    }
    ports = ["--host-port", str(host_port), "--lidar-port", str(lidar_port)]
    return {**started, "emulator": programs.start(EMULATOR, [*ports, *unit])}
