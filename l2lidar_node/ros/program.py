"""Runs a node as a program: middleware, command line, executor, signals, exit code.

Fast DDS hands messages to subscribers on the same host through 512 kB of shared memory. A cloud
takes 365 kB of it until every subscriber has read it: if one is held up for an instant, the next
cloud and all IMU samples meanwhile find no room and are lost, however deep the queues are.
"""

from __future__ import annotations

import gc
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Final

import rclpy
import yaml
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.exceptions import (
    InvalidParameterTypeException,
    NameValidationException,
    NotInitializedException,
)
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions, install_signal_handlers
from rclpy.utilities import remove_ros_args

from l2lidar_node.programs import end_by_signal, ignore_signals
from l2lidar_node.settings import SettingError

PROFILE: Final = Path(__file__).with_name("fastdds.xml")
_FILES: Final = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
_TRANSPORTS: Final = "FASTDDS_BUILTIN_TRANSPORTS"


def make_room() -> None:
    """Have Fast DDS use :data:`PROFILE`; must come before rclpy is initialized.

    Where a profile or transports are named in the environment, or a file that Fast DDS looks for
    lies in the working directory, those count.
    """
    is_configured = Path("DEFAULT_FASTRTPS_PROFILES.xml").exists()
    if is_configured or any(os.environ.get(name) for name in (*_FILES, _TRANSPORTS)):
        return
    for name in _FILES:  # one is the older versions', Jazzy's among them
        os.environ[name] = str(PROFILE)


USAGE: Final = """usage: {name} [--params-file FILE] [--ros-args ...]

A ROS 2 node. After --ros-args: -p NAME:=VALUE for a parameter, -r OLD:=NEW for a name.
Its parameters: docs/parameters.md; while it runs, `ros2 param describe /{name} NAME`."""


class UsageError(ValueError):
    """The command line is wrong; the message says what and what would be right."""


def wants_help(argv: list[str]) -> bool:
    """Tell whether a command line, starting with the program's name, asks for help."""
    own = argv[1 : argv.index("--ros-args")] if "--ros-args" in argv else argv[1:]
    return "--help" in own or "-h" in own


def start_rclpy(argv: list[str]) -> None:
    """Initialize rclpy with a node's command line, the program's name first.

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
        raise UsageError(f"argument '{unknown[0]}' is not known; put parameters after --ros-args")


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
        raise UsageError(f"parameter file '{path}': not YAML: {reason}") from None
    if not isinstance(content, dict) or not all(_is_node(entry) for entry in content.values()):
        raise UsageError(
            f"parameter file '{path}': expected 'l2lidar_node:' (or '/**:'), below it "
            "'ros__parameters:', below it the parameters"
        )


def _is_node(entry: object) -> bool:
    if not isinstance(entry, dict):
        return False
    return "ros__parameters" in entry or all(_is_node(below) for below in entry.values())


class StartError(RuntimeError):
    """A resource that a node needs is missing; the message says which."""


def run(name: str, make: Callable[[], Node], args: list[str] | None = None) -> int:
    """Create a node, spin it until shutdown, and return the exit code.

    See :func:`run_nodes`.
    """
    return run_nodes(name, lambda: [make()], args)


def run_nodes(name: str, make: Callable[[], list[Node]], args: list[str] | None = None) -> int:
    """Create the nodes of a process, spin them until shutdown, and return the exit code.

    Parameters
    ----------
    name : str
        Of the program, before its messages.
    make : callable
        Makes the nodes. It may raise :class:`SettingError` or :class:`StartError`.
    args : list of str, optional
        Command line, the program's name first; that of the process if left out.

    Returns
    -------
    int
        0 after ``--help`` and after a signal, which until rclpy is there ends the process; the
        largest ``exit_code`` of nodes that have one and ended themselves; 1 for a
        :class:`StartError`; 2 for wrong arguments.
    """
    end_by_signal()
    argv = sys.argv if args is None else args
    if wants_help(argv):
        print(USAGE.format(name=name))
        return 0
    nodes: list[Node] = []
    # What rclpy says of a node that a signal interrupts while it is being made.
    warnings.filterwarnings("ignore", "Failed to fini", RuntimeWarning)
    try:
        start_rclpy(argv)
        # Before there are handlers: made after a signal, it leaves a trace when it goes.
        executor = SingleThreadedExecutor()
        install_signal_handlers()  # from here on a signal shuts rclpy down and does nothing else
        nodes = make()
        for node in nodes:
            executor.add_node(node)
        # Or every full collection walks all that was imported, and takes 20 ms on a slow core.
        gc.freeze()
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (
        SettingError,
        UsageError,
        NameValidationException,
        InvalidParameterTypeException,  # use_sim_time, which every node has
    ) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except StartError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except (RuntimeError, NotInitializedException):
        if rclpy.ok():
            raise
        # A signal came while something was being made or used: rclpy has no better word for it.
    finally:
        # Its handlers stay: a signal that comes again does nothing.
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
        ignore_signals()
    return max((int(getattr(node, "exit_code", 0)) for node in nodes), default=0)
