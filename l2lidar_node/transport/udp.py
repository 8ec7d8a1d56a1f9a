"""The socket: datagrams of one sender with the kernel's arrival times, and frames to it."""

from __future__ import annotations

import errno
import socket
import struct
import time
from typing import Final

from l2lidar_node.config import NetworkConfig
from l2lidar_node.types import Datagram, HostNs

# Not in Python's socket module; from Linux's asm-generic/socket.h.
_SO_TIMESTAMPNS: Final = 35
_SO_RXQ_OVFL: Final = 40
_TIMESPEC = struct.Struct("@ll")
_TIMEVAL = struct.Struct("@ll")
_COUNTER = struct.Struct("@I")
_ANCILLARY_SIZE: Final = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_COUNTER.size)
_MAX_DATAGRAM: Final = 65_536
_FRESH_NS: Final = 300_000
_BATCH: Final = 256  # datagrams read before the caller gets a turn


class TransportError(OSError):
    """The network cannot be used as asked; the message says what to do."""


class UdpTransport:
    """A UDP socket that hears one device.

    Parameters
    ----------
    config : NetworkConfig

    Attributes
    ----------
    foreign : int
        Datagrams of other senders, dropped.
    kernel_drops : int
        Datagrams the kernel dropped because the receive buffer was full.
    send_errors : int
        Frames that could not be sent, for example while a cable is out.

    Raises
    ------
    TransportError
        If the address cannot be listened on.
    """

    def __init__(self, config: NetworkConfig) -> None:
        self.foreign = 0
        self.kernel_drops = 0
        self.send_errors = 0
        self._device = config.l2_ip
        self._peer = (config.l2_ip, config.l2_port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, config.receive_buffer_bytes)
        for option in (_SO_TIMESTAMPNS, _SO_RXQ_OVFL):
            self._socket.setsockopt(socket.SOL_SOCKET, option, 1)
        try:
            self._socket.bind((config.host_ip, config.host_port))
        except OSError as error:
            self._socket.close()
            raise TransportError(error.errno, _bind_advice(config, error)) from None
        self._timeout_s = -1.0

    @property
    def port(self) -> int:
        """The port that is listened on."""
        return int(self._socket.getsockname()[1])

    @property
    def receive_buffer_bytes(self) -> int:
        """The receive buffer the kernel granted [B]; it doubles what it grants for its own use."""
        return self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2

    def receive(self, timeout_s: float) -> list[Datagram]:
        """Return what has arrived from the device, in order; empty when nothing did in time.

        One system call takes a datagram that just came; only when it has waited already are there
        likely to be more.
        """
        if timeout_s != self._timeout_s:
            self._set_timeout(timeout_s)
        batch: list[Datagram] = []
        flags = 0
        for _ in range(_BATCH):
            try:
                data, ancillary, _, sender = self._socket.recvmsg(
                    _MAX_DATAGRAM, _ANCILLARY_SIZE, flags
                )
            except BlockingIOError:
                break
            except OSError:  # an ICMP error of an earlier send, reported here
                continue
            arrival = self._arrival(ancillary)
            if sender[0] == self._device:
                batch.append(Datagram(data, arrival))
            else:
                self.foreign += 1
            if not flags and 0 <= time.time_ns() - arrival < _FRESH_NS:
                break
            flags = socket.MSG_DONTWAIT
        return batch

    def send(self, frame: bytes) -> None:
        """Send one frame to the device; a failure is counted, since commands are repeated."""
        try:
            self._socket.sendto(frame, self._peer)
        except OSError:
            self.send_errors += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _set_timeout(self, timeout_s: float) -> None:
        # In the kernel: Python's own timeout would poll before every read.
        seconds, microseconds = divmod(max(round(timeout_s * 1e6), 1), 1_000_000)
        value = _TIMEVAL.pack(seconds, microseconds)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
        self._timeout_s = timeout_s

    def _arrival(self, ancillary: list[tuple[int, int, bytes]]) -> HostNs:
        arrival = 0
        for _, kind, value in ancillary:
            if kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIMESPEC.unpack(value)
                arrival = seconds * 1_000_000_000 + nanoseconds
            elif kind == _SO_RXQ_OVFL:
                self.kernel_drops = _COUNTER.unpack(value)[0]
        return HostNs(arrival or time.time_ns())


def _bind_advice(config: NetworkConfig, error: OSError) -> str:
    address = f"{config.host_ip}:{config.host_port}"
    if error.errno == errno.EADDRNOTAVAIL:
        return (
            f"cannot listen on {address}: host_ip '{config.host_ip}' is no address of this "
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
