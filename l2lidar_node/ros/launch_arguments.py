"""Declares the launch arguments that more than one launch file has, each once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument

PACKAGE: Final = "l2lidar_node"


class Argument(NamedTuple):
    """One launch argument.

    Attributes
    ----------
    default : str or None
        Value when it is not given; None where it has to be.
    doc : str
        What it does.
    choices : tuple of str
        Permitted values; empty for any.
    is_shared_file : bool
        Whether ``default`` is a path below this package's share folder.
    """

    default: str | None
    doc: str
    choices: tuple[str, ...] = ()
    is_shared_file: bool = False

    def declare(self, name: str) -> DeclareLaunchArgument:
        """Return the declaration of this argument under a name."""
        default = self.default
        if default is not None and self.is_shared_file:
            default = share(default)
        choices = list(self.choices) or None
        return DeclareLaunchArgument(
            name, default_value=default, description=self.doc, choices=choices
        )


BOOL: Final = ("true", "false")
CUTS: Final = ("packets", "turn", "half_turn", "duration")
_AS_IN_FILE: Final = "; empty for what params_file says"

ARGUMENTS: Final[Mapping[str, Argument]] = {
    "namespace": Argument("", "namespace of all nodes and topics, one for each sensor"),
    "name": Argument("l2lidar_node", "name of the driver node"),
    "l2_name": Argument("", f"prefix of the frames, one for each sensor{_AS_IN_FILE}"),
    "params_file": Argument(
        "config/l2lidar_node.yaml", "parameters of the driver", is_shared_file=True
    ),
    "l2_ip": Argument("", f"address of the L2{_AS_IN_FILE}"),
    "l2_port": Argument("", f"UDP port of the L2{_AS_IN_FILE}"),
    "host_ip": Argument("", f"address of this host towards the L2{_AS_IN_FILE}"),
    "host_port": Argument("", f"UDP port of this host{_AS_IN_FILE}"),
    "emulator": Argument("false", "whether to start a virtual L2 and listen to it", BOOL),
    "emulator_options": Argument("", "command line options of the virtual L2, in one string"),
    "respawn": Argument(
        "true", "whether a node that died is started again; else its failure ends the launch", BOOL
    ),
    "log_level": Argument(
        "info", "least severe message to print", ("debug", "info", "warn", "error", "fatal")
    ),
    "proc_params_file": Argument(
        "config/l2lidar_proc.yaml", "parameters of deskew and odometry", is_shared_file=True
    ),
    "rviz": Argument("false", "whether to start RViz", BOOL),
    "rviz_config": Argument("rviz/rvizl2lidar.rviz", "RViz layout", is_shared_file=True),
}
"""Every argument that more than one launch file has."""

EXAMPLE_ARGUMENTS: Final = (
    "namespace",
    "name",
    "params_file",
    "l2_ip",
    "l2_port",
    "host_ip",
    "host_port",
    "emulator",
    "emulator_options",
    "respawn",
    "log_level",
)
"""Arguments of a driver whose frames a URDF names."""
DRIVER_ARGUMENTS: Final = (*EXAMPLE_ARGUMENTS, "l2_name")
RVIZ_ARGUMENTS: Final = ("rviz", "rviz_config")


def share(path: str) -> str:
    """Return where a file of this package is installed."""
    return str(Path(get_package_share_directory(PACKAGE)) / path)


def arguments(*names: str, **defaults: str) -> list[DeclareLaunchArgument]:
    """Return declarations of arguments of the table, some with a default of their own."""
    declared = []
    for name in names:
        described = ARGUMENTS[name]
        if name in defaults:
            described = described._replace(default=defaults[name])
        declared.append(described.declare(name))
    return declared
