"""Turns the bytes a unit receives into commands, and into errors where they are none; bounded."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import Final, NamedTuple

from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import AckStatus

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
