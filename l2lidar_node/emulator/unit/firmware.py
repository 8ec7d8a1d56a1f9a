"""The unit's control program: power, command inbox, stored settings, clock, reboots."""

from __future__ import annotations

import ipaddress
import json
import math
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from enum import Enum
from itertools import compress
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.config import (
    AddressConfig,
    CrystalConfig,
    DeviceConfig,
    IdentityConfig,
    PowerConfig,
)
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import AckStatus, Command, PacketType, UserCommand, WorkMode
from l2lidar_node.settings import SettingError
from l2lidar_node.types import DeviceNs


class Network(NamedTuple):
    """Addresses in dotted order, as command 108 carries them."""

    lidar_ip: str
    user_ip: str
    gateway: str
    subnet_mask: str
    lidar_port: int
    user_port: int


@dataclass(frozen=True, slots=True)
class Flash:
    """Stored settings; those that need a restart come into force at the next boot.

    Attributes
    ----------
    network : Network
    mac : str
        Hardware address, colon separated.
    work_mode : int
        Bits of :class:`wire.WorkMode`.
    auto_standby : int
        Value of the last auto-standby command; without effect.
    parameters : str
        Hexadecimal :data:`wire.PARAMETERS_PAYLOAD`, empty for the factory's; its work mode is
        ignored.
    """

    network: Network
    mac: str
    work_mode: int = 0
    auto_standby: int = 0
    parameters: str = ""

    @classmethod
    def factory(cls, addresses: AddressConfig, identity: IdentityConfig) -> Flash:
        """Return the settings of a new unit.

        Raises
        ------
        SettingError
            If an address is not one; the message names the setting.
        """
        for name, value in (("lidar_ip", addresses.lidar_ip), ("host", addresses.host)):
            try:
                ipaddress.IPv4Address(value)
            except ValueError:
                raise SettingError(
                    f"parameter '{name}': {value!r} is not an IPv4 address; "
                    "expected one such as 192.168.1.62"
                ) from None
        gateway = addresses.lidar_ip.rsplit(".", 1)[0] + ".1"
        network = Network(
            addresses.lidar_ip,
            addresses.host,
            gateway,
            "255.255.255.0",
            addresses.lidar_port,
            addresses.host_port,
        )
        return cls(network, mac_text(mac_bytes(identity.mac)), identity.work_mode)

    def to_json(self) -> str:
        """Return a text that :meth:`from_json` reads."""
        facts = asdict(self)
        facts["network"] = self.network._asdict()
        return json.dumps(facts, indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Flash:
        """Return the settings a text states.

        Raises
        ------
        ValueError
            If the text is not one made by :meth:`to_json`.
        """
        try:
            facts = json.loads(text)
            network = Network(**facts.pop("network"))
            flash = cls(network=network, **facts)
            network_payload(network)
            mac_bytes(flash.mac)
            parameters_payload(flash)
            np.array([flash.work_mode, flash.auto_standby], dtype=np.uint32)
        except (TypeError, KeyError, AttributeError, OverflowError, ValueError) as error:
            raise ValueError(f"not the stored settings of a virtual L2: {error}") from None
        return flash

    def with_network(self, payload: bytes) -> Flash:
        """Return the settings with a network payload stored."""
        row = np.frombuffer(payload, wire.NETWORK_PAYLOAD)[0]
        lidar_ip, user_ip, gateway, mask = (
            str(ipaddress.IPv4Address(row[name].tobytes()))
            for name in ("lidar_ip", "user_ip", "gateway", "subnet_mask")
        )
        ports = int(row["lidar_port"]), int(row["user_port"])
        return replace(self, network=Network(lidar_ip, user_ip, gateway, mask, *ports))


def network_payload(network: Network) -> bytes:
    """Return the payload of command 108 for these addresses."""
    addresses = b"".join(ipaddress.IPv4Address(text).packed for text in network[:4])
    ports = np.array([network.lidar_port, network.user_port], dtype="<u2")
    return addresses + ports.tobytes()


def mac_bytes(text: str) -> bytes:
    """Return the six bytes of a hardware address.

    Raises
    ------
    SettingError
        If the text is not six hexadecimal pairs.
    """
    try:
        raw = bytes.fromhex(text.replace(":", "").replace("-", ""))
    except ValueError:
        raw = b""
    if len(raw) != 6:
        raise SettingError(
            f"parameter 'mac': {text!r} is not a MAC address; "
            "expected one such as 4c:32:01:00:00:62"
        )
    return raw


def mac_text(raw: bytes) -> str:
    """Return six bytes as a colon separated hardware address."""
    return ":".join(f"{byte:02x}" for byte in raw)


def parameters_payload(flash: Flash) -> bytes:
    """Return the payload of packet 2001: stored parameters and the stored work mode."""
    row = np.zeros(1, wire.PARAMETERS_PAYLOAD)
    if flash.parameters:
        row = np.frombuffer(bytes.fromhex(flash.parameters), wire.PARAMETERS_PAYLOAD).copy()
    else:
        row["range_max"] = RANGE_MAX_M
        row["range_min"] = RANGE_MIN_M
        for name in (
            "calibration_3d",
            "calibration_3d_wide",
            "calibration_2d",
            "calibration_2d_wide",
        ):
            row[name] = CALIBRATION
    row["work_mode"] = flash.work_mode
    return row.tobytes()


RANGE_MIN_M = 0.05
RANGE_MAX_M = 50.0
CALIBRATION = (0.0445, 0.006586, 2.0769, 0.032398, 0.003818, 0.002945, -365.625, 0.000978)
"""Calibration block of a published unit, in the order of :data:`wire.CALIBRATION`."""


_NS = 1_000_000_000
_KEEP_NS = 10 * _NS  # no packet is stamped later than that after the instant it carries


class Epoch(NamedTuple):
    """From the true instant ``start_ns`` on, the clock counts from ``value_ns``."""

    start_ns: int
    value_ns: int


class UnitClock:
    """The unit's clock as a function of true time.

    Parameters
    ----------
    config : CrystalConfig
        Rate of the clock.
    power_on_ns : int
        True instant of the first power-on; drift counts from here, also over later restarts.

    Notes
    -----
    Within an epoch the clock shows ``value + E(t) - E(start)`` truncated to whole nanoseconds,
    E being the closed integral of the rate (see :class:`CrystalConfig`): no error accumulates.
    """

    def __init__(self, config: CrystalConfig, power_on_ns: int) -> None:
        self._config = config
        self._origin_ns = power_on_ns
        self._drifts = bool(config.clock_drift_ppm_per_h or config.clock_wave_ppm)
        self._arrange([Epoch(power_on_ns, 0)])

    def set(self, now_ns: int, value_ns: int) -> None:
        """Make the clock show a value from a true instant on; instants must not decrease."""
        epochs = [*self._epochs, Epoch(now_ns, value_ns)]
        ends_ns = (epoch.start_ns for epoch in epochs[1:])
        recent = [end_ns > now_ns - _KEEP_NS for end_ns in ends_ns]
        self._arrange([*compress(epochs, recent), epochs[-1]])

    def _arrange(self, epochs: list[Epoch]) -> None:
        """Keep epochs, and what is needed of them again and again as arrays."""
        self._epochs = epochs
        self._starts_ns = np.array([epoch.start_ns for epoch in epochs], dtype=np.int64)
        self._values_ns = np.array([epoch.value_ns for epoch in epochs], dtype=np.int64)
        self._begun = self._elapsed(self._starts_ns)

    def step(self, now_ns: int, change_ns: int) -> None:
        """Move the clock by some nanoseconds of its own at a true instant, not below 0."""
        self.set(now_ns, max(0, self.at(now_ns) + change_ns))

    def at(self, now_ns: int) -> DeviceNs:
        """Return the clock's reading at a true time."""
        return DeviceNs(int(self.stamps(np.array([now_ns], dtype=np.int64))[0]))

    def stamps(self, instants_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the clock's readings at true times.

        Parameters
        ----------
        instants_ns : ndarray, shape (N,), dtype int64
            Each is attributed to the epoch it lies in, so an instant before the last set still
            shows the clock as it was.

        Returns
        -------
        ndarray, shape (N,), dtype int64
            Nanoseconds of the unit's clock.
        """
        epoch = np.maximum(np.searchsorted(self._starts_ns, instants_ns, side="right") - 1, 0)
        elapsed = self._elapsed(instants_ns) - self._begun[epoch]
        shown = self._values_ns[epoch] + np.floor(elapsed).astype(np.int64)
        return np.asarray(shown, dtype=np.int64)

    def _elapsed(self, instants_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the integral of the rate from power-on [ns], exact to 2 ns over a month."""
        config = self._config
        t = (instants_ns - self._origin_ns).astype(np.float64)
        if not self._drifts:
            return np.asarray(t / config.clock_ratio)
        seconds = t / _NS
        angular = 2.0 * math.pi / config.clock_wave_s
        ppm_seconds = (
            0.5 * config.clock_drift_ppm_per_h / 3600.0 * seconds** 2
            + config.clock_wave_ppm / angular * (1.0 - np.cos(angular * seconds))
        )
        return np.asarray((t + ppm_seconds * 1e-6 * _NS) / config.clock_ratio)


class PowerState(Enum):
    """Progress of the unit's start-up."""

    DEAF = "deaf"  # no link yet
    BOOTING = "booting"  # hears commands, has produced nothing yet
    SPINNING_UP = (
        "spinning up"  # sends IMU packets or waits for a start, no point packet produced yet
    )
    INITIALIZED = "initialized"  # has produced a point packet since it booted


class Power:
    """Power state: when the unit was switched on and when each stream starts.

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
        self._initialized_ns: int | None = None
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
        return PowerState.SPINNING_UP if self._initialized_ns is None else PowerState.INITIALIZED

    def _note(self, now_ns: int) -> None:
        if (
            self._initialized_ns is None
            and self.points_from_ns is not None
            and now_ns >= self.points_from_ns
        ):
            self._initialized_ns = self.points_from_ns

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
    """Assembles packets from bytes; ignores tail words except the end mark."""

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
    """The unit's firmware without its measurements.

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
        """Apply a packet that carries a value rather than a command."""
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
