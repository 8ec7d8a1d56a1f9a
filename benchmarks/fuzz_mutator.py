"""Changes inputs at random: bits, bytes, numbers, pieces and joints, cheaply and reproducibly."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from l2lidar_node.protocol import wire

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
