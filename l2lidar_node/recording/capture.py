"""Reads and writes captures of UDP datagrams, pcap and pcapng, as tcpdump and Wireshark do.

Formats: draft-ietf-opsawg-pcap and draft-ietf-opsawg-pcapng.
"""

from __future__ import annotations

import errno
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import dpkt

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
    """A file that is not a usable capture; the message says why."""


def is_capture(start: bytes) -> bool:
    """Tell from its first four bytes whether a file is a capture that can be read."""
    if len(start) < 4:
        return False
    numbers = {struct.unpack_from(f"{order}I", start)[0] for order in "<>"}
    return bool(numbers & {_MICRO, _NANO, _SECTION})


def is_capture_file(path: Path) -> bool:
    """Tell whether a file is a capture by content or name."""
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
    """Iterates over the packets of a file from its present position.

    Parameters
    ----------
    stream : binary file

    Attributes
    ----------
    is_cut_off : bool
        Whether the file ended within a packet, as after its writer was killed.
    untimed : int
        Packets left out because the file does not say when they came.

    Raises
    ------
    CaptureError
        While iterating, if this is not a capture or its structure is damaged.
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
    """An interface of a pcapng file: link type and time resolution."""

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
            raise OSError(
                errno.EOVERFLOW, "the time does not fit a capture, which holds 1970 to 2106"
            )
        self._stream.write(self._RECORD.pack(seconds, fraction, len(data), len(data)) + data)


_ETHERNET: Final = 1
_OUTGOING: Final = 4  # of a cooked capture's packet types
_INCOMING: Final = 0
_MAC: Final = b"\x02\x00"  # locally administered, the IPv4 address follows
_MAX_PAYLOAD: Final = 65_507
_CHECKSUM: Final = struct.Struct(">H")
_SUMMED: Final = struct.Struct("<H")  # dpkt sums words of this order up


class Endpoint(NamedTuple):
    """Address and port of one end of a conversation."""

    ip: str
    port: int

    def __str__(self) -> str:
        """Return it as people write it."""
        return f"{self.ip}:{self.port}"


class UdpDatagram(NamedTuple):
    """A datagram as it was seen on the network.

    Attributes
    ----------
    time : HostNs
    source, destination : Endpoint
    data : bytes
    outgoing : bool or None
        Whether the capturing machine sent it; None where the capture does not say so.
    """

    time: HostNs
    source: Endpoint
    destination: Endpoint
    data: bytes
    outgoing: bool | None = None


class CaptureReader:
    """Iterates over the UDP datagrams of a capture; everything else in it is counted.

    Parameters
    ----------
    stream : binary file
        pcap or pcapng, at its beginning.

    Attributes
    ----------
    ignored : Counter
        What was left out, by reason: ``not UDP over IPv4``, ``fragmented``, ``cut short``,
        ``damaged``, ``without a time``.
    is_cut_off : bool
        Whether the file ended within a packet.

    Raises
    ------
    CaptureError
        While iterating, if this is not a capture.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self.ignored: Counter[str] = Counter()
        self._packets = PacketReader(stream)

    @property
    def is_cut_off(self) -> bool:
        """Whether the file ended within a packet."""
        return self._packets.is_cut_off

    def __iter__(self) -> Iterator[UdpDatagram]:
        """Yield the datagrams in the order of the file."""
        for packet in self._packets:
            dissect = _LINKS.get(packet.link)
            if dissect is None:
                self.ignored[f"of link type {packet.link}"] += 1
                continue
            try:
                network, outgoing = dissect(packet.data)
            except (dpkt.UnpackError, IndexError, ValueError):
                self.ignored["damaged"] += 1
                continue
            found = _udp(network)
            if isinstance(found, str):
                self.ignored["cut short" if not packet.is_whole else found] += 1
                continue
            source, destination, data = found
            yield UdpDatagram(packet.time, source, destination, data, outgoing)
        if self._packets.untimed:
            self.ignored["without a time"] = self._packets.untimed


class CaptureWriter:
    """Writes datagrams to a standard pcap file.

    Ethernet, IPv4 and UDP headers are made up around them, with right lengths and checksums.

    Parameters
    ----------
    stream : binary file
        At its beginning.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._packets = PacketWriter(stream, _ETHERNET)

    def write(self, datagram: UdpDatagram) -> None:
        """Append a datagram.

        Raises
        ------
        ValueError
            If it is longer than UDP allows.
        """
        if len(datagram.data) > _MAX_PAYLOAD:
            raise ValueError(f"{len(datagram.data)} bytes do not fit a UDP datagram")
        headers, so_far = _headers(datagram.source, datagram.destination, len(datagram.data))
        checksum = dpkt.in_cksum_done(dpkt.in_cksum_add(so_far, datagram.data))
        frame = headers + _CHECKSUM.pack(checksum or 0xFFFF) + datagram.data
        self._packets.write(datagram.time, frame)


@lru_cache(maxsize=256)
def _headers(source: Endpoint, destination: Endpoint, size: int) -> tuple[bytes, int]:
    """Return the headers of a datagram, made once for each of the few sizes that there are.

    Returns
    -------
    bytes
        All but the UDP checksum, which is the last field.
    int
        What that checksum covers apart from the content, summed up.
    """
    ends = [bytes(map(int, end.ip.split("."))) for end in (source, destination)]
    udp = dpkt.udp.UDP(sport=source.port, dport=destination.port, ulen=8 + size, data=bytes(size))
    network = dpkt.ip.IP(src=ends[0], dst=ends[1], p=dpkt.ip.IP_PROTO_UDP, data=udp)
    frame = dpkt.ethernet.Ethernet(
        src=_MAC + ends[0], dst=_MAC + ends[1], type=dpkt.ethernet.ETH_TYPE_IP, data=network
    )
    headers = bytes(frame)[: len(frame) - size]
    (checksum,) = _SUMMED.unpack(headers[-2:])
    return headers[:-2], ~checksum & 0xFFFF


_Dissected = tuple[Any, bool | None]


def _ethernet(data: bytes) -> _Dissected:
    return dpkt.ethernet.Ethernet(data).data, None


def _cooked(kind: type) -> Callable[[bytes], _Dissected]:
    def dissect(data: bytes) -> _Dissected:
        packet = kind(data)
        known = {_OUTGOING: True, _INCOMING: False}
        return packet.data, known.get(packet.type)

    return dissect


def _raw(data: bytes) -> _Dissected:
    return dpkt.ip.IP(data), None


def _loopback(data: bytes) -> _Dissected:
    return dpkt.loopback.Loopback(data).data, None


_LINKS: Final[dict[int, Callable[[bytes], _Dissected]]] = {
    0: _loopback,
    _ETHERNET: _ethernet,
    12: _raw,
    14: _raw,
    101: _raw,
    108: _loopback,
    113: _cooked(dpkt.sll.SLL),
    228: _raw,
    276: _cooked(dpkt.sll2.SLL2),
}
"""What takes the network layer's packet out of a link layer's, by ``LINKTYPE_...``."""


def _udp(network: Any) -> tuple[Endpoint, Endpoint, bytes] | str:
    """Return ends and content of a packet's datagram, or why there is none."""
    if not isinstance(network, dpkt.ip.IP):
        return "not UDP over IPv4"
    if network.p != dpkt.ip.IP_PROTO_UDP:
        return "not UDP over IPv4"
    if network.mf or network.offset:
        return "fragmented"
    udp = network.data
    if not isinstance(udp, dpkt.udp.UDP) or not 8 <= udp.ulen <= 8 + len(udp.data):
        return "damaged"
    source = Endpoint(_address(network.src), udp.sport)
    destination = Endpoint(_address(network.dst), udp.dport)
    return source, destination, bytes(udp.data[: udp.ulen - 8])


@lru_cache(maxsize=1024)
def _address(packed: bytes) -> str:
    return ".".join(map(str, packed))
