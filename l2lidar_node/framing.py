"""Turns a byte stream cut anywhere into frames and frame errors; bounded and resynchronising.

The stream is what one sender puts into datagrams (or onto a serial line). Frames may be coalesced, split at
any byte, damaged, or have garbage between them. The rules:

* a bad frame gives up one byte and the search for the next magic starts there, so it costs itself only;
* a datagram that consists of whole good frames is taken as it is, even while an earlier frame is still
  incomplete: the stub of a truncated frame delays nothing, and a frame whose fragments have another
  packet between them still completes;
* no more than one maximal frame is ever held back.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

from l2lidar_node import wire

_HEADER_SIZE: Final = wire.HEADER.size
_TAIL_SIZE: Final = wire.TAIL.size
_ELASTIC: Final = frozenset({int(wire.PacketType.PARAMETERS)})
"""Known types whose size differs between firmware versions."""


class Fault(Enum):
    """What was wrong with bytes that did not become a frame."""

    JUNK = "junk"  # bytes that belong to no frame
    SIZE = "size"  # a size field that cannot be true
    TAIL = "tail"  # the end mark is missing where the size field says
    CRC = "crc"  # the checksum does not match the payload


class Frame(NamedTuple):
    """A frame whose size, end mark and checksum are right."""

    packet_type: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class FrameError:
    """Bytes that were given up.

    Attributes
    ----------
    fault : Fault
    skipped : int
        Bytes given up, up to the next magic.
    """

    fault: Fault
    skipped: int


FramingEvent = Frame | FrameError


class Framer:
    """Cuts one sender's byte stream into frames.

    The frames do not depend on how the stream was cut into datagrams. Whatever the bytes are, nothing is
    raised and at most :data:`wire.MAX_FRAME` bytes are kept for the next call.
    """

    def __init__(self) -> None:
        self._pending = b""

    @property
    def pending(self) -> int:
        """Bytes held back because their frame is not complete yet."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[FramingEvent]:
        """Return the frames and errors that these bytes complete, in order."""
        if not self._pending:
            events, consumed = _parse(data)
            self._pending = data[consumed:]
            return events
        events, consumed = _parse(data)
        if consumed == len(data) and all(type(event) is Frame for event in events):
            return events
        data = self._pending + data
        events, consumed = _parse(data)
        self._pending = data[consumed:]
        return events

    def reset(self) -> None:
        """Forget an incomplete frame, for example when the sender restarted."""
        self._pending = b""


def _parse(data: bytes) -> tuple[list[FramingEvent], int]:
    """Return the events in ``data`` and how many bytes they account for; the rest is incomplete."""
    events: list[FramingEvent] = []
    end = len(data)
    at = 0
    while at < end:
        if not data.startswith(wire.MAGIC, at):
            start = _next_magic(data, at)
            if start > at:
                events.append(FrameError(Fault.JUNK, start - at))
                at = start
                continue
            break  # a piece of a magic at the very end
        if end - at < _HEADER_SIZE:
            break
        _, packet_type, size = wire.HEADER.unpack_from(data, at)
        fault: Fault
        if not _plausible(packet_type, size):
            fault = Fault.SIZE
        elif end - at < size:
            break
        elif data[at + size - 2 : at + size] != wire.TAIL_END:
            fault = Fault.TAIL
        else:
            payload = data[at + _HEADER_SIZE : at + size - _TAIL_SIZE]
            crc = wire.TAIL.unpack_from(data, at + size - _TAIL_SIZE)[0]
            if zlib.crc32(payload) == crc:
                events.append(Frame(packet_type, payload))
                at += size
                continue
            fault = Fault.CRC
        start = _next_magic(data, at + 1)
        events.append(FrameError(fault, start - at))
        at = start
    return events, at


def _plausible(packet_type: int, size: int) -> bool:
    expected = wire.FRAME_SIZES.get(packet_type)
    if expected is None or packet_type in _ELASTIC:
        return wire.OVERHEAD < size <= wire.MAX_FRAME
    return size == expected


def _next_magic(data: bytes, at: int) -> int:
    """Return where the next magic, or a piece of one that the data end in, begins."""
    found = data.find(wire.MAGIC, at)
    if found >= 0:
        return found
    for length in range(min(len(wire.MAGIC) - 1, len(data) - at), 0, -1):
        if data.endswith(wire.MAGIC[:length]):
            return len(data) - length
    return len(data)
