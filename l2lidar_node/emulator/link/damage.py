"""Faults that damage single packets: each takes a frame and returns what is left of it."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Final

import numpy as np

from l2lidar_node.emulator.truth.packet_log import Fault
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType

Damage = Callable[[bytes, np.random.Generator], bytes | None]
"""Frame and randomness in, damaged frame out; None where this damage is not possible."""

HOSTILE_SIZES: Final = (12, 24, 10001, 0xFFFF_FFFF)
_VITAL: Final = {
    PacketType.POINTS_3D: (
        "com_horizontal_angle_start",
        "com_horizontal_angle_step",
        "range_min",
        "range_max",
        "angle_min",
        "angle_increment",
        "time_increment",
    ),
    PacketType.POINTS_2D: (
        "range_min",
        "range_max",
        "angle_min",
        "angle_increment",
        "time_increment",
    ),
    PacketType.IMU: ("quaternion_wxyz", "angular_velocity", "linear_acceleration"),
}
"""Floats without which a measurement is worth nothing; for points also the calibration block."""


def flip_bit(frame: bytes, random: np.random.Generator) -> bytes:
    """Flip one bit of the payload."""
    damaged = bytearray(frame)
    at = int(random.integers(wire.HEADER.size, len(frame) - wire.TAIL.size))
    damaged[at] ^= 1 << int(random.integers(8))
    return bytes(damaged)


def truncate(frame: bytes, random: np.random.Generator) -> bytes:
    """Cut off the end, at least CRC and tail: tails are alike, others might complete it."""
    return frame[: int(random.integers(1, len(frame) - wire.TAIL.size + 1))]


def hostile_size(frame: bytes, random: np.random.Generator) -> bytes:
    """Replace the size field by one of :data:`HOSTILE_SIZES`."""
    size = HOSTILE_SIZES[int(random.integers(len(HOSTILE_SIZES)))]
    return frame[:8] + size.to_bytes(4, "little") + frame[12:]


def hostile_count(frame: bytes, random: np.random.Generator) -> bytes | None:
    """Claim one point more than there is room for, or 2^32-1 points; points only."""
    packet_type = _type(frame)
    if packet_type not in (PacketType.POINTS_3D, PacketType.POINTS_2D):
        return None
    payload = np.frombuffer(_payload(frame), wire.PAYLOADS[packet_type]).copy()
    room = payload.dtype["ranges"].shape[0]
    payload["point_num"] = (room + 1, 0xFFFF_FFFF)[int(random.integers(2))]
    return _sealed(frame, payload.tobytes())


def not_a_number(frame: bytes, random: np.random.Generator) -> bytes | None:
    """Make one float of a measurement NaN or infinite; points and IMU only."""
    packet_type = _type(frame)
    if packet_type not in _VITAL:
        return None
    payload = np.frombuffer(_payload(frame), wire.PAYLOADS[packet_type]).copy()
    names = list(_VITAL[PacketType(packet_type)])
    block = payload
    if packet_type != PacketType.IMU:
        names += list(wire.CALIBRATION.names or ())
    name = names[int(random.integers(len(names)))]
    if name not in (payload.dtype.names or ()):
        block = payload["calibration"]
    column = block[name].reshape(-1)
    column[int(random.integers(len(column)))] = (np.nan, np.inf, -np.inf)[int(random.integers(3))]
    return _sealed(frame, payload.tobytes())


DAMAGES: Final[dict[Fault, Damage]] = {
    Fault.BAD_CRC: flip_bit,
    Fault.TRUNCATE: truncate,
    Fault.HOSTILE_SIZE: hostile_size,
    Fault.HOSTILE_COUNT: hostile_count,
    Fault.NAN: not_a_number,
}
"""Damage by fault, in the order in which they are applied."""


def junk(random: np.random.Generator) -> bytes:
    """Return bytes that are no packet, at times ending in the beginning of one."""
    noise = random.bytes(int(random.integers(1, 200)))
    endings = (
        b"",
        wire.MAGIC[:1],
        wire.MAGIC,
        wire.HEADER.pack(wire.MAGIC, PacketType.POINTS_3D, wire.FRAME_SIZES[PacketType.POINTS_3D]),
    )
    return noise.replace(wire.MAGIC[:1], b"\x00") + endings[int(random.integers(len(endings)))]


def _type(frame: bytes) -> int:
    return int.from_bytes(frame[4:8], "little")


def _payload(frame: bytes) -> bytes:
    return frame[wire.HEADER.size : -wire.TAIL.size]


def _sealed(frame: bytes, payload: bytes) -> bytes:
    """Return a frame with another payload and the CRC that belongs to it."""
    crc = zlib.crc32(payload).to_bytes(4, "little")
    return frame[: wire.HEADER.size] + payload + crc + frame[len(frame) - wire.TAIL.size + 4 :]
