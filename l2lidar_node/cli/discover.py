"""`l2lidar discover`: finds units that send to this machine or answer it."""

from __future__ import annotations

import ipaddress
import socket
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Annotated, Any, Final

import typer
from rich.table import Table

from l2lidar_node.cli.console import JsonOption, out, print_json, say
from l2lidar_node.cli.device import DeviceError, hardware_address, local_addresses
from l2lidar_node.protocol import commands, wire
from l2lidar_node.protocol.framing import Frame, Framer
from l2lidar_node.protocol.packets import Parameters, Version, decode
from l2lidar_node.transport.udp import TransportError

_PROBE_S: Final = 0.5
_LOOK_S: Final = 0.1
_MAX_DATAGRAM: Final = 65_536
_EVERYBODY: Final = "255.255.255.255"


@dataclass
class Speaker:
    """A sender, and what it sends.

    Attributes
    ----------
    framer : Framer
    frames : Counter
        Good frames by packet type.
    version : Version or None
    work_mode : int or None
    """

    framer: Framer = field(default_factory=Framer)
    frames: Counter[int] = field(default_factory=Counter)
    version: Version | None = None
    work_mode: int | None = None

    def hear(self, data: bytes) -> None:
        """Take a datagram."""
        for item in self.framer.feed(data):
            if not isinstance(item, Frame):
                continue
            self.frames[item.packet_type] += 1
            packet = decode(item)
            if isinstance(packet, Version):
                self.version = packet
            elif isinstance(packet, Parameters):
                self.work_mode = packet.work_mode


def _addresses(given: list[str] | None) -> list[str] | None:
    for text in given or []:
        try:
            ipaddress.IPv4Address(text)
        except ipaddress.AddressValueError:
            raise typer.BadParameter(
                f"'{text}' is not an IPv4 address, expected one such as {wire.LIDAR_IP}"
            ) from None
    return given


def discover(
    host_port: Annotated[
        int, typer.Option(min=1, max=65535, help="Port that units send to.")
    ] = wire.HOST_PORT,
    l2_port: Annotated[
        int, typer.Option(min=1, max=65535, help="Port on which units are queried.")
    ] = wire.LIDAR_PORT,
    probe: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ADDRESS",
            callback=_addresses,
            help=f"Address to query besides {wire.LIDAR_IP}.",
        ),
    ] = None,
    timeout: Annotated[float, typer.Option(min=0.1, max=600.0, help="Seconds to listen.")] = 3.0,
    json_: JsonOption = False,
) -> None:
    """Find units: listen on all interfaces, and query the usual address.

    A unit sends to one address only, 192.168.1.2 as it leaves the factory: it is heard if this
    machine has that address. Units in standby do not send, but they answer. The exit code is 1 if
    there is none.
    """
    speakers = listen(host_port, [(ip, l2_port) for ip in _asked(probe)], timeout)
    units = {end: speaker for end, speaker in speakers.items() if speaker.frames}
    others = sorted(f"{ip}:{port}" for ip, port in speakers.keys() - units.keys())
    rows = [_row(end, speaker, timeout) for end, speaker in sorted(units.items())]
    if json_:
        print_json({"units": rows, "others": others})
    else:
        _show(rows, others)
    if not units:
        addresses = ", ".join(local_addresses()) or "none"
        raise DeviceError(
            f"no L2 heard on port {host_port}. This machine's addresses: {addresses}. A new unit "
            f"sends to {wire.HOST_IP} only and takes 25 s from power-on to its first points; give "
            "its network interface that address, for example "
            f"`sudo ip address add {wire.HOST_IP}/24 dev eth0`"
        )


def listen(host_port: int, ask: list[tuple[str, int]], seconds: float) -> dict[Any, Speaker]:
    """Return who sent something to a port within a time, by address and port.

    Raises
    ------
    TransportError
        If the port cannot be listened on.
    """
    speakers: dict[Any, Speaker] = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as item:
        item.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        try:
            item.bind(("0.0.0.0", host_port))
        except OSError as error:
            raise TransportError(
                error.errno,
                f"cannot listen on port {host_port}: {error.strerror}; stop the driver or "
                "whatever else uses it",
            ) from None
        item.settimeout(_LOOK_S)
        next_probe = 0.0
        deadline = time.monotonic() + seconds
        while (now := time.monotonic()) < deadline:
            if now >= next_probe:
                next_probe = now + _PROBE_S
                _probe(item, ask)
            with suppress(OSError):  # no answer in time, or no host at a queried address
                data, sender = item.recvfrom(_MAX_DATAGRAM)
                speakers.setdefault(sender, Speaker()).hear(data)
    return speakers


def _probe(item: socket.socket, ask: list[tuple[str, int]]) -> None:
    for end in ask:
        for command in (commands.request_version(), commands.request_parameters()):
            try:
                item.sendto(command.encode(), end)
            except OSError:  # no way there
                break


def _asked(probe: list[str] | None) -> list[str]:
    return list(dict.fromkeys([wire.LIDAR_IP, _EVERYBODY, *(probe or [])]))


def _row(end: tuple[str, int], speaker: Speaker, seconds: float) -> dict[str, Any]:
    version = speaker.version
    points = speaker.frames[wire.PacketType.POINTS_3D] + speaker.frames[wire.PacketType.POINTS_2D]
    return {
        "ip": end[0],
        "port": end[1],
        "mac": hardware_address(end[0]),
        "name": version.name if version else None,
        "hardware": version.hardware if version else None,
        "firmware": version.firmware if version else None,
        "work_mode": speaker.work_mode,
        "points_hz": round(points / seconds, 1),
        "imu_hz": round(speaker.frames[wire.PacketType.IMU] / seconds, 1),
    }


def _show(rows: list[dict[str, Any]], others: list[str]) -> None:
    if rows:
        table = Table(box=None, pad_edge=False)
        for name in rows[0]:
            table.add_column(name.replace("_", " "))
        for row in rows:
            table.add_row(*("?" if value is None else str(value) for value in row.values()))
        out.print(table)
    if others:
        say(f"not an L2, but sends here: {', '.join(others)}")
