"""Reads and writes the container of captured packets: pcap and pcapng, times in whole nanoseconds.

Formats: draft-ietf-opsawg-pcap and draft-ietf-opsawg-pcapng. What stands in a packet is left to
:mod:`l2lidar_node.recording.capture`.
"""

from __future__ import annotations

import errno
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from l2lidar_node.types import HostNs

SUFFIXES: Final = (".pcap", ".pcapng", ".cap")
"""Endings of names that captures have."""

_NS: Final = 1_000_000_000
_MICRO: Final = 0xA1B2C3D4
_NANO: Final = 0xA1B23C4D
_MAX_PACKET: Final = 1 << 18
_MAX_BLOCK: Final = 1 << 26  # other programs put names and keys into blocks of their own

_SECTION: Final = 0x0A0D0D0A
_ORDER: Final = 0x1A2B3C4D
_INTERFACE: Final = 1
_SIMPLE_PACKET: Final = 3
_ENHANCED_PACKET: Final = 6
_TIME_RESOLUTION: Final = 9
_TIME_OFFSET: Final = 14


class CaptureError(ValueError):
    """A file that is no capture, or one that cannot be used; the message says why."""


def is_capture(start: bytes) -> bool:
    """Tell from its first four bytes whether a file is a capture that can be read."""
    if len(start) < 4:
        return False
    numbers = {struct.unpack_from(f"{order}I", start)[0] for order in "<>"}
    return bool(numbers & {_MICRO, _NANO, _SECTION})


def is_capture_file(path: Path) -> bool:
    """Tell whether a file is a capture, or is called one: then its reader says what it lacks."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return is_capture(stream.read(4)) or path.suffix in SUFFIXES


class RawPacket(NamedTuple):
    """One captured packet.

    Attributes
    ----------
    time : HostNs
    link : int
        Number of its link layer (``LINKTYPE_...``).
    data : bytes
        From the link layer's header on.
    is_whole : bool
        False when the capture keeps only its beginning.
    """

    time: HostNs
    link: int
    data: bytes
    is_whole: bool


class _CutOffError(Exception):
    """The file ends within a packet."""


class PacketReader:
    """Iterates over the packets of a file from where it stands.

    Parameters
    ----------
    stream : binary file

    Attributes
    ----------
    is_cut_off : bool
        Whether the file ended within a packet, as it does when whoever wrote it was killed.
    untimed : int
        Packets left out because the file does not say when they came.

    Raises
    ------
    CaptureError
        While iterating, if this is no capture or its structure is damaged.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self.is_cut_off = False
        self.untimed = 0
        self._stream = stream

    def __iter__(self) -> Iterator[RawPacket]:
        """Yield the packets in the order of the file."""
        magic = self._stream.read(4)
        try:
            if int.from_bytes(magic, "big") == _SECTION:
                yield from self._pcapng()
                return
            for order in "<>":
                if len(magic) == 4 and struct.unpack(f"{order}I", magic)[0] in (_MICRO, _NANO):
                    yield from self._pcap(order, magic)
                    return
        except _CutOffError:
            self.is_cut_off = True
            return
        raise CaptureError("not a capture file (neither pcap nor pcapng)")

    def _pcap(self, order: str, magic: bytes) -> Iterator[RawPacket]:
        unit = 1 if struct.unpack(f"{order}I", magic)[0] == _NANO else 1000
        *_, link = struct.unpack(f"{order}2H4I", self._take(20))
        record = struct.Struct(f"{order}4I")
        while head := self._stream.read(record.size):
            if len(head) < record.size:
                raise _CutOffError
            seconds, fraction, size, original = record.unpack(head)
            if size > _MAX_PACKET:
                raise CaptureError(f"damaged: a packet claims {size} bytes")
            data = self._take(size)
            time = HostNs(seconds * _NS + fraction * unit)
            yield RawPacket(time, link & 0xFFFF, data, size >= original)

    def _pcapng(self) -> Iterator[RawPacket]:
        interfaces: list[_Interface] = []
        kind: int = _SECTION
        order = "<"
        while True:
            if kind == _SECTION:
                size_field, mark = self._take(4), self._take(4)
                order = "<" if struct.unpack("<I", mark)[0] == _ORDER else ">"
                interfaces = []
                self._body(struct.unpack(f"{order}I", size_field)[0], 4)
            else:
                body = self._body(struct.unpack(f"{order}I", self._take(4))[0])
                if kind == _INTERFACE:
                    interfaces.append(_Interface.parse(body, order))
                elif kind == _SIMPLE_PACKET:
                    self.untimed += 1
                elif kind == _ENHANCED_PACKET:
                    yield _enhanced(body, order, interfaces)
            head = self._stream.read(4)
            if not head:
                return
            if len(head) < 4:
                raise _CutOffError
            kind = struct.unpack(f"{order}I", head)[0]

    def _body(self, size: int, taken: int = 0) -> bytes:
        """Return the rest of a block of this size, without its second size field."""
        rest = size - 8 - taken
        if size % 4 or not 4 <= rest <= _MAX_BLOCK:
            raise CaptureError(f"damaged: a block claims {size} bytes")
        return self._take(rest)[:-4]

    def _take(self, size: int) -> bytes:
        data = self._stream.read(size)
        if len(data) < size:
            raise _CutOffError
        return data


class _Interface(NamedTuple):
    """Where packets of a pcapng file came from, and what its times count."""

    link: int
    ticks_per_s: int
    offset_s: int

    @classmethod
    def parse(cls, body: bytes, order: str) -> _Interface:
        if len(body) < 8:
            raise CaptureError("damaged: an interface description is too short")
        link = struct.unpack_from(f"{order}H", body)[0]
        ticks, offset = 1_000_000, 0
        at = 8
        while at + 4 <= len(body):
            code, length = struct.unpack_from(f"{order}2H", body, at)
            value = body[at + 4 : at + 4 + length]
            if len(value) < length:
                raise CaptureError("damaged: an interface description contradicts itself")
            if code == _TIME_RESOLUTION and length == 1:
                ticks = 1 << (value[0] & 0x7F) if value[0] & 0x80 else int(10 ** value[0])
            elif code == _TIME_OFFSET and length == 8:
                offset = struct.unpack(f"{order}q", value)[0]
            at += 4 + length + -length % 4
        return cls(link, ticks, offset)


def _enhanced(body: bytes, order: str, interfaces: list[_Interface]) -> RawPacket:
    if len(body) < 20:
        raise CaptureError("damaged: a packet block is too short")
    number, high, low, size, original = struct.unpack_from(f"{order}5I", body)
    if number >= len(interfaces) or size > len(body) - 20:
        raise CaptureError("damaged: a packet block contradicts itself")
    interface = interfaces[number]
    seconds, ticks = divmod(high << 32 | low, interface.ticks_per_s)
    time = (seconds + interface.offset_s) * _NS + ticks * _NS // interface.ticks_per_s
    return RawPacket(HostNs(time), interface.link, body[20 : 20 + size], size >= original)


class PacketWriter:
    """Writes a pcap file whose times are nanoseconds.

    Parameters
    ----------
    stream : binary file
        At its beginning.
    link : int
        Number of the packets' link layer.
    """

    _RECORD = struct.Struct("<4I")

    def __init__(self, stream: BinaryIO, link: int) -> None:
        self._stream = stream
        stream.write(struct.pack("<I2H4I", _NANO, 2, 4, 0, 0, _MAX_PACKET, link))

    def write(self, time: HostNs, data: bytes) -> None:
        """Append a packet.

        Raises
        ------
        OSError
            If it cannot be written, or its time is not from 1970 to 2106.
        """
        seconds, fraction = divmod(time, _NS)
        if not 0 <= seconds < 1 << 32:
            raise OSError(errno.EOVERFLOW, "a capture holds times from 1970 to 2106")
        self._stream.write(self._RECORD.pack(seconds, fraction, len(data), len(data)) + data)
