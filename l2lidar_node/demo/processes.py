"""Starts programs of this package and ends them again, whatever happens."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from itertools import cycle
from pathlib import Path
from types import TracebackType
from typing import Final

from l2lidar_node.programs import held

GRACE_S: Final = 30.0  # for a program that ends; only one that hangs takes so long
_HANDED_OUT: Final = Path("/proc/sys/net/ipv4/ip_local_port_range")
_USUAL_LAST: Final = 60_999
_LAST: Final = 65_535


class ProgramError(RuntimeError):
    """A program ended by itself; the message holds what it said."""


class Program:
    """One running program, started as ``python -m module``.

    Parameters
    ----------
    module : str
    arguments : list of str
    """

    def __init__(self, module: str, arguments: list[str]) -> None:
        self.module = module
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    @property
    def pid(self) -> int:
        """Process number."""
        return self._process.pid

    def check(self) -> None:
        """Raise :class:`ProgramError` if it has ended."""
        code = self._process.poll()
        if code is not None:
            said = self._process.stdout.read().strip() if self._process.stdout else ""
            raise ProgramError(f"{self.module} ended with exit code {code}:\n{said}")

    def stop(self) -> tuple[int, str]:
        """Interrupt it as Ctrl-C does; return its exit code and everything it said."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        try:
            said, _ = self._process.communicate(timeout=GRACE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            said, _ = self._process.communicate()
        return self._process.returncode, said


class Programs:
    """Programs that end together, the last one started first."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._running: list[Program] = []

    def __enter__(self) -> Programs:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop all programs."""
        self._stack.close()

    def start(self, module: str, arguments: list[str]) -> Program:
        """Start a program that is stopped with the others."""
        with held():
            program = Program(module, arguments)
            self._running.append(program)
            self._stack.callback(program.stop)
        return program

    def check(self) -> None:
        """Raise :class:`ProgramError` if any of them has ended."""
        for program in self._running:
            program.check()


def assigned(values: Mapping[str, object]) -> list[str]:
    """Return the arguments that give a node its parameters: ``--ros-args -p NAME:=VALUE ...``."""
    texts = {
        name: str(value).lower() if isinstance(value, bool) else value
        for name, value in values.items()
    }
    return ["--ros-args", *(a for name, text in texts.items() for a in ("-p", f"{name}:={text}"))]


def isolate_ros() -> None:
    """Keep the topics on this machine and apart from other nodes, unless told otherwise."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))


def free_udp_ports(count: int) -> list[int]:
    """Return UDP ports of the loopback interface that nobody uses right now.

    They lie beyond those that the system hands out to whoever asks for any port, as DDS does many
    times at every start: nobody takes them before they are used. No port is returned twice until
    all have been.

    Raises
    ------
    OSError
        If there are not so many.
    """
    found: list[int] = []
    for _ in range(_LAST - _beyond() + 1):
        if len(found) == count:
            break
        port = next(_ports)
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", port))
            found.append(port)
    if len(found) < count:
        raise OSError(f"of {count} UDP ports, {len(found)} are free")
    return found


def _beyond() -> int:
    """Return the first port after those that the system hands out, some before the last one."""
    try:
        last = int(_HANDED_OUT.read_text().split()[1])
    except OSError:
        last = _USUAL_LAST
    return last + 1 if last < _LAST - 1000 else _USUAL_LAST + 1


def _shuffled() -> list[int]:
    ports = list(range(_beyond(), _LAST + 1))
    random.shuffle(ports)
    return ports


_ports = cycle(_shuffled())
