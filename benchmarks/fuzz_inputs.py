"""Hostile input: bytes changed at random, and clouds with hostile sizes, fields and data."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from l2lidar_node.clouds import points_of
from l2lidar_node.protocol import wire
from l2lidar_node.types import HostNs
from l2lidar_proc.cloud import to_sweep

_NUMBERS: Final = tuple(
    struct.pack("<I", number)
    for number in (0, 1, 12, 24, 25, 300, 301, 1800, 1801, 6000, 6001, 10_001, 2**31, 2**32 - 1)
) + tuple(
    struct.pack("<f", number)
    for number in (float("nan"), float("inf"), -float("inf"), 3e38, -1e6, 1e-45)
)  # fmt: skip
_LONGEST: Final = 16_384


def mutations(seeds: Sequence[bytes], tokens: Sequence[bytes], seed: int) -> Iterator[bytes]:
    """Yield changed seeds without end, none longer than 16 KiB.

    Parameters
    ----------
    seeds : sequence of bytes
        Good inputs.
    tokens : sequence of bytes
        Pieces that mean something to the reader.
    seed : int
        Everything random follows from it.
    """
    rng = random.Random(seed)
    strokes = _strokes(rng, seeds, (*tokens, *_NUMBERS))
    pick, chance = rng.choice, rng.random
    while True:
        data = bytearray(pick(seeds))
        pick(strokes)(data)
        while chance() < 0.4:
            pick(strokes)(data)
        yield bytes(data[:_LONGEST])


def _strokes(
    rng: random.Random, seeds: Sequence[bytes], tokens: Sequence[bytes]
) -> list[Callable[[bytearray], None]]:
    def place(data: bytearray) -> int:
        return int(rng.random() * (len(data) + 1))

    def flip(data: bytearray) -> None:
        if data:
            data[int(rng.random() * len(data))] ^= 1 << rng.getrandbits(3)

    def byte(data: bytearray) -> None:
        if data:
            data[int(rng.random() * len(data))] = rng.getrandbits(8)

    def number(data: bytearray) -> None:
        at = place(data) & ~3  # where the numbers of most formats begin
        data[at : at + 4] = rng.choice(tokens)

    def insert(data: bytearray) -> None:
        at = place(data)
        data[at:at] = rng.choice(tokens)

    def cut(data: bytearray) -> None:
        del data[place(data) :]

    def drop(data: bytearray) -> None:
        at = place(data)
        del data[at : at + 1 + rng.getrandbits(4)]

    def double(data: bytearray) -> None:
        at = place(data)
        data[at:at] = data[at : at + 1 + rng.getrandbits(6)]

    def noise(data: bytearray) -> None:
        at = place(data)
        data[at:at] = rng.randbytes(1 + rng.getrandbits(4))

    def join(data: bytearray) -> None:
        other = rng.choice(seeds)
        data[place(data) :] = other[int(rng.random() * len(other)) :]

    return [flip, flip, byte, number, number, insert, cut, drop, double, noise, join]


def sealed(data: bytes) -> bytes:
    """Return a frame with size, checksum and end mark made right, so that its content counts."""
    if len(data) < wire.OVERHEAD:
        return data
    frame = bytearray(data)
    payload = memoryview(frame)[wire.HEADER.size : -wire.TAIL.size]
    packet_type = wire.HEADER.unpack_from(frame)[1]
    wire.HEADER.pack_into(frame, 0, wire.MAGIC, packet_type, len(frame))
    wire.TAIL.pack_into(
        frame, len(frame) - wire.TAIL.size, zlib.crc32(payload), 0, b"\0\0", wire.TAIL_END
    )
    return bytes(frame)


_STAMP_NS: Final = 1_700_000_000 * 10**9
_CLOUD: Final = struct.Struct("<4I2B")
_FIELD: Final = struct.Struct("<sIBI")


def plain() -> list[bytes]:
    """Return small clouds without times."""

    def cloud(height: int, width: int, fields: list[tuple[bytes, int, int, int]]) -> bytes:
        head = _CLOUD.pack(height, width, 24, 24 * width, 0, len(fields))
        return head + b"".join(_FIELD.pack(*item) for item in fields) + bytes(24 * width * height)

    xyz = [(b"x", 0, 7, 1), (b"y", 4, 7, 1), (b"z", 8, 7, 1)]
    return [cloud(1, 5, xyz), cloud(3, 2, [*xyz, (b"t", 12, 8, 1), (b"i", 20, 4, 2)])]


def timed() -> list[bytes]:
    """Return clouds of 20 points with times in seconds or nanoseconds, one of them with a gap."""
    kinds = {7: "<f4", 8: "<f8", 6: "<u4"}
    made = []
    for kind, scale, padding in ((7, 1.0, 0), (8, 1.0, 4), (6, 1e9, 0)):
        layout = np.dtype(
            {
                "names": ["x", "y", "z", "t"],
                "formats": ["<f4", "<f4", "<f4", kinds[kind]],
                "offsets": [0, 4, 8, 12],
                "itemsize": 12 + np.dtype(kinds[kind]).itemsize + padding,
            }
        )
        points = np.zeros(20, layout)
        points["x"] = np.linspace(1.0, 2.0, 20)
        points["t"] = np.linspace(0.0, 0.1, 20) * scale
        fields = [(b"x", 0, 7, 1), (b"y", 4, 7, 1), (b"z", 8, 7, 1), (b"t", 12, kind, 1)]
        head = _CLOUD.pack(1, 20, layout.itemsize, points.nbytes, 0, len(fields))
        made.append(head + b"".join(_FIELD.pack(*item) for item in fields) + points.tobytes())
    return made


def _parts(data: bytes) -> tuple[dict[str, Any], list[dict[str, Any]]] | None:
    """Return the values of a cloud and of its fields by name; None of too few bytes."""
    if len(data) < _CLOUD.size:
        return None
    height, width, step, row_step, order, count = _CLOUD.unpack_from(data)
    end = min(_CLOUD.size + count * _FIELD.size, len(data))
    end -= (end - _CLOUD.size) % _FIELD.size
    fields = [
        {"name": name.decode("latin-1"), "offset": at, "datatype": kind, "count": number}
        for name, at, kind, number in _FIELD.iter_unpack(data[_CLOUD.size : end])
    ]
    cloud = {
        "height": height, "width": width, "point_step": step, "row_step": row_step,
        "is_bigendian": bool(order & 1), "data": data[end:],
    }  # fmt: skip
    return cloud, fields


def fields() -> Callable[[bytes], None]:
    """Check the reader of fields and points, whoever deserialised the message."""

    def check(data: bytes) -> None:
        parts = _parts(data)
        if parts is None:
            return
        values, items = parts
        message = SimpleNamespace(fields=[SimpleNamespace(**item) for item in items], **values)
        try:
            points = points_of(message)
        except ValueError:
            return
        wanted = (values["height"] * values["width"],)
        assert points.shape == wanted, "not as many points as the cloud says"

    return check


def message() -> Callable[[bytes], None]:
    """Check what the nodes do with a cloud: read the ROS message, put its points in order."""
    from sensor_msgs.msg import PointCloud2, PointField

    from l2lidar_node.ros.conversions import from_cloud

    def check(data: bytes) -> None:
        parts = _parts(data)
        if parts is None:
            return
        values, items = parts
        message = PointCloud2(fields=[PointField(**item) for item in items], **values)
        try:
            points = from_cloud(message)
            assert points.shape == (message.height * message.width,), "not as many points"
            sweep = to_sweep(points, HostNs(_STAMP_NS))
        except ValueError:
            return
        times = sweep.points["time"]
        assert len(times), "a sweep without points"
        assert np.isfinite(times).all(), "a time is not finite"
        assert (np.diff(times) >= 0).all(), "times of points fall"
        assert sweep.start <= _STAMP_NS <= sweep.end or sweep.start < sweep.end, "no time passes"

    return check
