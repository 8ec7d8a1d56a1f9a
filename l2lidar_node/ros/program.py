"""Runs a node as a program: command line, spinning, signals, messages and exit code."""

from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Callable

import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.exceptions import NameValidationException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from l2lidar_node.ros.arguments import UsageError, start_rclpy
from l2lidar_node.settings import SettingError


class StartError(RuntimeError):
    """What a node needs is not to be had; the message says what to do."""


def run(name: str, make: Callable[[], Node], args: list[str] | None = None) -> int:
    """Make a node, spin it until it is told to end, and return the exit code.

    Parameters
    ----------
    name : str
        Of the program, before its messages.
    make : callable
        Makes the node. It may raise :class:`SettingError` or :class:`StartError`.
    args : list of str, optional
        Command line, the program's name first; that of the process if left out.

    Returns
    -------
    int
        0 after a signal; the node's ``exit_code`` where it has one and ended itself; 1 for a
        :class:`StartError`; 2 for wrong arguments.
    """
    node = None
    try:
        start_rclpy(sys.argv if args is None else args)
        # Before the node: made after a signal, rclpy's executor leaves a trace when it goes.
        executor = SingleThreadedExecutor()
        node = make()
        executor.add_node(node)
        # Or every full collection walks all that was imported, and takes 20 ms on a slow core.
        gc.freeze()
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (SettingError, UsageError, NameValidationException) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except StartError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except RCLError:
        if rclpy.ok():
            raise
        # A signal came while something was being made: rclpy has no better word for it.
    finally:
        # Ctrl-C under `ros2 launch` comes twice, from the terminal and from launch.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return int(getattr(node, "exit_code", 0))
