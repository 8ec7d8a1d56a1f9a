"""Runs a node as a program: command line, spinning, signals, messages and exit code."""

from __future__ import annotations

import gc
import sys
import warnings
from collections.abc import Callable

import rclpy
from rclpy.exceptions import (
    InvalidParameterTypeException,
    NameValidationException,
    NotInitializedException,
)
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import install_signal_handlers

from l2lidar_node.programs import end_by_signal, ignore_signals
from l2lidar_node.ros.arguments import USAGE, UsageError, start_rclpy, wants_help
from l2lidar_node.settings import SettingError


class StartError(RuntimeError):
    """What a node needs is not to be had, or no longer; the message says what."""


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
        0 after ``--help`` and after a signal, which until rclpy is there ends the process; the
        node's ``exit_code`` where it has one and ended itself; 1 for a :class:`StartError`; 2 for
        wrong arguments.
    """
    end_by_signal()
    argv = sys.argv if args is None else args
    if wants_help(argv):
        print(USAGE.format(name=name))
        return 0
    node = None
    # What rclpy says of a node that a signal interrupts while it is being made.
    warnings.filterwarnings("ignore", "Failed to fini", RuntimeWarning)
    try:
        start_rclpy(argv)
        # Before there are handlers: made after a signal, it leaves a trace when it goes.
        executor = SingleThreadedExecutor()
        install_signal_handlers()  # from here on a signal shuts rclpy down and does nothing else
        node = make()
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
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        ignore_signals()
    return int(getattr(node, "exit_code", 0))
