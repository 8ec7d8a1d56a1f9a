"""Ports of the virtual unit: UDP socket, serial device or pseudo-terminal."""

from __future__ import annotations

import errno
import ipaddress
import os
import select
import socket
import termios
import time
import tty
from pathlib import Path
from typing import Final, Protocol

from l2lidar_node.emulator.unit.firmware import Network

_TABLES: Final = (Path("/proc/net/udp"), Path("/proc/net/udp6"))


def unread(ip: str, port: int) -> int | None:
    """Return the bytes that wait in the receiver's socket, with the system's own overhead.

    Parameters
    ----------
    ip : str
        IPv4 address that is sent to.
    port : int

    Returns
    -------
    int or None
        None when no socket of this machine listens there, or the system does not tell.
    """
    wanted = f":{port:04X}"
    address = f"{int.from_bytes(ipaddress.IPv4Address(ip).packed, 'little'):08X}"
    found: int | None = None
    for table in _TABLES:
        try:
            lines = table.read_text(encoding="ascii").splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            fields = line.split()
            local = fields[1]
            if not local.endswith(wanted):
                continue
            host = local[: -len(wanted)]
            if host.endswith(address) or not host.strip("0"):
                waiting = int(fields[4].split(":")[1], 16)
                found = waiting if found is None else max(found, waiting)
    return found


_READ: Final = 65536
_SEND_BUFFER: Final = 1 << 20
_CHECK_EVERY: Final = 8  # datagrams between two looks at the receiver
_FULL: Final = 48 * 1024  # the usual receive buffer is 208 kB; eight datagrams more weigh 20 kB
_LOOK_AGAIN_S: Final = 1e-4
_GONE: Final = {
    errno.ENETUNREACH,
    errno.EHOSTUNREACH,
    errno.ENETDOWN,
    errno.ECONNREFUSED,
    errno.EPERM,
}
_NO_WAY: Final = _GONE | {
    errno.EINVAL,  # from 127.0.0.1 to another machine, or to port 0
    errno.EACCES,  # to a broadcast address
    errno.EADDRNOTAVAIL,
}


class PortError(Exception):
    """The port cannot be opened; the message says which and why."""


class Port(Protocol):
    """A connector that carries bytes both ways."""

    @property
    def name(self) -> str:
        """Where it leads, for people."""
        ...

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the host has sent something."""
        ...

    def receive(self) -> list[bytes]:
        """Return data that the host has sent since the last call; does not wait.

        Raises
        ------
        PortError
            If the connector is lost for good.
        """
        ...

    def send(self, data: bytes) -> bool:
        """Send without waiting; False when it had to be dropped."""
        ...

    def drain(self, timeout_s: float) -> bool:
        """Wait until the host has read most of the sent data, as far as that is known.

        Returns
        -------
        bool
            False when it had not after the time.
        """
        ...

    def follow(self, network: Network) -> None:
        """Move to other addresses where that means anything."""
        ...

    def close(self) -> None:
        """Give the connector back."""
        ...


class UdpPort:
    """UDP socket bound to the unit's address, sending to the stored host.

    Parameters
    ----------
    network : Network
        Addresses; the unit's port may be 0 for any free one.
    reply_to_sender : bool
        Send to the last sender, if there was one, instead of the stored host.

    Raises
    ------
    PortError
        If the address cannot be bound.
    """

    def __init__(self, network: Network, reply_to_sender: bool = False) -> None:
        self._reply_to_sender = reply_to_sender
        self._socket = _bound(network)
        self._network = network
        self._host = (network.user_ip, network.user_port)
        self._unchecked = 0

    @property
    def address(self) -> tuple[str, int]:
        """Address and port that the unit really uses."""
        ip, port = self._socket.getsockname()
        return str(ip), int(port)

    @property
    def host(self) -> tuple[str, int]:
        """Address and port that datagrams go to."""
        return self._host

    @property
    def name(self) -> str:
        """Where it leads, for people."""
        return "udp {}:{} -> {}:{}".format(*self.address, *self._host)

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def receive(self) -> list[bytes]:
        """Return the waiting datagrams."""
        out: list[bytes] = []
        while True:
            try:
                data, sender = self._socket.recvfrom(_READ, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return out
            except OSError as error:
                if error.errno in _GONE:  # an earlier datagram bounced
                    continue
                raise
            if self._reply_to_sender:
                self._host = sender
            out.append(data)

    def send(self, data: bytes) -> bool:
        """Send one datagram; False when there is no way to the host."""
        try:
            self._socket.sendto(data, self._host)
        except OSError as error:
            if error.errno in _NO_WAY:
                return False
            raise
        return True

    def drain(self, timeout_s: float) -> bool:
        """Wait until a receiver on this machine has little left to read; else return at once."""
        self._unchecked += 1
        if self._unchecked < _CHECK_EVERY:
            return True
        deadline = time.monotonic() + timeout_s
        while (unread(*self._host) or 0) > _FULL:
            if time.monotonic() > deadline:
                return False
            time.sleep(_LOOK_AGAIN_S)
        self._unchecked = 0
        return True

    def follow(self, network: Network) -> None:
        """Move to other addresses.

        Raises
        ------
        PortError
            If the new address cannot be bound; the old one is given up all the same.
        """
        if network == self._network:
            return
        self._network = network
        self._host = (network.user_ip, network.user_port)
        if (network.lidar_ip, network.lidar_port) != self.address:
            self._socket.close()
            self._socket = _bound(network)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class SerialPort:
    """Serial device at 4 Mbaud, 8N1, raw; or a new pseudo-terminal.

    Parameters
    ----------
    path : str
        Device, or ``pty`` for a new pseudo-terminal whose other end is named by :attr:`name`.

    Raises
    ------
    PortError
        If the device cannot be opened or is none.
    """

    def __init__(self, path: str) -> None:
        try:
            if path == "pty":
                self._descriptor, self._other = os.openpty()
                self.name = f"serial {os.ttyname(self._other)}"
                _make_raw(self._other)
            else:
                self._descriptor, self._other = os.open(path, os.O_RDWR | os.O_NOCTTY), -1
                self.name = f"serial {path}"
                _make_raw(self._descriptor)
        except (OSError, termios.error) as error:
            raise PortError(f"cannot open the serial device {path}: {error.args[-1]}") from None
        os.set_blocking(self._descriptor, False)
        self._rest = b""

    def fileno(self) -> int:
        """Return the device's descriptor."""
        return self._descriptor

    def receive(self) -> list[bytes]:
        """Return the waiting bytes.

        Raises
        ------
        PortError
            If the device or its other end is gone.
        """
        try:
            data = os.read(self._descriptor, _READ)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            raise PortError(f"{self.name}: the other end was closed")
        return [data]

    def send(self, data: bytes) -> bool:
        """Send bytes; they are lost while the line is full, since there is no flow control."""
        self._flush()
        if self._rest:
            return False
        self._rest = data
        self._flush()
        return True

    def _flush(self) -> None:
        try:
            self._rest = self._rest[os.write(self._descriptor, self._rest) :]
        except OSError:  # full, or the other end is closed for now
            return

    def drain(self, timeout_s: float) -> bool:
        """Wait until the line has taken everything."""
        if self._rest:
            select.select([], [self._descriptor], [], timeout_s)
            self._flush()
        return not self._rest

    def follow(self, network: Network) -> None:
        """Do nothing: a serial line has no address."""

    def close(self) -> None:
        """Close the device."""
        for descriptor in (self._descriptor, self._other):
            if descriptor >= 0:
                os.close(descriptor)


def _bound(network: Network) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
    try:
        sock.bind((network.lidar_ip, network.lidar_port))
    except OSError as error:
        sock.close()
        raise PortError(
            f"cannot listen on {network.lidar_ip}:{network.lidar_port}: {error.strerror}"
        ) from None
    return sock


def _make_raw(descriptor: int) -> None:
    tty.setraw(descriptor)
    attributes = termios.tcgetattr(descriptor)
    attributes[2] = (
        (attributes[2] & ~(termios.PARENB | termios.CSTOPB | termios.CRTSCTS))
        | termios.CLOCAL
        | termios.CREAD
    )
    attributes[4] = attributes[5] = termios.B4000000
    termios.tcsetattr(descriptor, termios.TCSANOW, attributes)
