"""Commands against the bytes the protocol lists, and ACKs against commands."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import pytest

from l2lidar_node.protocol import commands, wire
from l2lidar_node.protocol.commands import Command
from l2lidar_node.protocol.packets import Ack
from l2lidar_node.protocol.wire import PacketType, UserCommand, WorkMode
from l2lidar_node.types import HostNs

# Payload and its checksum, as the vendor's client or the protocol's table has them.
LISTED = [
    (commands.start(), 100, "02000000 00000000 14d80727"),
    (commands.standby(), 100, "02000000 01000000 71bfbb9f"),
    (commands.reset(), 100, "01000000 01000000 92b83411"),
    (commands.request_config(), 100, "06000000 00000000 eed64da3"),
    (commands.request_version(), 2000, "04000000 00000000 93d168e1"),
    (commands.request_parameters(), 2000, "03000000 03000000 647718f9"),
    (commands.latency(101), 2000, "06000000 65000000 dfd1b5af"),
    (commands.set_work_mode(WorkMode(0)), 2002, "00000000 1cdf4421"),
    (commands.set_work_mode(WorkMode.WIDE_FOV | WorkMode.IMU_OFF), 2002, "05000000 2e2f9a16"),
    (commands.set_work_mode(WorkMode.SERIAL), 2002, "08000000 f3f7f0e4"),
]


@pytest.mark.parametrize(("command", "packet_type", "listed"), LISTED)
def test_bytes_are_the_listed_ones(command: Any, packet_type: Any, listed: Any) -> None:
    body = bytes.fromhex(listed)
    size = 12 + len(body) + 8
    head = bytes.fromhex("55aa050a") + struct.pack("<II", packet_type, size)
    assert command.encode() == head + body + bytes.fromhex("00000000 0000 00ff")


def test_time_sync() -> None:
    command = commands.sync_time(HostNs(1_700_000_123_456_789_012))
    payload = struct.pack("<II", 1_700_000_123, 456_789_012)
    assert command.encode()[:24] == (
        bytes.fromhex("55aa050a 6a000000 20000000")
        + payload
        + struct.pack("<I", zlib.crc32(payload))
    )


@pytest.mark.parametrize("now", [-1, (1 << 32) * 10**9])
def test_a_time_the_device_cannot_hold(now: Any) -> None:
    with pytest.raises(ValueError, match=f"^now: {now} ns"):
        commands.sync_time(HostNs(now))


NETWORK: dict[str, Any] = {
    "lidar_ip": "192.168.1.62", "user_ip": "192.168.1.2", "gateway": "192.168.1.1",
    "subnet_mask": "255.255.255.0", "lidar_port": 6101, "user_port": 6201,
}  # fmt: skip


def test_network() -> None:
    command = commands.set_network(**NETWORK)
    assert command.packet_type == PacketType.NETWORK
    assert command.payload.hex(" ", 4) == "c0a8013e c0a80102 c0a80101 ffffff00 d5173918"
    assert len(command.encode()) == 44


@pytest.mark.parametrize("name", ["lidar_ip", "user_ip", "gateway", "subnet_mask"])
@pytest.mark.parametrize("value", ["", "192.168.1", "192.168.1.256", "::1", "lidar", "1.2.3.4/24"])
def test_a_bad_address_is_named(name: str, value: str) -> None:
    with pytest.raises(ValueError, match=f"^{name}: '{value}' is not an IPv4 address"):
        commands.set_network(**NETWORK | {name: value})


@pytest.mark.parametrize("name", ["lidar_port", "user_port"])
@pytest.mark.parametrize("value", [0, -1, 65536])
def test_a_bad_port_is_named(name: str, value: int) -> None:
    with pytest.raises(ValueError, match=f"^{name}: {value} is out of range, expected 1 to 65535"):
        commands.set_network(**NETWORK | {name: value})


def test_mac() -> None:
    command = commands.set_mac(bytes.fromhex("02a1b2c3d4e5"))
    assert command.packet_type == PacketType.MAC
    assert command.payload == bytes.fromhex("02a1b2c3d4e5 0000")
    assert len(command.encode()) == 32


@pytest.mark.parametrize(
    "mac", [b"", bytes(5), bytes(7), bytes.fromhex("01a1b2c3d4e5"), b"\xff" * 6]
)
def test_a_bad_mac_is_named(mac: Any) -> None:
    with pytest.raises(ValueError, match=r"^mac: "):
        commands.set_mac(mac)


@pytest.mark.parametrize("mode", [1 << 22, 0xFFFF_FFFF, -1])
def test_a_bad_work_mode_is_named(mode: Any) -> None:
    with pytest.raises(ValueError, match=r"^mode: "):
        commands.set_work_mode(mode)


def test_a_latency_number_wraps_with_its_field() -> None:
    assert commands.latency(1 << 32).payload == commands.latency(0).payload


def answered(command: Command, packet_type: int, number: int, value: int, status: int = 1) -> bool:
    return command.is_answered_by(Ack(packet_type, number, value, status))


def test_an_ack_answers_the_command_it_repeats_whatever_its_value_and_status() -> None:
    assert answered(commands.start(), 100, UserCommand.STANDBY, 0)
    assert answered(commands.start(), 100, UserCommand.STANDBY, 77, status=5)
    assert not answered(commands.start(), 100, UserCommand.VERSION, 0)
    assert not answered(commands.start(), 2000, UserCommand.STANDBY, 0)


def test_a_latency_echo_must_carry_the_number() -> None:
    assert answered(commands.latency(101), 2000, 6, 101)
    assert not answered(commands.latency(101), 2000, 6, 100)


def test_an_ack_without_a_command_number_answers_by_its_type() -> None:
    assert answered(commands.set_mac(bytes(6)), 109, 0, 0)
    assert answered(commands.set_work_mode(WorkMode(0)), 2002, 3, 4)
    assert not answered(commands.set_work_mode(WorkMode(0)), 107, 0, 0)


def test_a_reset_is_never_answered() -> None:
    assert not commands.reset().acknowledged
    assert not answered(commands.reset(), 100, UserCommand.RESET, 1)


def test_an_exact_echo() -> None:
    ack = Ack(100, UserCommand.STANDBY, 1, wire.AckStatus.OK)
    assert commands.standby().is_echoed_by(ack)
    assert not commands.start().is_echoed_by(ack)
    assert not commands.set_mac(bytes(6)).is_echoed_by(ack)


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        (commands.start(), commands.standby(), True),
        (commands.start(), commands.request_config(), False),
        (commands.request_version(), commands.request_parameters(), False),
        (commands.set_work_mode(WorkMode(0)), commands.set_work_mode(WorkMode.MODE_2D), True),
        (commands.set_mac(bytes(6)), commands.set_work_mode(WorkMode(0)), False),
        (commands.latency(1), commands.latency(2), False),
    ],
)
def test_what_sets_the_same_thing(one: Any, other: Any, expected: bool) -> None:
    assert one.is_same_kind(other) is expected
    assert other.is_same_kind(one) is expected
