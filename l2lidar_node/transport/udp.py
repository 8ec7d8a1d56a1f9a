"""UDP socket: datagrams of one sender with the kernel's arrival times, and frames to it."""

from __future__ import annotations

import ctypes
import errno
import ipaddress
import socket
import struct
import time
from typing import Final

from l2lidar_node.config import NetworkConfig
from l2lidar_node.transport.recvmmsg import MOST, SO_TIMESTAMPNS, DatagramReader
from l2lidar_node.types import NOT_AWAITED, Datagram, HostNs

# Not in Python's socket module; from Linux's asm-generic/socket.h.
_SO_ATTACH_FILTER: Final = 26
_SO_DETACH_FILTER: Final = 27
_SO_MEMINFO: Final = 55
_TIMEVAL = struct.Struct("@ll")
_MEMINFO = struct.Struct("@9I")  # the last is what was dropped, see linux/sock_diag.h
_JITTER_NS: Final = 250_000  # of arrivals: what is due when it looks is not to be missed
_BATCH: Final = 256  # datagrams read before the caller gets a turn

FLOOD_HZ: Final = 1000
"""Foreign datagrams a second from which on the kernel refuses them.

An L2 sends 470 a second, so one whose address is not ``l2_ip`` is still counted one by one.
"""
_FLOOD_NS: Final = 1_000_000_000

# Classic BPF (linux/filter.h): code, jump if true, jump if false, operand.
_BPF_INSTRUCTION = struct.Struct("@HBBI")
_BPF_PROGRAM = struct.Struct("@HP")
_BPF_LOAD: Final = 0x20  # LD | W | ABS
_BPF_EQUAL: Final = 0x15  # JMP | JEQ | K
_BPF_RETURN: Final = 0x06  # RET | K
_IP_SOURCE: Final = 0xFFF0_0000 + 12  # SKF_NET_OFF, then the source address of an IPv4 header
_WHOLE: Final = 0xFFFF_FFFF


class TransportError(OSError):
    """The network cannot be used as configured; the message says what to do."""


class UdpTransport:
    """A UDP socket that receives from one device.

    The source address counts, not the port: that of a unit may differ from ``l2_port``. Datagrams
    of other senders are read and counted. While there are more than :data:`FLOOD_HZ` of them the
    kernel refuses them with a packet filter, before they take room in the receive buffer.

    Parameters
    ----------
    config : NetworkConfig

    Attributes
    ----------
    stranger : str
        Address of the last other sender that was read; empty before the first.
    send_errors : int
        Frames that could not be sent, for example while a cable is out.

    Raises
    ------
    TransportError
        If the address cannot be listened on.
    """

    def __init__(self, config: NetworkConfig) -> None:
        self.stranger = ""
        self.send_errors = 0
        self._foreign = 0
        self._kernel_drops = 0
        self._dropped = 0  # as the kernel counts: buffer full, or refused by the filter
        self._filters = False
        self._window_since = 0  # [ns] strangers are counted over a second
        self._window_foreign = 0  # what there were when it began
        self._device = config.l2_ip
        self._peer = (config.l2_ip, config.l2_port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, config.receive_buffer_bytes)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        try:
            self._socket.bind((config.host_ip, config.host_port))
        except OSError as error:
            self._socket.close()
            raise TransportError(error.errno, _bind_advice(config, error)) from None
        self._reader = DatagramReader(self._socket, config.l2_ip)
        self._timeout_s = -1.0
        self._interval_ns = config.receive_interval_ms * 1_000_000
        self._looked = 0  # [ns]
        self._is_behind = False  # more waited than one batch holds

    @property
    def port(self) -> int:
        """The port that is listened on."""
        return int(self._socket.getsockname()[1])

    @property
    def foreign(self) -> int:
        """Datagrams of other senders, dropped."""
        self._count_drops()
        return self._foreign

    @property
    def kernel_drops(self) -> int:
        """Datagrams the kernel dropped because the receive buffer was full.

        While it refuses strangers its counter does not tell the two apart: all are foreign then.
        """
        self._count_drops()
        return self._kernel_drops

    @property
    def receive_buffer_bytes(self) -> int:
        """The receive buffer the kernel granted [B]; it doubles what it grants for its own use."""
        return self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2

    def receive(self, timeout_s: float, awaited: HostNs = NOT_AWAITED) -> list[Datagram]:
        """Return what has arrived from the device, in order; empty when nothing did in time.

        The kernel has noted when each came: reading them some at a time saves most of the wake-ups
        and costs no accuracy. It looks when something is ``awaited``, at the latest after the
        timeout; an interval after the last look if that has passed already.
        """
        if self._interval_ns and not self._is_behind:
            now = time.time_ns()
            until = awaited if awaited > now else self._looked + self._interval_ns
            pause = until + _JITTER_NS - now
            if pause > 0:
                time.sleep(min(pause * 1e-9, timeout_s))
        if timeout_s != self._timeout_s:
            self._set_timeout(timeout_s)
        reader = self._reader
        taken = count = reader.read()
        while taken == MOST and count < _BATCH:
            taken = reader.read(wait=False)
            count += taken
        self._is_behind = count >= _BATCH
        batch, reader.datagrams = reader.datagrams, []
        if reader.strangers:
            self._refuse(reader.strangers)
            reader.strangers = []
        if self._filters:
            self._watch_flood()
        self._looked = time.time_ns()
        return batch

    def send(self, frame: bytes) -> None:
        """Send one frame to the device; a failure is counted, since commands are repeated."""
        try:
            self._socket.sendto(frame, self._peer)
        except OSError:
            self.send_errors += 1

    def close(self) -> None:
        """Close the socket; what the kernel dropped until then stays known."""
        self._count_drops()
        self._socket.close()

    def _set_timeout(self, timeout_s: float) -> None:
        # In the kernel: Python's own timeout would poll before every read.
        seconds, microseconds = divmod(max(round(timeout_s * 1e6), 1), 1_000_000)
        value = _TIMEVAL.pack(seconds, microseconds)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
        self._timeout_s = timeout_s

    def _refuse(self, strangers: list[bytes]) -> None:
        """Count datagrams of other senders; have the kernel refuse them where there are many."""
        self.stranger = socket.inet_ntoa(strangers[-1])
        self._foreign += len(strangers)
        now = time.monotonic_ns()
        if now - self._window_since > _FLOOD_NS:
            self._window_since, self._window_foreign = now, self._foreign
        if not self._filters and self._foreign - self._window_foreign >= FLOOD_HZ:
            self._count_drops()
            self._filters = _attach_filter(self._socket, self._device)
            self._window_since, self._window_foreign = now, self._foreign

    def _watch_flood(self) -> None:
        """Read strangers again when they have become few."""
        now = time.monotonic_ns()
        if now - self._window_since < _FLOOD_NS:
            return
        if self.foreign - self._window_foreign < FLOOD_HZ // 2:
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
            self._filters = False
        self._window_since, self._window_foreign = now, self._foreign

    def _count_drops(self) -> None:
        try:
            info = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
            dropped = _MEMINFO.unpack(info)[-1]
        except (OSError, struct.error):  # closed, or a kernel that does not tell
            return
        more = (dropped - self._dropped) % (1 << 32)
        self._dropped = dropped
        if self._filters:
            self._foreign += more
        else:
            self._kernel_drops += more


def _attach_filter(link: socket.socket, address: str) -> bool:
    """Have the kernel refuse all senders but one; return whether it does."""
    program = b"".join(
        _BPF_INSTRUCTION.pack(*instruction)
        for instruction in (
            (_BPF_LOAD, 0, 0, _IP_SOURCE),
            (_BPF_EQUAL, 0, 1, int(ipaddress.IPv4Address(address))),
            (_BPF_RETURN, 0, 0, _WHOLE),
            (_BPF_RETURN, 0, 0, 0),
        )
    )
    memory = ctypes.create_string_buffer(program)
    count = len(program) // _BPF_INSTRUCTION.size
    try:
        value = _BPF_PROGRAM.pack(count, ctypes.addressof(memory))
        link.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, value)
    except OSError:
        return False
    return True


def _bind_advice(config: NetworkConfig, error: OSError) -> str:
    address = f"{config.host_ip}:{config.host_port}"
    if error.errno == errno.EADDRNOTAVAIL:
        return (
            f"cannot listen on {address}: host_ip '{config.host_ip}' is not an address of this "
            "machine; give a network interface this address, or set host_ip to one it has "
            "(0.0.0.0 for all)"
        )
    if error.errno == errno.EADDRINUSE:
        return (
            f"cannot listen on {address}: host_port {config.host_port} is in use; end the other "
            "program (another driver?) or set host_port to a free port that the L2 sends to"
        )
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"cannot listen on {address}: no permission; set host_port to 1024 or above"
    return f"cannot listen on {address}: {error.strerror}"
