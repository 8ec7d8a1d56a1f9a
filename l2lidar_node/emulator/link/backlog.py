"""How much of what was sent to a UDP port of this machine its owner has not read yet."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Final

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
