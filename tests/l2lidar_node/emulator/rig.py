"""What the tests of the virtual unit share: a unit on the bench, and a reader of byte streams.

The reader is written from the protocol alone and knows nothing of the driver.
"""

from __future__ import annotations

import dataclasses
import struct
import zlib
from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from l2lidar_node.emulator.config import DeviceConfig, PowerConfig
from l2lidar_node.emulator.truth import PacketLog
from l2lidar_node.emulator.unit.device import Link, VirtualL2
from l2lidar_node.emulator.unit.firmware import Flash
from l2lidar_node.emulator.unit.stream import PatternScanner, StillInertial
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType

S = 1_000_000_000
MS = 1_000_000
READY = PowerConfig(boot_scale=0.0)
SIZES = {102: 1044, 103: 5536, 104: 80, 105: 104, 101: 40, 2001: 196}


class Frame(NamedTuple):
    packet_type: int
    payload: bytes


def read(stream: bytes) -> list[Frame]:
    """Return every good frame of a stream, as patiently as can be."""
    frames = []
    at = stream.find(wire.MAGIC)
    while at >= 0:
        frame = _frame_at(stream, at)
        if frame is not None:
            frames.append(frame)
        at = stream.find(wire.MAGIC, at + (1 if frame is None else SIZES[frame.packet_type]))
    return frames


def _frame_at(stream: bytes, at: int) -> Frame | None:
    if len(stream) < at + 12:
        return None
    packet_type, size = struct.unpack_from("<II", stream, at + 4)
    if SIZES.get(packet_type) != size or len(stream) < at + size:
        return None
    payload = stream[at + 12 : at + size - 12]
    (crc,) = struct.unpack_from("<I", stream, at + size - 12)
    if crc != zlib.crc32(payload) or stream[at + size - 2 : at + size] != b"\x00\xff":
        return None
    return Frame(packet_type, payload)


def is_sane(frame: Frame) -> bool:
    """Whether a frame with the right CRC also says something that can be used."""
    if frame.packet_type == PacketType.IMU:
        return bool(np.isfinite(np.frombuffer(frame.payload, "<f4", offset=16)).all())
    if frame.packet_type in (PacketType.POINTS_3D, PacketType.POINTS_2D):
        row = np.frombuffer(frame.payload, wire.PAYLOADS[frame.packet_type])[0]
        numbers = [float(row[name]) for name in row.dtype.names if row.dtype[name] == np.float32]
        numbers += [float(value) for value in row["calibration"].tolist()]
        return bool(row["point_num"] <= len(row["ranges"]) and np.isfinite(numbers).all())
    return True


def identity(frame: Frame) -> tuple[int, int, int]:
    """Return type, sequence number and stamp [ns]; zeros for answers."""
    if frame.packet_type not in (102, 103, 104):
        return frame.packet_type, 0, 0
    seq, _, sec, nsec = struct.unpack_from("<4I", frame.payload)
    return frame.packet_type, seq, sec * S + nsec


def identities(datagrams: Iterable[tuple[int, bytes]]) -> Counter[tuple[int, int, int]]:
    """Return how often a good reader gets which usable packet."""
    stream = b"".join(data for _, data in datagrams)
    return Counter(identity(frame) for frame in read(stream) if is_sane(frame))


def booked(device: VirtualL2) -> Counter[tuple[int, int, int]]:
    """Return how often the packet log says which packet arrived."""
    counts: Counter[tuple[int, int, int]] = Counter()
    for row in device.packet_log.packets:
        if row["copies"]:
            counts[(int(row["type"]), int(row["seq"]), int(row["stamp_ns"]))] += int(row["copies"])
    return counts


def acks(frames: Iterable[Frame]) -> list[tuple[int, int, int, int]]:
    """Return packet type, command, value and status of every acknowledgement."""
    return [struct.unpack("<4I", frame.payload) for frame in frames if frame.packet_type == 101]


def command(packet_type: int, *words: int) -> bytes:
    return wire.encode_frame(packet_type, struct.pack(f"<{len(words)}I", *words))


class Bench:
    """A unit with a pattern before it, and hands on the clock."""

    def __init__(
        self,
        config: DeviceConfig | None = None,
        *,
        flash: Flash | None = None,
        link: Link = Link.ETHERNET,
        power_on_ns: int = 0,
        packet_log: PacketLog | None = None,
        **groups: Any,
    ) -> None:
        config = dataclasses.replace(config or DeviceConfig(power=READY), **groups)
        self.device = VirtualL2(
            config,
            PatternScanner(),
            StillInertial(),
            flash=flash,
            link=link,
            power_on_ns=power_on_ns,
            packet_log=packet_log,
        )
        self.now = power_on_ns
        self.log: list[tuple[int, bytes]] = []

    def run(self, seconds: float) -> list[tuple[int, bytes]]:
        """Let time go by and return the datagrams."""
        before, self.now = self.now, self.now + round(seconds * S)
        new = self.device.advance(self.now)
        times = [time for time, _ in new]
        assert times == sorted(times)
        assert all(before <= time <= self.now for time in times), "neither late nor early"
        self.log += new
        return new

    def frames(self, seconds: float) -> list[Frame]:
        """Let time go by and return the good frames of that time."""
        return read(b"".join(data for _, data in self.run(seconds)))

    def ask(self, data: bytes) -> list[Frame]:
        """Send bytes and return the answers that come within 1 ms."""
        self.device.command(data, self.now)
        return [frame for frame in self.frames(0.001) if frame.packet_type in (101, 105, 2001)]

    def count(self, seconds: float) -> Counter[int]:
        """Let time go by and return how many packets of each type came."""
        return Counter(frame.packet_type for frame in self.frames(seconds))
