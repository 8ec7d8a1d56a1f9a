"""Starts programs of this package and always ends them."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Final

from l2lidar_node.demo.machine import ProcessorTime, processor_time
from l2lidar_node.programs import held

GRACE_S: Final = 30.0  # for a program that ends; only one that hangs takes so long
_HANDED_OUT: Final = Path("/proc/sys/net/ipv4/ip_local_port_range")
_LINES: Final = 2_000  # of a program's output that are kept
_USUAL_LAST: Final = 60_999
_LAST: Final = 65_535
_PORTS_AT_ONCE: Final = 90  # that a process takes for itself
# DDS makes its ports from the domain (DDSI-RTPS 9.6.1.1). Those of domains above 101 are in the
# range that Linux hands out to programs asking for any port.
_LAST_DOMAIN: Final = 100
_DDS_BASE: Final = 7410
_DDS_DOMAIN_STEP: Final = 250


class ProgramError(RuntimeError):
    """A program ended by itself; the message has its output."""


class Program:
    """One running program, started as ``python -m module``.

    Parameters
    ----------
    module : str
    arguments : list of str
    folder : Path, optional
        Where it runs, and where Python looks for the module first: another checkout's program.

    Attributes
    ----------
    lines : deque of str
        The last ones that it wrote.
    """

    def __init__(self, module: str, arguments: list[str], folder: Path | None = None) -> None:
        self.module = module
        self._ended: tuple[int, str] | None = None
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            cwd=folder,
        )
        # A pipe without a reader fills up, and the program blocks at its next write.
        self.lines: deque[str] = deque(maxlen=_LINES)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Process number."""
        return self._process.pid

    def check(self) -> None:
        """Raise :class:`ProgramError` if it has ended."""
        code = self._process.poll()
        if code is not None:
            raise ProgramError(f"{self.module} ended with exit code {code}:\n{self._said()}")

    def stop(self) -> tuple[int, str]:
        """Interrupt it as Ctrl-C does; return its exit code and the last lines that it wrote."""
        if self._ended is not None:
            return self._ended
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(timeout=GRACE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._ended = self._process.returncode, self._said()
        return self._ended

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as output:
            self.lines.extend(output)

    def _said(self) -> str:
        """Return the last lines that the program wrote before it ended."""
        self._reader.join(timeout=GRACE_S)  # whom it left behind may hold the pipe open
        return "".join(tuple(self.lines)).strip()


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

    def start(self, module: str, arguments: list[str], folder: Path | None = None) -> Program:
        """Start a program that is stopped with the others; see :class:`Program`."""
        with held():
            program = Program(module, arguments, folder)
            self._running.append(program)
            self._stack.callback(program.stop)
        return program

    def stop(self, program: Program) -> None:
        """Stop one of them now; the others go on."""
        self._running.remove(program)
        program.stop()

    def processor_times(self) -> dict[str, ProcessorTime]:
        """Return the processor time of running programs by module, if the system reports it."""
        times = {item.module: processor_time(item.pid) for item in self._running}
        return {module: time for module, time in times.items() if time is not None}

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
    """Keep the topics on this machine and apart from other nodes by default."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if "ROS_DOMAIN_ID" not in os.environ:
        os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())


def free_ros_domain() -> int:
    """Return a ROS domain in which no node of this machine is.

    No other process is given it by this function until this one ends.

    Raises
    ------
    OSError
        If there is none.
    """
    domains = list(range(1, _LAST_DOMAIN + 1))
    random.shuffle(domains)
    for domain in domains:
        port = _DDS_BASE + _DDS_DOMAIN_STEP * domain
        if _is_free("", port) and _claim(f"domain {domain}"):
            return domain
    raise OSError(f"all ROS domains from 1 to {_LAST_DOMAIN} are in use")


def free_udp_ports(count: int) -> list[int]:
    """Return UDP ports of the loopback interface that are not in use.

    They lie outside the system's range of ephemeral ports, which DDS uses many
    times at every start, and no other process is given them by this function until this one ends:
    nobody takes them before they are used. No port is returned twice until all have been.

    Raises
    ------
    OSError
        If there are not so many.
    """
    if not _ports:
        _ports.extend(_own_ports())
    found: list[int] = []
    for _ in range(len(_ports)):
        if len(found) == count:
            break
        _ports.rotate(-1)
        if _is_free("127.0.0.1", _ports[-1]):
            found.append(_ports[-1])
    if len(found) < count:
        raise OSError(f"of {count} UDP ports, {len(found)} are free")
    return found


def _own_ports() -> list[int]:
    """Return some ports that this process has for itself; all there are if others have them."""
    ports = range(_beyond(), _LAST + 1)
    firsts = list(range(ports.start, _LAST + 2 - _PORTS_AT_ONCE, _PORTS_AT_ONCE))
    random.shuffle(firsts)
    for first in firsts:
        if _claim(f"ports from {first}"):
            ports = range(first, first + _PORTS_AT_ONCE)
            break
    return random.sample(ports, len(ports))


def _is_free(address: str, port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, port))
        except OSError:
            return False
    return True


def _claim(name: str) -> bool:
    """Take a name until this process ends; return whether no other process has it.

    The name is that of a socket in Linux's abstract namespace, which leaves no file behind.
    """
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        claim.bind(f"\0l2lidar {name}")
    except OSError:
        claim.close()
        return False
    _claims.append(claim)
    return True


def _beyond() -> int:
    """Return the first port after those that the system hands out, some before the last one."""
    try:
        last = int(_HANDED_OUT.read_text().split()[1])
    except OSError:
        last = _USUAL_LAST
    return last + 1 if last < _LAST - 1000 else _USUAL_LAST + 1


_claims: list[socket.socket] = []
_ports: deque[int] = deque()
