"""Reads a node's command line before rclpy does: mistakes get a sentence instead of a trace."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import rclpy
import yaml
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from l2lidar_node.ros.middleware import make_room

USAGE: Final = """usage: {name} [--params-file FILE] [--ros-args ...]

A ROS 2 node. After --ros-args: -p NAME:=VALUE for a parameter, -r OLD:=NEW for a name.
Its parameters are in the README and, while it runs, in `ros2 param describe /{name} NAME`."""


class UsageError(ValueError):
    """The command line is wrong; the message says what and what would be right."""


def wants_help(argv: list[str]) -> bool:
    """Tell whether a command line, the program's name first, asks what it may be."""
    own = argv[1 : argv.index("--ros-args")] if "--ros-args" in argv else argv[1:]
    return "--help" in own or "-h" in own


def start_rclpy(argv: list[str]) -> None:
    """Initialise rclpy with a node's command line, the program's name first.

    Signals are left as they are.

    Raises
    ------
    UsageError
        If anything on the command line is wrong.
    """
    arguments = ros_arguments(argv)
    make_room()
    try:
        unknown = remove_ros_args(arguments)[1:]
        if not unknown:
            rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except UnknownROSArgsError as error:
        raise UsageError(f"ROS arguments not known: {error}") from None
    except RCLError as error:  # its own words are all there is to say
        raise UsageError(str(error).partition(", at ")[0]) from None
    if unknown:
        raise UsageError(f"argument '{unknown[0]}' is not known; parameters follow --ros-args")


def ros_arguments(argv: list[str]) -> list[str]:
    """Return the arguments for rclpy.

    ``--params-file FILE`` is also taken without ``--ros-args`` before it.

    Raises
    ------
    UsageError
        If a parameter file is missing or is not the YAML that ROS expects.
    """
    arguments = list(argv)
    if "--ros-args" not in arguments and "--params-file" in arguments:
        arguments.insert(arguments.index("--params-file"), "--ros-args")
    for at, argument in enumerate(arguments):
        if argument == "--params-file":
            if at + 1 == len(arguments):
                raise UsageError("--params-file: expected the name of a YAML file after it")
            _check_parameter_file(Path(arguments[at + 1]))
    return arguments


def _check_parameter_file(path: Path) -> None:
    try:
        content = yaml.safe_load(path.read_text())
    except OSError as error:
        raise UsageError(f"parameter file '{path}': {error.strerror}") from None
    except (yaml.YAMLError, ValueError, IndexError, RecursionError) as error:
        # The last three are PyYAML's on dates that are none, `!!int` alone, endless brackets.
        reason = " ".join(str(error).split())
        raise UsageError(f"parameter file '{path}': is not YAML: {reason}") from None
    if not isinstance(content, dict) or not all(_is_node(entry) for entry in content.values()):
        raise UsageError(
            f"parameter file '{path}': expected 'l2lidar_node:' (or '/**:'), below it "
            "'ros__parameters:', below it the parameters"
        )


def _is_node(entry: object) -> bool:
    if not isinstance(entry, dict):
        return False
    return "ros__parameters" in entry or all(_is_node(below) for below in entry.values())
