"""Asks Linux for this machine's addresses and for the hardware addresses it has seen."""

from __future__ import annotations

import fcntl
import socket
import struct
from pathlib import Path
from typing import Final

_SIOCGIFADDR: Final = 0x8915
_NEIGHBOURS: Final = Path("/proc/net/arp")


def local_addresses() -> list[str]:
    """Return the IPv4 addresses of this machine's network interfaces, without the loopback's."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as item:
        for _, name in socket.if_nameindex():
            request = struct.pack("256s", name.encode()[:15])
            try:
                answer = fcntl.ioctl(item.fileno(), _SIOCGIFADDR, request)
            except OSError:  # without an address
                continue
            found.append(socket.inet_ntoa(answer[20:24]))
    return [address for address in found if not address.startswith("127.")]


def hardware_address(ip: str) -> str | None:
    """Return the hardware address that answers for an IPv4 address; None if it is not known."""
    try:
        lines = _NEIGHBOURS.read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return None
    for line in lines:
        address, _, _, hardware, *_ = line.split()
        if address == ip and hardware != "00:00:00:00:00:00":
            return hardware
    return None
