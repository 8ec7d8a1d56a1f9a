import contextlib
import io
import struct
from typing import Any

import dpkt
import pytest
from hypothesis import example, given, strategies as st

from l2lidar_node.recording.capture import (
    CaptureError,
    CaptureReader,
    CaptureWriter,
    Endpoint,
    PacketReader,
    PacketWriter,
    UdpDatagram,
)
from l2lidar_node.recording.recording import (
    SLEWED,
    STEPPED,
    WAITED,
    Received,
    Recording,
    Sent,
    Slewed,
    Stepped,
    Waited,
)
from l2lidar_node.types import HostNs
from tests.support import build
from tests.support.build import SHARED_DATA

DEVICE = Endpoint("192.168.1.62", 6101)
HOST = Endpoint("192.168.1.2", 6201)
NS = build.NS
TIME = HostNs(build.EPOCH_NS + 123_456_789)
IMU = build.frame(104, build.imu())
SYNC = build.frame(106, struct.pack("<2I", *divmod(TIME, NS)))


def udp_packet(data: bytes, source: Endpoint = DEVICE, destination: Endpoint = HOST) -> dpkt.ip.IP:
    """Return what dpkt makes of a datagram: the judge of what ours reads and writes."""
    udp = dpkt.udp.UDP(sport=source.port, dport=destination.port, data=data)
    udp.ulen = 8 + len(data)
    return dpkt.ip.IP(
        src=bytes(map(int, source.ip.split("."))),
        dst=bytes(map(int, destination.ip.split("."))),
        p=17,
        data=udp,
    )


def ethernet(network: object, kind: int = 0x0800) -> bytes:
    return bytes(dpkt.ethernet.Ethernet(src=b"\2" * 6, dst=b"\4" * 6, type=kind, data=network))


def tcpdump(packets: list[tuple[float, bytes]], link: int = 1, **options: Any) -> io.BytesIO:
    """Return a file as tcpdump writes it, made by dpkt."""
    stream = io.BytesIO()
    writer = dpkt.pcap.Writer(stream, linktype=link, **options)
    for time, data in packets:
        writer.writepkt(data, time)
    stream.seek(0)
    return stream


def pcapng(packets: list[tuple[int, bytes]], order: str, resolution: int) -> io.BytesIO:
    """Return a pcapng file, assembled by hand; a block nobody knows stands in between."""

    def block(kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        size = len(body) + 12
        return struct.pack(f"{order}2I", kind, size) + body + struct.pack(f"{order}I", size)

    head = struct.pack(f"{order}I2Hq", 0x1A2B3C4D, 1, 0, -1)
    options = struct.pack(f"{order}2HB3x2HqHH", 9, 1, resolution, 14, 8, 100, 0, 0)
    out = block(0x0A0D0D0A, head)
    out += block(1, struct.pack(f"{order}2HI", 1, 0, 0) + options)
    out += block(0xBAD, b"what is this")
    for ticks, data in packets:
        fields = struct.pack(
            f"{order}5I", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(data), len(data)
        )
        out += block(6, fields + data)
    out += block(3, struct.pack(f"{order}I", 4) + b"abcd")
    return io.BytesIO(out)


def read(stream: io.BytesIO) -> list[UdpDatagram]:
    return list(CaptureReader(stream))


def test_what_is_written_is_a_capture_for_others() -> None:
    stream = io.BytesIO()
    writer = CaptureWriter(stream)
    writer.write(UdpDatagram(TIME, DEVICE, HOST, IMU))
    writer.write(UdpDatagram(HostNs(TIME + 1), HOST, DEVICE, b"odd"))
    stream.seek(0)
    (first, data), (second, _) = dpkt.pcap.Reader(stream)
    assert (int(first * NS), int(second * NS)) == (TIME, TIME + 1)
    network = dpkt.ethernet.Ethernet(data).data
    assert bytes(network.src) == bytes((192, 168, 1, 62))
    assert (network.data.sport, network.data.dport, network.data.data) == (6101, 6201, IMU)
    assert dpkt.in_cksum(network.pack_hdr()) == 0
    assert network.sum != 0
    pseudo = struct.pack(">4s4sxBH", network.src, network.dst, 17, network.data.ulen)
    assert dpkt.in_cksum(pseudo + bytes(network.data)) == 0


@given(
    st.lists(st.tuples(st.integers(0, (1 << 32) * NS - 1), st.binary(max_size=2000)), max_size=9)
)
@example([(0, bytes(7)), (1, b"\xff" * 8), (2, b"")])
def test_what_is_written_comes_back(items: Any) -> None:
    stream = io.BytesIO()
    writer = CaptureWriter(stream)
    datagrams = [UdpDatagram(HostNs(time), DEVICE, HOST, data) for time, data in items]
    for datagram in datagrams:
        writer.write(datagram)
    stream.seek(0)
    assert read(stream) == datagrams
    stream.seek(0)
    for _, data in dpkt.pcap.Reader(stream):
        frame = dpkt.ethernet.Ethernet(data)
        frame.data.sum = frame.data.data.sum = 0  # dpkt makes both anew
        assert bytes(frame) == data


def test_a_datagram_that_udp_cannot_carry_is_refused() -> None:
    with pytest.raises(ValueError, match="65508 bytes"):
        CaptureWriter(io.BytesIO()).write(UdpDatagram(TIME, DEVICE, HOST, bytes(65_508)))


@pytest.mark.parametrize("nano", [False, True])
def test_times_of_tcpdump_are_exact(nano: bool) -> None:
    from decimal import Decimal

    exact = TIME if nano else TIME // 1000 * 1000
    packets: list[Any] = [(Decimal(exact) / NS, ethernet(udp_packet(IMU)))]
    stream = tcpdump(packets, nano=nano)
    assert [datagram.time for datagram in read(stream)] == [exact]


def test_both_byte_orders_are_read() -> None:
    packet = ethernet(udp_packet(IMU))
    head = struct.pack(">I2H4I", 0xA1B23C4D, 2, 4, 0, 0, 65535, 1)
    record = struct.pack(">4I", *divmod(TIME, NS), len(packet), len(packet))
    assert read(io.BytesIO(head + record + packet)) == [UdpDatagram(TIME, DEVICE, HOST, IMU)]


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("resolution", "unit"), [(6, 1000), (9, 1), (3, 1_000_000)])
def test_pcapng_is_read(order: Any, resolution: int, unit: int) -> None:
    ticks = (TIME - 100 * NS) // unit
    stream = pcapng([(ticks, ethernet(udp_packet(IMU)))], order, resolution)
    reader = CaptureReader(stream)
    assert [(item.time, item.data) for item in reader] == [(ticks * unit + 100 * NS, IMU)]
    assert reader.ignored == {"without a time": 1}


def test_pcapng_with_binary_resolution() -> None:
    stream = pcapng([(5 << 20 | 1 << 19, ethernet(udp_packet(IMU)))], "<", 0x80 | 20)
    assert [item.time for item in read(stream)] == [105 * NS + NS // 2]


def cooked(kind: int) -> bytes:
    return struct.pack(">3H8sH", kind, 1, 6, b"\2" * 8, 0x0800) + bytes(udp_packet(IMU))


def cooked_2(kind: int) -> bytes:
    head = struct.pack(">2HIHBB8s", 0x0800, 0, 1, 1, kind, 6, b"\2" * 8)
    return head + bytes(udp_packet(IMU))


@pytest.mark.parametrize(
    ("link", "data", "outgoing"),
    [
        (1, ethernet(udp_packet(IMU)), None),
        (1, ethernet(struct.pack(">2H", 5, 0x0800) + bytes(udp_packet(IMU)), 0x8100), None),
        (101, bytes(udp_packet(IMU)), None),
        (228, bytes(udp_packet(IMU)), None),
        (12, bytes(udp_packet(IMU)), None),
        (0, struct.pack("=I", 2) + bytes(udp_packet(IMU)), None),
        (113, cooked(0), False),
        (113, cooked(3), None),
        (113, cooked(4), True),
        (276, cooked_2(0), False),
        (276, cooked_2(4), True),
    ],
)
def test_link_layers(link: int, data: Any, outgoing: Any) -> None:
    (datagram,) = read(tcpdump([(1.0, data)], link))
    assert datagram[1:] == (DEVICE, HOST, IMU, outgoing)


def test_ethernet_padding_is_no_content() -> None:
    (datagram,) = read(tcpdump([(1.0, ethernet(udp_packet(b"short")) + bytes(20))]))
    assert datagram.data == b"short"


def test_other_traffic_is_left_out_and_counted() -> None:
    fragment = udp_packet(IMU)
    fragment.mf = 1
    wrong = udp_packet(IMU)
    wrong.data.ulen = 4000
    tcp = dpkt.ip.IP(src=b"\1\1\1\1", dst=b"\2\2\2\2", p=6, data=dpkt.tcp.TCP())
    packets = [
        ethernet(dpkt.arp.ARP(), 0x0806),
        ethernet(tcp),
        ethernet(fragment),
        ethernet(wrong),
        ethernet(bytes(3)),
        b"\1\2",
        ethernet(udp_packet(IMU)),
    ]
    reader = CaptureReader(tcpdump([(1.0, packet) for packet in packets]))
    assert [item.data for item in reader] == [IMU]
    assert reader.ignored == {"not UDP over IPv4": 3, "fragmented": 1, "damaged": 2}


def test_packets_cut_by_the_snap_length_are_counted() -> None:
    packet = ethernet(udp_packet(IMU))
    stream = io.BytesIO()
    PacketWriter(stream, 1).write(TIME, packet[:60])
    data = bytearray(stream.getvalue())
    struct.pack_into("<I", data, 24 + 12, len(packet))
    reader = CaptureReader(io.BytesIO(bytes(data)))
    assert list(reader) == []
    assert reader.ignored == {"cut short": 1}


def test_an_unknown_link_type_is_named() -> None:
    reader = CaptureReader(tcpdump([(1.0, b"x" * 40)], 195))
    assert list(reader) == []
    assert reader.ignored == {"of link type 195": 1}


@given(st.integers(0, 3000))
def test_a_file_cut_anywhere_gives_the_packets_before(length: Any) -> None:
    stream = io.BytesIO()
    writer = CaptureWriter(stream)
    for number in range(20):
        writer.write(UdpDatagram(HostNs(TIME + number), DEVICE, HOST, IMU))
    data = stream.getvalue()[:length]
    reader = CaptureReader(io.BytesIO(data))
    if length < 4:
        with pytest.raises(CaptureError, match="not a capture file"):
            list(reader)
        return
    size = 16 + 14 + 28 + len(IMU)
    whole = max(len(data) - 24, 0) // size
    assert len(list(reader)) == whole
    assert reader.is_cut_off == (len(data) < 24 or (len(data) - 24) % size != 0)


@given(st.binary(max_size=400), st.sampled_from(["<nano", ">nano", "<ng", ">ng", ""]))
def test_garbage_never_raises_anything_else(data: Any, start: Any) -> None:
    heads = {
        "<nano": struct.pack("<I2H4I", 0xA1B23C4D, 2, 4, 0, 0, 65535, 1),
        ">nano": struct.pack(">I2H4I", 0xA1B23C4D, 2, 4, 0, 0, 65535, 1),
        "<ng": pcapng([(1, b"12345678")], "<", 6).getvalue(),
        ">ng": pcapng([(1, b"12345678")], ">", 6).getvalue(),
        "": b"",
    }
    with contextlib.suppress(CaptureError):
        list(CaptureReader(io.BytesIO(heads[start] + data)))


@given(st.integers(0, 600), st.integers(0, 255))
def test_one_wrong_byte_never_raises_anything_else(at: Any, value: Any) -> None:
    data = bytearray(pcapng([(1, ethernet(udp_packet(IMU)))] * 3, "<", 9).getvalue())
    data[at % len(data)] = value
    with contextlib.suppress(CaptureError):
        list(CaptureReader(io.BytesIO(bytes(data))))


@given(st.sampled_from([0, 1, 101, 113, 276]), st.binary(max_size=120), st.booleans())
def test_packets_of_garbage_are_left_out(link: Any, data: Any, is_ip: Any) -> None:
    if is_ip:
        data = b"\x45" + data
    stream = io.BytesIO()
    PacketWriter(stream, link).write(TIME, data)
    stream.seek(0)
    reader = CaptureReader(stream)
    assert len(list(reader)) + sum(reader.ignored.values()) == 1


def test_a_block_or_packet_that_claims_too_much_is_damage() -> None:
    head = struct.pack("<I2H4I", 0xA1B23C4D, 2, 4, 0, 0, 65535, 1)
    for rest in (struct.pack("<4I", 1, 1, 1 << 20, 1 << 20), struct.pack("<4I", 1, 1, 1 << 31, 1)):
        with pytest.raises(CaptureError, match="damaged"):
            list(PacketReader(io.BytesIO(head + rest)))


def test_a_recording_takes_what_its_host_and_device_said() -> None:
    other = Endpoint("10.0.0.9", 5000)
    packets = [
        udp_packet(SYNC, HOST, DEVICE),
        udp_packet(IMU),
        udp_packet(IMU, Endpoint(DEVICE.ip, 999)),  # a live socket looks at the address alone
        udp_packet(b"news", other, HOST),
        udp_packet(SYNC, other, DEVICE),
        udp_packet(b"not a command", HOST, DEVICE),
        udp_packet(IMU),
    ]
    stream = io.BytesIO()
    writer = PacketWriter(stream, 101)
    for number, packet in enumerate(packets):
        writer.write(HostNs(TIME + 7_000 + number), bytes(packet))
    recording = Recording(stream)
    assert (recording.device, recording.host) == (DEVICE, HOST)
    assert recording.start == TIME + 7_001
    kinds = [type(item) for item in recording]
    assert kinds == [Sent, Received, Received, Received]
    first, *_ = recording
    assert isinstance(first, Sent)
    assert first.command.time == first.time == TIME  # as the driver counted it


def test_only_exact_notes_of_the_host_to_itself_count() -> None:
    wrong = [b"", STEPPED, STEPPED % 10**30, STEPPED % 5 + b"!", WAITED[:-1], SLEWED % 10**30]
    notes = [STEPPED % 0, STEPPED % -3_600_000_000_000, WAITED, SLEWED % -5_000]
    packets = [udp_packet(data, HOST, HOST) for data in wrong + notes]
    packets = [(1.0, bytes(packet)) for packet in [udp_packet(IMU), *packets]]
    items = list(Recording(tcpdump(packets, 101)))
    assert [type(item) for item in items] == [Received, Stepped, Stepped, Waited, Slewed]
    assert items[1:3] == [(0, items[0].time), (-3_600_000_000_000, items[0].time)]
    assert items[4] == (-5_000, items[0].time)


def test_cooked_captures_of_the_loopback_interface_show_everything_once() -> None:
    packets = [(1.0, cooked(4)), (1.0, cooked(0)), (2.0, cooked(4)), (2.0, cooked(0))]
    assert (
        len([item for item in Recording(tcpdump(packets, 113)) if isinstance(item, Received)]) == 2
    )


def two_devices() -> io.BytesIO:
    packets = [
        udp_packet(IMU, Endpoint("10.0.0.1", 6101)),
        udp_packet(IMU, Endpoint("10.0.0.2", 6101)),
    ]
    return tcpdump([(1.0, bytes(packet)) for packet in packets], 101)


def test_of_several_devices_one_must_be_named() -> None:
    with pytest.raises(CaptureError, match=r"several L2s \(10\.0\.0\.1, 10\.0\.0\.2"):
        Recording(two_devices(), "192.168.1.62")
    assert Recording(two_devices(), "10.0.0.2").device.ip == "10.0.0.2"


def test_the_only_device_is_taken_whatever_its_address() -> None:
    stream = tcpdump([(1.0, bytes(udp_packet(IMU, Endpoint("10.0.0.1", 1))))], 101)
    assert Recording(stream, "192.168.1.62").device == Endpoint("10.0.0.1", 1)


def test_a_capture_without_an_l2_says_what_is_in_it() -> None:
    packets = [udp_packet(b"x" * 50, destination=Endpoint("1.2.3.4", 53))] * 3
    stream = tcpdump([(1.0, bytes(packet)) for packet in packets] + [(1.0, b"?")], 101)
    with pytest.raises(
        CaptureError, match=r"it has no L2 packets, only 3 UDP .*3 to port 53.*1 dam"
    ):
        Recording(stream)


@pytest.mark.skipif(not SHARED_DATA.exists(), reason="the recordings are not here")
def test_a_capture_of_another_sensor_is_told_from_ours() -> None:
    (path,) = (SHARED_DATA / "ouster_os1").glob("*.pcap")
    with path.open("rb") as stream:
        reader = CaptureReader(stream)
        ports = [datagram.destination.port for datagram in reader]
        assert (ports.count(7502), ports.count(7503)) == (192, 30)
        assert not reader.ignored
        with pytest.raises(CaptureError, match="it has no L2 packets, only 222 UDP datagrams"):
            Recording(stream)
