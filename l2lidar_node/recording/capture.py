"""Reads and writes captures of UDP datagrams, as tcpdump and Wireshark do."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any, BinaryIO, Final, NamedTuple

import dpkt

from l2lidar_node.recording.pcap import PacketReader, PacketWriter
from l2lidar_node.types import HostNs

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
        While iterating, if this is no capture.
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
    """Writes datagrams into a pcap file that every tool opens.

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
