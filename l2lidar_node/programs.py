"""Entry points. SIGINT and SIGTERM never print a traceback.

Importing what a program needs takes a second, and Python's own handler answers Ctrl-C with a trace
wherever it finds it. So this module imports nothing that takes time, and stands before all else:
entry points lead to it, and the packages begin with it for ``python -m``.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from time import monotonic
from types import FrameType

INTERRUPTED = 130  # exit code after SIGINT, as shells have it
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_SAME_WISH_S = 1.0  # Ctrl-C under `ros2 launch` comes twice, from the terminal and from launch


class _Interruption:
    """Handler that raises KeyboardInterrupt, once for signals in quick succession.

    So what a program does when it is interrupted is not interrupted in its turn.
    """

    def __init__(self) -> None:
        self.number = 0
        self.is_held = False
        self.is_due = False
        self._last = -_SAME_WISH_S

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, or note that it is due."""
        del frame
        before, self._last = self._last, monotonic()
        if self._last - before < _SAME_WISH_S:
            return
        self.number = number
        if self.is_held:
            self.is_due = True
        else:
            raise KeyboardInterrupt


_interruption = _Interruption()


def begin() -> None:
    """Take Python's answer to SIGINT away if ``python -m`` is about to run a module of ours."""
    if sys.argv[:1] == ["-m"]:  # that is what it says until the module is found
        end_by_signal()


def end_by_signal() -> None:
    """Have SIGINT end the process at once as SIGTERM does: status 130 and 143 in a shell.

    SIGINT keeps a handler that is not Python's own, and stays ignored where it is.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)  # see held


def ignore_signals() -> None:
    """Have SIGINT and SIGTERM do nothing: the program is at its end."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def interruptible(main: Callable[[], int | None]) -> int:
    """Run a function that KeyboardInterrupt ends; SIGINT and SIGTERM raise it.

    Returns
    -------
    int
        What ``main`` returns or leaves with; 130 after SIGINT and 143 after SIGTERM if that ended
        it.
    """
    try:
        try:
            for number in _SIGNALS:
                if signal.getsignal(number) is not signal.SIG_IGN:
                    signal.signal(number, _interruption)
            code = main() or 0
        except SystemExit as end:
            if isinstance(end.code, str):
                raise
            code = end.code or 0
        finally:
            ignore_signals()
    except KeyboardInterrupt:
        code = INTERRUPTED
    return 128 + _interruption.number if code == INTERRUPTED and _interruption.number else code


@contextmanager
def held() -> Iterator[None]:
    """Have SIGINT and SIGTERM wait: while a process is started, or where none may be raised.

    In a new process they wait until it begins with :func:`end_by_signal` or ignores them. So it is
    either known to this one or was never started, and Python itself begins undisturbed. rclpy
    turns an interrupt that is raised while it converts a message into a RuntimeError.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    _interruption.is_held = True  # a thread that does not block them may get them
    try:
        yield
    finally:
        _interruption.is_held = False
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if _interruption.is_due:
            _interruption.is_due = False
            raise KeyboardInterrupt


def run(module: str) -> int:
    """Import the module of a node and run its ``main``."""
    end_by_signal()
    return int(import_module(module).main())


def run_interruptible(module: str) -> int:
    """Import the module of another program and run its ``main``; see :func:`interruptible`."""
    end_by_signal()
    return interruptible(import_module(module).main)


def l2lidar_node() -> int:
    """Run the driver node."""
    return run("l2lidar_node.ros.driver_node")


def l2lidar_emulator() -> int:
    """Run the virtual L2."""
    return run_interruptible("l2lidar_node.emulator.cli")


def l2lidar() -> int:
    """Run the command line."""
    return run_interruptible("l2lidar_node.cli.main")
