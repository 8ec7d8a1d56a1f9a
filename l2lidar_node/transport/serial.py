"""Serial line: 4 Mbaud, 8N1, raw; read by its own thread, so that nothing overflows."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import termios
import threading
import time
import tty
from collections import deque
from typing import Final

from l2lidar_node.transport.udp import TransportError
from l2lidar_node.types import NOT_AWAITED, Datagram, HostNs

_READ: Final = 16_384  # a UDP datagram holds it, so a capture can
_BACKLOG: Final = 4_194_304  # 17 s of a unit's data
_REOPEN_S: Final = 0.5
_BAUD: Final = termios.B4000000


class SerialTransport:
    """A serial device that an L2 is connected to.

    What the kernel holds for a serial device is a few kilobytes, 20 ms of data: a thread takes it
    out at once, notes when, and keeps it until :meth:`receive` is called. A device that goes away
    is opened again when it comes back.

    Parameters
    ----------
    path : str
        Such as ``/dev/ttyACM0``.

    Attributes
    ----------
    foreign : int
        Always 0: a serial line has only one sender.
    stranger : str
        Always empty.
    kernel_drops : int
        Reads that were dropped because they were not taken in time.
    send_errors : int
        Frames that could not be sent, for example while a cable is out.
    interruptions : int
        Times the device went away.

    Raises
    ------
    TransportError
        If the device cannot be opened or is not a serial device.
    """

    def __init__(self, path: str) -> None:
        self.foreign = 0
        self.stranger = ""
        self.kernel_drops = 0
        self.send_errors = 0
        self.interruptions = 0
        self._path = path
        self._backlog: deque[Datagram] = deque()
        self._backlog_octets = 0
        self._arrived = threading.Condition()
        self._descriptor = _opened(path)
        self._wake_read, self._wake_write = os.pipe()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._read_on, name="l2lidar-serial", daemon=True)
        self._thread.start()

    def receive(self, timeout_s: float, awaited: HostNs = NOT_AWAITED) -> list[Datagram]:
        """Return what has arrived, in order; empty when nothing did in time."""
        del awaited  # a thread reads continuously
        with self._arrived:
            if not self._backlog:
                self._arrived.wait(timeout_s)
            batch = list(self._backlog)
            self._backlog.clear()
            self._backlog_octets = 0
        return batch

    def send(self, frame: bytes) -> None:
        """Send one frame to the device; a failure is counted, since commands are repeated."""
        with self._arrived:
            try:
                if self._descriptor < 0 or os.write(self._descriptor, frame) < len(frame):
                    self.send_errors += 1
            except OSError:
                self.send_errors += 1

    def close(self) -> None:
        """Close the device; may be called more than once."""
        if self._closing.is_set():
            return
        self._closing.set()
        os.write(self._wake_write, b"\0")
        self._thread.join()
        for descriptor in (self._wake_read, self._wake_write):
            os.close(descriptor)
        self._drop()

    def _read_on(self) -> None:
        while not self._closing.is_set():
            if self._descriptor < 0:
                self._reopen()
                continue
            ready, _, _ = select.select([self._descriptor, self._wake_read], [], [])
            if self._descriptor not in ready:
                continue
            arrival = HostNs(time.time_ns())
            try:
                data = os.read(self._descriptor, _READ)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if data:
                self._keep(Datagram(data, arrival))
            else:
                self.interruptions += 1
                self._drop()

    def _keep(self, datagram: Datagram) -> None:
        with self._arrived:
            while self._backlog and self._backlog_octets + len(datagram.data) > _BACKLOG:
                self._backlog_octets -= len(self._backlog.popleft().data)
                self.kernel_drops += 1
            self._backlog.append(datagram)
            self._backlog_octets += len(datagram.data)
            self._arrived.notify()

    def _drop(self) -> None:
        with self._arrived:
            descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def _reopen(self) -> None:
        if select.select([self._wake_read], [], [], _REOPEN_S)[0]:
            return
        with contextlib.suppress(TransportError):
            descriptor = _opened(self._path)
            with self._arrived:
                self._descriptor = descriptor


def _opened(path: str) -> int:
    """Return a descriptor of a serial device, set up, whatever was in its buffers thrown away."""
    descriptor = -1
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        fcntl.ioctl(descriptor, termios.TIOCEXCL)  # two readers would each get half
        tty.setraw(descriptor)
        attributes = termios.tcgetattr(descriptor)
        attributes[2] &= ~(termios.CSIZE | termios.PARENB | termios.CSTOPB | termios.CRTSCTS)
        attributes[2] |= termios.CS8 | termios.CLOCAL | termios.CREAD
        attributes[4] = attributes[5] = _BAUD
        termios.tcsetattr(descriptor, termios.TCSANOW, attributes)
        termios.tcflush(descriptor, termios.TCIFLUSH)
    except (OSError, termios.error) as error:
        if descriptor >= 0:
            os.close(descriptor)
        number = error.args[0] if error.args else 0
        raise TransportError(number, _advice(path, number, str(error.args[-1]))) from None
    return descriptor


def _advice(path: str, number: int, reason: str) -> str:
    start = f"cannot open the serial device {path}: "
    if number == errno.ENOENT:
        return f"{start}it does not exist; check the cable and the name (ls /dev)"
    if number in (errno.EACCES, errno.EPERM):
        return f"{start}no permission; add this user to the group that owns it (dialout)"
    if number == errno.ENOTTY:
        return f"{start}it is not a serial device"
    if number == errno.EBUSY:
        return f"{start}another program uses it"
    return start + reason
