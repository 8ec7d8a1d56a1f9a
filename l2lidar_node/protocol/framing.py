"""Framer: byte stream to frames and frame errors; bounded and resynchronizing.

The stream is what one sender puts into datagrams (or onto a serial line). Frames may be coalesced,
split at any byte, damaged, or have garbage between them. The rules:

* a bad frame gives up one byte and the search for the next magic starts there, so it costs itself
  only;
* a datagram that begins with a magic and ends with a frame is taken as it is, even while an
  earlier frame is incomplete: one whose fragments have another packet between them completes;
* good frames behind an incomplete one are taken out at once, so the stub of a truncated frame
  delays nothing, however much it claims;
* less than one maximal frame is ever held back.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

from l2lidar_node.protocol import wire
from l2lidar_node.types import new_tuple

_HEADER_SIZE: Final = wire.HEADER.size
_TAIL_SIZE: Final = wire.TAIL.size
_ELASTIC: Final = frozenset({int(wire.PacketType.PARAMETERS)})
"""Known types whose size differs between firmware versions."""
_MAX_MISSES: Final = 8
_WHOLE: Final = {
    wire.HEADER.pack(wire.MAGIC, packet_type, size): (
        packet_type,
        struct.Struct(f"<{_HEADER_SIZE}x{size - wire.OVERHEAD}sI6x2s"),
    )
    for packet_type, size in wire.FRAME_SIZES.items()
}
"""Packet type and layout of a whole frame (payload, crc, end mark) by its header."""


class Fault(Enum):
    """Why bytes did not become a frame."""

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
    """Bytes that were discarded.

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

    Whatever the bytes are and however they are cut, nothing is raised, less than
    :data:`wire.MAX_FRAME` bytes are kept for the next call, and the time taken is bounded by the
    number of bytes and calls.
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
            whole = _WHOLE.get(data[:_HEADER_SIZE])
            if whole is not None and len(data) == whole[1].size:  # as nearly all are
                packet_type, layout = whole
                payload, crc, end = layout.unpack(data)
                if end == wire.TAIL_END and crc == zlib.crc32(payload):
                    return [new_tuple(Frame, (packet_type, payload))]
        elif data.startswith(wire.MAGIC):
            events, rest = _parse(data)
            if not rest:
                return events
        events, self._pending = _parse(self._pending + data)
        return events

    def reset(self) -> None:
        """Forget an incomplete frame, for example when the sender restarted."""
        self._pending = b""


def _parse(data: bytes) -> tuple[list[FramingEvent], bytes]:
    """Return the events in ``data`` and the rest, the beginning of a frame."""
    events: list[FramingEvent] = []
    at = 0
    while at < len(data):
        if not data.startswith(wire.MAGIC, at):
            start = _next_magic(data, at)
            if start == at:
                break  # a piece of a magic at the very end
            events.append(FrameError(Fault.JUNK, start - at))
            at = start
            continue
        found = _frame_at(data, at)
        if found is None:
            return events, _take_out(data, at, events)
        if isinstance(found, Frame):
            events.append(found)
            at += len(found.payload) + wire.OVERHEAD
        else:
            start = _next_magic(data, at + 1)
            events.append(FrameError(found, start - at))
            at = start
    return events, data[at:]


def _take_out(data: bytes, at: int, events: list[FramingEvent]) -> bytes:
    """Move the good frames behind the incomplete one at ``at`` to the events; return the rest.

    Real streams have one or two magics there that begin no good frame; more are not worth the
    time.
    """
    rest = b""
    begin = at
    misses = 0
    at = data.find(wire.MAGIC, at + 1)
    while at >= 0 and misses < _MAX_MISSES:
        found = _frame_at(data, at)
        if isinstance(found, Frame):
            events.append(found)
            rest += data[begin:at]
            begin = at + len(found.payload) + wire.OVERHEAD
        else:
            misses += 1
        at = data.find(wire.MAGIC, max(at + 1, begin))
    return rest + data[begin:]


def _frame_at(data: bytes, at: int) -> Frame | Fault | None:
    """Return the frame that begins here, or its error; None if it is incomplete."""
    if len(data) - at < _HEADER_SIZE:
        return None
    _, packet_type, size = wire.HEADER.unpack_from(data, at)
    if not _plausible(packet_type, size):
        return Fault.SIZE
    end = at + size
    if end > len(data):
        return None
    if data[end - 2 : end] != wire.TAIL_END:
        return Fault.TAIL
    payload = data[at + _HEADER_SIZE : end - _TAIL_SIZE]
    if zlib.crc32(payload) != wire.TAIL.unpack_from(data, end - _TAIL_SIZE)[0]:
        return Fault.CRC
    return Frame(packet_type, payload)


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
