"""Commands: encodes them and matches their ACKs."""

from __future__ import annotations

import ipaddress
import struct
from typing import Final, NamedTuple

from l2lidar_node.protocol import wire
from l2lidar_node.protocol.packets import NS, Ack
from l2lidar_node.types import HostNs

_FROM_HOST: Final = frozenset(
    {
        wire.PacketType.USER_COMMAND,
        wire.PacketType.TIME_SYNC,
        wire.PacketType.NETWORK,
        wire.PacketType.MAC,
        wire.PacketType.COMMAND,
        wire.PacketType.PARAMETERS,
        wire.PacketType.WORK_MODE,
    }
)


class Command(NamedTuple):
    """A command to the device.

    Attributes
    ----------
    name : str
        What it does, for messages.
    packet_type : int
    payload : bytes
    acknowledged : bool
        Whether the device answers with an ACK; it does to everything but a reset.
    """

    name: str
    packet_type: int
    payload: bytes
    acknowledged: bool = True

    def encode(self) -> bytes:
        """Return the frame to send."""
        return wire.encode_frame(self.packet_type, self.payload)

    def is_answered_by(self, ack: Ack) -> bool:
        """Tell whether an ACK belongs to this command.

        The device echoes the packet type. For the two command families it also echoes the number
        of the command; the value is compared only for latency requests, whose echo is all they are
        for, since other echoes are known to be unreliable.
        """
        if not self.acknowledged or ack.packet_type != self.packet_type:
            return False
        if self.packet_type not in (wire.PacketType.USER_COMMAND, wire.PacketType.COMMAND):
            return True
        if ack.command != struct.unpack_from("<I", self.payload)[0]:
            return False
        return not self.is_latency or self.is_echoed_by(ack)

    def is_echoed_by(self, ack: Ack) -> bool:
        """Tell whether an ACK repeats this command's number and value."""
        return self.payload == struct.pack("<2I", ack.command, ack.value)

    def is_same_kind(self, other: Command) -> bool:
        """Tell whether another command sets what this one sets, so that the later one counts."""
        if self.packet_type != other.packet_type or self.is_latency:
            return False
        is_numbered = self.packet_type in (wire.PacketType.USER_COMMAND, wire.PacketType.COMMAND)
        return not is_numbered or self.payload[:4] == other.payload[:4]

    @property
    def is_latency(self) -> bool:
        """Whether it only asks for an echo."""
        latency = struct.pack("<I", wire.Command.LATENCY)
        return self.packet_type == wire.PacketType.COMMAND and self.payload[:4] == latency

    @property
    def is_start(self) -> bool:
        """Whether it ends standby."""
        return (self.packet_type, self.payload) == (start().packet_type, start().payload)

    @property
    def is_standby(self) -> bool:
        """Whether it stops the motors."""
        return (self.packet_type, self.payload) == (standby().packet_type, standby().payload)

    @property
    def is_reset(self) -> bool:
        """Whether it reboots the device."""
        number = struct.pack("<I", wire.UserCommand.RESET)
        return self.packet_type == wire.PacketType.USER_COMMAND and self.payload[:4] == number

    @property
    def time(self) -> HostNs | None:
        """Time to which it sets the device's clock; None if it is not a time sync."""
        if self.packet_type != wire.PacketType.TIME_SYNC:
            return None
        seconds, nanoseconds = struct.unpack("<2I", self.payload)
        return HostNs(seconds * NS + nanoseconds)


def recorded(packet_type: int, payload: bytes) -> Command | None:
    """Return the command in a frame; None if it is not a known command."""
    layout = wire.PAYLOADS.get(packet_type)
    if packet_type not in _FROM_HOST or layout is None or len(payload) != layout.itemsize:
        return None
    return Command("recorded command", packet_type, payload)


def start() -> Command:
    """Return the command to leave standby; IMU returns within a second, points within 45 s."""
    return _user("start rotation", wire.UserCommand.STANDBY, 0)


def standby() -> Command:
    """Return the command to stop the motors; points and IMU stop."""
    return _user("standby", wire.UserCommand.STANDBY, 1)


def reset() -> Command:
    """Return the command to reboot; the device does not acknowledge it."""
    return _user("reset", wire.UserCommand.RESET, 1)._replace(acknowledged=False)


def request_config() -> Command:
    """Return the first family's request for the parameter block."""
    return _user("config request", wire.UserCommand.CONFIG_GET, 0)


def request_version() -> Command:
    """Return the request for the version packet, as the vendor's client makes it."""
    return _second("version request", wire.Command.VERSION, 0)


def request_parameters() -> Command:
    """Return the request for the parameter block, as the vendor's client makes it."""
    return _second("parameter request", wire.Command.PARAM_GET, 3)


def latency(number: int) -> Command:
    """Return an echo request; the ACK carries the same number."""
    return _second("latency", wire.Command.LATENCY, number & 0xFFFF_FFFF)


def sync_time(now: HostNs) -> Command:
    """Return the command that sets the device's clock to ``now`` on arrival.

    Raises
    ------
    ValueError
        If the seconds do not fit 32 bits.
    """
    seconds, nanoseconds = divmod(now, NS)
    if not 0 <= seconds < 1 << 32:
        raise ValueError(f"now: {now} ns does not fit the device's clock, expected 0 to 2**32 s")
    payload = struct.pack("<2I", seconds, nanoseconds)
    return Command("time sync", wire.PacketType.TIME_SYNC, payload)


def set_work_mode(mode: wire.WorkMode) -> Command:
    """Return the command that stores a work mode in flash.

    Raises
    ------
    ValueError
        If bits are set that no known client sends.
    """
    if int(mode) & ~wire.WORK_MODE_MASK or int(mode) < 0:
        raise ValueError(f"mode: {int(mode):#x} has bits outside {wire.WORK_MODE_MASK:#x}")
    return Command("work mode", wire.PacketType.WORK_MODE, struct.pack("<I", int(mode)))


def set_network(
    lidar_ip: str, user_ip: str, gateway: str, subnet_mask: str, lidar_port: int, user_port: int
) -> Command:
    """Return the command that stores addresses; they act after a restart.

    Raises
    ------
    ValueError
        If an address is not IPv4 or a port is not 1..65535, naming the argument.
    """
    addresses = {
        "lidar_ip": lidar_ip,
        "user_ip": user_ip,
        "gateway": gateway,
        "subnet_mask": subnet_mask,
    }
    payload = b""
    for name, text in addresses.items():
        try:
            payload += ipaddress.IPv4Address(text).packed
        except ipaddress.AddressValueError as error:
            raise ValueError(f"{name}: '{text}' is not an IPv4 address ({error})") from None
    for name, port in {"lidar_port": lidar_port, "user_port": user_port}.items():
        if not 1 <= port <= 65535:
            raise ValueError(f"{name}: {port} is out of range, expected 1 to 65535")
        payload += struct.pack("<H", port)
    return Command("network", wire.PacketType.NETWORK, payload)


def set_mac(mac: bytes) -> Command:
    """Return the command that stores a MAC address; it acts after a reset.

    Raises
    ------
    ValueError
        If it is not 6 bytes, or a multicast address.
    """
    if len(mac) != 6 or mac[0] & 1:
        raise ValueError(f"mac: {mac.hex(':')} is not a unicast MAC address of 6 bytes")
    return Command("MAC", wire.PacketType.MAC, mac + b"\0\0")


def set_parameters(payload: bytes) -> Command:
    """Return the command that stores a parameter block, made from one the device sent.

    Raises
    ------
    ValueError
        If it has not the size of a block.
    """
    size = wire.PARAMETERS_PAYLOAD.itemsize
    if len(payload) != size:
        raise ValueError(f"payload: {len(payload)} bytes, expected {size}")
    return Command("parameters", wire.PacketType.PARAMETERS, payload)


def _user(name: str, command: wire.UserCommand, value: int) -> Command:
    return Command(name, wire.PacketType.USER_COMMAND, struct.pack("<2I", command, value))


def _second(name: str, command: wire.Command, value: int) -> Command:
    return Command(name, wire.PacketType.COMMAND, struct.pack("<2I", command, value))
