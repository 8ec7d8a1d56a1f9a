"""The unit's control program: power, command inbox, settings, clock, reboots."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import replace
from enum import Enum
from typing import Final, NamedTuple

import numpy as np

from l2lidar_node.emulator.config import DeviceConfig, IdentityConfig, PowerConfig
from l2lidar_node.emulator.unit.clock import UnitClock
from l2lidar_node.emulator.unit.flash import Flash, Network, mac_text, parameters_payload
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import AckStatus, Command, PacketType, UserCommand, WorkMode
from l2lidar_node.settings import SettingError


class PowerState(Enum):
    """How far the unit has come since it booted."""

    DEAF = "deaf"  # no link yet
    BOOTING = "booting"  # hears commands, has produced nothing yet
    SPINNING_UP = (
        "spinning up"  # sends IMU packets or waits for a start, no point packet produced yet
    )
    INITIALISED = "initialised"  # has produced a point packet since it booted


class Power:
    """Knows since when the unit is on and from when on each stream flows.

    Attributes
    ----------
    imu_from_ns, points_from_ns : int or None
        True instant from which on the stream flows; None in standby.
    """

    def __init__(self, config: PowerConfig, now_ns: int, waits: bool = False) -> None:
        self._config = config
        self.boot(now_ns, waits)

    def boot(self, now_ns: int, waits: bool) -> None:
        """Switch on at a true instant; one that waits stays in standby until a start command."""
        config = self._config
        self._link_ns = now_ns + self._ns(config.link_s)
        self._awake_ns = now_ns + self._ns(config.imu_s)
        self._initialised_ns: int | None = None
        self.imu_from_ns: int | None = None if waits else self._awake_ns
        self.points_from_ns: int | None = None if waits else now_ns + self._ns(config.points_s)

    def start(self, now_ns: int) -> None:
        """Leave standby; without effect on a unit that runs or spins up already."""
        if self.is_standby and self._config.wakes:
            self.imu_from_ns = max(now_ns + self._ns(self._config.wake_imu_s), self._awake_ns)
            self.points_from_ns = max(
                now_ns + self._ns(self._config.wake_points_s), self._awake_ns
            )

    def stop(self, now_ns: int) -> None:
        """Go to standby: both streams end."""
        self._note(now_ns)
        self.imu_from_ns = self.points_from_ns = None

    @property
    def is_standby(self) -> bool:
        """Whether the motors stand still on request."""
        return self.points_from_ns is None

    def power_state(self, now_ns: int) -> PowerState:
        """Return how far the unit has come at a true instant."""
        self._note(now_ns)
        if now_ns < self._link_ns:
            return PowerState.DEAF
        if now_ns < self._awake_ns:
            return PowerState.BOOTING
        return PowerState.SPINNING_UP if self._initialised_ns is None else PowerState.INITIALISED

    def _note(self, now_ns: int) -> None:
        if (
            self._initialised_ns is None
            and self.points_from_ns is not None
            and now_ns >= self.points_from_ns
        ):
            self._initialised_ns = self.points_from_ns

    def _ns(self, seconds: float) -> int:
        return round(seconds * self._config.boot_scale * 1e9)


_MAX_COMMAND: Final = 256  # the longest packet a host sends is 196 bytes


class Received(NamedTuple):
    """A packet from the host.

    Attributes
    ----------
    packet_type : int
        As in its header.
    payload : bytes
        Empty unless the status is OK.
    status : AckStatus
        OK, CRC_ERROR or HEADER_ERROR.
    """

    packet_type: int
    payload: bytes
    status: AckStatus


class Inbox:
    """Collects bytes until they make up packets; tail words but the end mark are ignored."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes) -> Iterator[Received]:
        """Yield the packets that these bytes complete; keep the rest, at most 256 bytes."""
        self._buffer += data
        while True:
            start = self._buffer.find(wire.MAGIC)
            if start < 0:
                self._buffer = self._buffer[-len(wire.MAGIC) + 1 :]
                return
            self._buffer = self._buffer[start:]
            if len(self._buffer) < wire.HEADER.size:
                return
            _, packet_type, size = wire.HEADER.unpack_from(self._buffer)
            if not wire.OVERHEAD < size <= _MAX_COMMAND:
                self._buffer = self._buffer[1:]
                yield Received(packet_type, b"", AckStatus.HEADER_ERROR)
                continue
            if len(self._buffer) < size:
                return
            yield self._take(packet_type, size)

    def _take(self, packet_type: int, size: int) -> Received:
        payload = self._buffer[wire.HEADER.size : size - wire.TAIL.size]
        crc, _, _, end = wire.TAIL.unpack_from(self._buffer, size - wire.TAIL.size)
        if end != wire.TAIL_END:
            self._buffer = self._buffer[1:]
            return Received(packet_type, b"", AckStatus.HEADER_ERROR)
        if crc != zlib.crc32(payload):
            # A wrong size makes a wrong CRC too: this payload may hold the next command.
            self._buffer = self._buffer[1:]
            return Received(packet_type, b"", AckStatus.CRC_ERROR)
        self._buffer = self._buffer[size:]
        expected = wire.FRAME_SIZES.get(packet_type)
        if expected != size:
            return Received(packet_type, b"", AckStatus.HEADER_ERROR)
        return Received(packet_type, payload, AckStatus.OK)


_LIVE: Final = WorkMode.WIDE_FOV | WorkMode.IMU_OFF
_VERSION: Final = {
    (PacketType.USER_COMMAND, UserCommand.VERSION),
    (PacketType.COMMAND, Command.VERSION),
}
_PARAMETERS: Final = {
    (PacketType.USER_COMMAND, UserCommand.CONFIG_GET),
    (PacketType.COMMAND, Command.PARAM_GET),
}
_STANDBY: Final = {
    (PacketType.USER_COMMAND, UserCommand.STANDBY),
    (PacketType.COMMAND, Command.STANDBY),
}
_FACTORY: Final = {
    (PacketType.USER_COMMAND, UserCommand.CONFIG_RESET),
    (PacketType.COMMAND, Command.CONFIG_RESET),
}
_RESET: Final = (PacketType.USER_COMMAND, UserCommand.RESET)

Reply = tuple[PacketType, bytes]
"""Packet type and payload of an answer."""


class Firmware:
    """Everything about the unit but its measurements.

    Parameters
    ----------
    config : DeviceConfig
    flash : Flash
        Stored settings to boot with.
    now_ns : int
        True instant of power-on.
    """

    def __init__(self, config: DeviceConfig, flash: Flash, now_ns: int) -> None:
        self._config = config
        self._identity = version_payload(config.identity)
        self._factory = Flash.factory(config.addresses, config.identity)
        self.flash = flash
        self.clock = UnitClock(config.crystal, now_ns)
        self.power = Power(config.power, now_ns)
        self.boots = -1
        self.reboot(now_ns)

    def reboot(self, now_ns: int) -> None:
        """Restart: the clock counts from 0 and stored settings come into force."""
        self.boots += 1
        self._booted_with = self.flash
        self.clock.set(now_ns, 0)
        self.power.boot(now_ns, bool(self.flash.work_mode & WorkMode.WAIT_FOR_START))

    @property
    def mode(self) -> WorkMode:
        """Work mode in force: field of view and IMU act at once, the rest since the boot."""
        return WorkMode(
            (self._booted_with.work_mode & ~int(_LIVE)) | (self.flash.work_mode & int(_LIVE))
        )

    @property
    def network(self) -> Network:
        """Network settings in force, those stored at the boot."""
        return self._booted_with.network

    def answer(self, received: Received, now_ns: int) -> list[Reply]:
        """Carry out a packet from the host and return the answers in the order of leaving.

        Every packet is acknowledged but a reset, a version request before the unit has come far
        enough, and whatever comes before the link is up. A packet with a wrong CRC gets status
        CRC_ERROR; an unknown type or command number, or a size that does not fit the type,
        HEADER_ERROR; a value that the command cannot take, BLOCK_ERROR.
        """
        if self.power.power_state(now_ns) is PowerState.DEAF:
            return []
        packet_type, payload, status = received
        if status is not AckStatus.OK:
            return [_ack(packet_type, status)]
        if packet_type in (PacketType.USER_COMMAND, PacketType.COMMAND):
            command, value = (int(word) for word in np.frombuffer(payload, "<u4"))
            return self._command(PacketType(packet_type), command, value, now_ns)
        return [_ack(packet_type, self._store(packet_type, payload, now_ns))]

    def _command(self, family: PacketType, command: int, value: int, now_ns: int) -> list[Reply]:
        key = (family, command)
        status = AckStatus.OK
        data: list[Reply] = []
        if key == _RESET:
            self.reboot(now_ns)
            return []
        if key in _VERSION:
            power_state = self.power.power_state(now_ns)
            if power_state is PowerState.BOOTING:
                return []
            if power_state is PowerState.SPINNING_UP:
                status = AckStatus.NOT_READY
            else:
                data.append((PacketType.VERSION, self._identity))
        elif key in _PARAMETERS:
            data.append((PacketType.PARAMETERS, parameters_payload(self.flash)))
        elif key in _STANDBY:
            status = self._standby(value, now_ns)
        elif key in _FACTORY:
            self.flash = self._factory
        elif key == (PacketType.COMMAND, Command.PARAM_RESET):
            self.flash = replace(self.flash, parameters="")
        elif key == (PacketType.USER_COMMAND, UserCommand.AUTO_STANDBY):
            self.flash = replace(self.flash, auto_standby=value)
        elif not _is_known(family, command):
            status = AckStatus.HEADER_ERROR
        return [*data, _ack(family, status, command, value)]

    def _standby(self, value: int, now_ns: int) -> AckStatus:
        if value == 0:
            self.power.start(now_ns)
        elif value == 1:
            self.power.stop(now_ns)
        else:
            return AckStatus.BLOCK_ERROR
        return AckStatus.OK

    def _store(self, packet_type: int, payload: bytes, now_ns: int) -> AckStatus:
        """Carry out a packet that is no command but a value."""
        if packet_type == PacketType.TIME_SYNC:
            sec, nsec = (int(word) for word in np.frombuffer(payload, "<u4"))
            self.clock.set(now_ns, sec * 1_000_000_000 + nsec)
        elif packet_type in (PacketType.WORK_MODE, PacketType.WORK_MODE_CONFIG):
            mode = int.from_bytes(payload, "little")
            self.flash = replace(self.flash, work_mode=mode & wire.WORK_MODE_MASK)
        elif packet_type == PacketType.NETWORK:
            flash = self.flash.with_network(payload)
            if not (flash.network.lidar_port and flash.network.user_port):
                return AckStatus.BLOCK_ERROR
            self.flash = flash
        elif packet_type == PacketType.MAC:
            self.flash = replace(self.flash, mac=mac_text(payload[:6]))
        elif packet_type == PacketType.PARAMETERS:
            self.flash = replace(self.flash, parameters=payload.hex())
        else:
            return AckStatus.HEADER_ERROR
        return AckStatus.OK


def version_payload(identity: IdentityConfig) -> bytes:
    """Return the payload of packet 105.

    Raises
    ------
    SettingError
        If a version is not four numbers.
    """
    row = np.zeros(1, wire.VERSION_PAYLOAD)
    row["hardware"] = tuple(_version_bytes("hardware", identity.hardware))
    row["software"] = tuple(_version_bytes("firmware", identity.firmware))
    row["name"] = identity.product.encode()
    row["date"] = identity.firmware_date.encode()
    return row.tobytes()


def _ack(packet_type: int, status: AckStatus, command: int = 0, value: int = 0) -> Reply:
    row = np.array([(packet_type, command, value, status)], wire.ACK_PAYLOAD)
    return PacketType.ACK, row.tobytes()


def _version_bytes(name: str, text: str) -> bytes:
    try:
        numbers = bytes(int(part) for part in text.split("."))
    except ValueError:
        numbers = b""
    if len(numbers) != 4:
        raise SettingError(
            f"parameter '{name}': {text!r} is not a version; "
            "expected four numbers such as 2.8.11.1"
        )
    return numbers


def _is_known(family: PacketType, command: int) -> bool:
    commands = UserCommand if family is PacketType.USER_COMMAND else Command
    return command in {int(item) for item in commands}
