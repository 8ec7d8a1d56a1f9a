"""The virtual unit over real sockets and serial lines; a wait is a blocking read with a limit."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest

from l2lidar_node.demo.processes import free_udp_ports
from l2lidar_node.emulator.config import AddressConfig, DeviceConfig, FaultConfig, IdentityConfig
from l2lidar_node.emulator.link.port import Port, PortError, SerialPort, UdpPort, unread
from l2lidar_node.emulator.server import MAX_SPEED, Latency, Server
from l2lidar_node.emulator.unit.device import Link, VirtualL2
from l2lidar_node.emulator.unit.firmware import Flash, Network, network_payload
from l2lidar_node.emulator.unit.stream import PatternScanner, StillInertial
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import WorkMode
from tests.l2lidar_node.emulator.rig import READY, Frame, acks, command, identity, read

LIMIT_S = 60.0


class Host:
    """A socket such as a driver has, and what it has read."""

    def __init__(self, ip: str = "127.0.0.1") -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self.socket.bind((ip, 0))
        self.socket.settimeout(LIMIT_S)
        self.frames: list[Frame] = []
        self.senders: set[tuple[str, int]] = set()

    @property
    def port(self) -> int:
        return int(self.socket.getsockname()[1])

    def read(self) -> list[Frame]:
        data, sender = self.socket.recvfrom(65536)
        self.senders.add(sender)
        frames = read(data)
        self.frames += frames
        return frames

    def wait_for(self, packet_type: int) -> Frame:
        while True:
            for frame in self.read():
                if frame.packet_type == packet_type:
                    return frame


@pytest.fixture
def host() -> Iterator[Host]:
    item = Host()
    yield item
    item.socket.close()


def config_for(host_port: int, **groups: Any) -> DeviceConfig:
    addresses = AddressConfig(lidar_port=0, host_port=host_port)
    return DeviceConfig(**{"addresses": addresses, "power": READY, **groups})


def unit(
    config: DeviceConfig, flash: Flash | None = None, link: Link = Link.ETHERNET
) -> VirtualL2:
    return VirtualL2(
        config,
        PatternScanner(),
        StillInertial(),
        power_on_ns=time.time_ns(),
        flash=flash,
        link=link,
    )


@contextlib.contextmanager
def running(device: VirtualL2, port: Port, **options: Any) -> Iterator[Server]:
    """Serve in a thread for the length of a block."""
    server = Server(device, port, **options)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        yield server
    finally:
        server.stop()
        thread.join(LIMIT_S)
        port.close()
        assert not thread.is_alive()


def test_a_driver_on_the_same_machine_gets_everything_and_is_answered(host: Host) -> None:
    device = unit(config_for(host.port))
    port = UdpPort(device.network)
    with running(device, port):
        host.wait_for(wire.PacketType.POINTS_3D)
        host.socket.sendto(command(2000, 4, 0), port.address)
        version = host.wait_for(wire.PacketType.VERSION)
        assert version.payload[32 - 24 :].startswith(b"YS-L2")
        host.socket.sendto(command(2000, 6, 101), port.address)
        while (2000, 6, 101, 1) not in acks(host.frames):
            host.wait_for(wire.PacketType.ACK)
    assert host.senders == {
        port_address for port_address in host.senders if port_address[0] == "127.0.0.1"
    }
    assert len(host.senders) == 1
    assert device.received == {2000: 2}


def test_the_stamps_lie_on_the_hosts_clock(host: Host) -> None:
    before = time.time_ns()
    device = unit(config_for(host.port))
    with running(device, UdpPort(device.network)):
        for _ in range(50):
            host.wait_for(wire.PacketType.IMU)
    after = time.time_ns()
    packets = device.packet_log.packets
    assert before <= packets["start_ns"][0]
    assert packets["left_ns"][-1] <= after


def test_as_fast_as_the_receiver_takes_it_nothing_is_lost(host: Host) -> None:
    host.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 106_496)
    device = unit(config_for(host.port))
    port = UdpPort(device.network)
    server = Server(device, port, MAX_SPEED)
    thread = threading.Thread(target=server.run, args=(8.0,))
    thread.start()
    while thread.is_alive() or select.select([host.socket], [], [], 0.0)[0]:
        if select.select([host.socket], [], [], 0.05)[0]:
            host.read()
    port.close()
    assert server.unsent == 0
    assert Counter(frame.packet_type for frame in host.frames) == dict(device.sent)
    assert device.sent[wire.PacketType.IMU] == 2000


def test_a_stop_ends_even_a_race_that_nobody_reads(host: Host) -> None:
    device = unit(config_for(host.port))
    with running(device, UdpPort(device.network), speed=MAX_SPEED):
        assert unread("127.0.0.1", host.port) is not None
        host.read()


def test_a_duration_is_in_the_units_time(host: Host) -> None:
    device = unit(config_for(host.port))
    port = UdpPort(device.network)
    server = Server(device, port, 20.0)
    server.run(4.0)
    port.close()
    assert device.sent[wire.PacketType.IMU] == 1000
    assert server.latency.count == sum(device.sent.values())


def test_it_moves_to_a_new_address_at_the_reset(host: Host) -> None:
    device = unit(config_for(host.port))
    port = UdpPort(device.network)
    stored: list[Flash] = []
    other = Host("127.0.0.3")
    wanted = Network("127.0.0.2", "127.0.0.3", "127.0.0.1", "255.0.0.0", 0, other.port)
    with running(device, port, on_flash=stored.append):
        host.wait_for(wire.PacketType.IMU)
        wanted = wanted._replace(lidar_port=free_udp_ports(1)[0])
        host.socket.sendto(wire.encode_frame(108, network_payload(wanted)), port.address)
        host.wait_for(wire.PacketType.ACK)
        host.socket.sendto(command(100, 1, 1), port.address)
        other.wait_for(wire.PacketType.IMU)
    assert identity(other.frames[0])[1] <= 1
    assert other.senders == {("127.0.0.2", wanted.lidar_port)}
    assert [flash.network for flash in stored] == [wanted]
    other.socket.close()


def test_it_can_answer_whoever_asks(host: Host) -> None:
    config = config_for(
        9, addresses=AddressConfig(lidar_port=0, host_port=9, reply_to_sender=True)
    )
    device = unit(config)
    port = UdpPort(device.network, reply_to_sender=True)
    with running(device, port):
        host.socket.sendto(command(2000, 6, 1), port.address)
        host.wait_for(wire.PacketType.ACK)
        host.wait_for(wire.PacketType.POINTS_3D)
    assert port.host == ("127.0.0.1", host.port)


@pytest.mark.parametrize("stored", ["192.0.2.77", "255.255.255.255"])
def test_a_stored_host_that_cannot_be_reached_is_no_reason_to_fail(stored: str) -> None:
    """Neither a network that the unit's address has no way to, nor a broadcast address."""
    addresses = AddressConfig(lidar_port=0, host=stored, host_port=9)
    device = unit(config_for(9, addresses=addresses))
    port = UdpPort(device.network)
    server = Server(device, port, 20.0)
    server.run(1.0)
    port.close()
    assert device.sent[wire.PacketType.IMU] == 250
    assert server.unsent == server.latency.count


def test_nobody_listening_is_no_reason_to_fail() -> None:
    (unused,) = free_udp_ports(1)
    device = unit(config_for(unused))
    port = UdpPort(device.network)
    Server(device, port, 50.0).run(2.0)
    port.close()
    assert device.sent[wire.PacketType.IMU] == 500
    assert unread("127.0.0.1", unused) is None


def test_an_address_in_use_or_elsewhere_is_named(host: Host) -> None:
    network = Flash.factory(AddressConfig(lidar_port=host.port), IdentityConfig()).network
    with pytest.raises(PortError, match=rf"127\.0\.0\.1:{host.port}: .*in use"):
        UdpPort(network)
    with pytest.raises(PortError, match=r"192\.0\.2\.1:6101"):
        UdpPort(network._replace(lidar_ip="192.0.2.1", lidar_port=6101))


def test_a_stop_is_heard_while_a_unit_catches_up_with_days(host: Host) -> None:
    device = unit(config_for(host.port))
    with running(device, UdpPort(device.network), speed=1e9):
        host.read()


def test_the_backlog_is_what_the_receiver_has_not_read(host: Host) -> None:
    assert unread("127.0.0.1", host.port) == 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(5):
            sender.sendto(bytes(1000), ("127.0.0.1", host.port))
    waiting = unread("127.0.0.1", host.port)
    assert waiting is not None
    assert waiting >= 5000
    for _ in range(5):
        host.socket.recv(2000)
    assert unread("127.0.0.1", host.port) == 0


def serial_unit() -> VirtualL2:
    config = DeviceConfig(power=READY, identity=IdentityConfig(work_mode=int(WorkMode.SERIAL)))
    return unit(config, link=Link.SERIAL)


def read_serial(descriptor: int, until: bytes, at_least: int = 1) -> bytes:
    """Read until something has come, or so many bytes."""
    stream = b""
    while len(stream) < at_least and (not until or until not in stream):
        assert select.select([descriptor], [], [], LIMIT_S)[0], "the line is silent"
        stream += os.read(descriptor, 65536)
    return stream


def test_a_serial_line_carries_the_same_packets_and_commands() -> None:
    device = serial_unit()
    port = SerialPort("pty")
    line = os.open(port.name.split()[1], os.O_RDWR | os.O_NOCTTY)
    answer = wire.encode_frame(101, bytes.fromhex("d0070000060000006500000001000000"))
    stream = b""
    with running(device, port, speed=0.2):
        while answer not in stream:  # an answer for which the line has no room is lost
            os.write(line, command(2000, 6, 101))
            stream += read_serial(line, answer, at_least=20_000)
        while {frame.packet_type for frame in read(stream)} != {101, 102, 104}:
            stream += read_serial(line, b"")
    os.close(line)


def octets(device: VirtualL2) -> int:
    """Return how many bytes a device has sent."""
    return sum(wire.FRAME_SIZES[kind] * count for kind, count in device.sent.items())


@pytest.mark.parametrize("longest_write", [65536, 500])
def test_a_serial_line_sets_the_pace_of_a_race(
    longest_write: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = os.write
    # A line that is almost full takes a part of a packet, the last one included.
    monkeypatch.setattr(os, "write", lambda fd, data: write(fd, data[:longest_write]))
    device = serial_unit()
    port = SerialPort("pty")
    line = os.open(port.name.split()[1], os.O_RDWR | os.O_NOCTTY)
    server = Server(device, port, MAX_SPEED)
    thread = threading.Thread(target=server.run, args=(4.0,))
    thread.start()
    stream = b""
    deadline = time.monotonic() + LIMIT_S
    # What was written may not have reached the other end yet when the device has ended.
    while thread.is_alive() or len(stream) < octets(device):
        assert time.monotonic() < deadline
        if select.select([line], [], [], 0.05)[0]:
            stream += os.read(line, 65536)
    port.close()
    os.close(line)
    assert server.unsent == 0
    assert Counter(frame.packet_type for frame in read(stream)) == dict(device.sent)


def test_a_serial_line_without_a_reader_loses_bytes_and_goes_on() -> None:
    device = serial_unit()
    port = SerialPort("pty")
    server = Server(device, port, 50.0)
    server.run(3.0)
    port.close()
    assert server.unsent > 0
    assert device.sent[wire.PacketType.IMU] == 750


def test_a_serial_line_that_is_cut_ends_the_run() -> None:
    other, line = os.openpty()
    port = SerialPort(os.ttyname(line))
    os.close(line)
    os.close(other)
    with pytest.raises(PortError, match="closed"):
        Server(serial_unit(), port).run()
    port.close()


@pytest.mark.parametrize("path", ["/nonexistent/ttyACM0", "/dev/null"])
def test_a_serial_device_that_is_none_is_named(path: str) -> None:
    with pytest.raises(PortError, match=path):
        SerialPort(path)


def test_faults_reach_the_socket(host: Host) -> None:
    device = unit(config_for(host.port, faults=FaultConfig(coalesce=1.0)))
    with running(device, UdpPort(device.network)):
        assert max(len(host.read()) for _ in range(20)) > 1


def test_latency_is_counted_in_bounded_memory() -> None:
    late = Latency()
    assert late.quantile_ns(0.5) == 0
    for k in range(1000):
        late.add(k * 1000)
    late.add(-5)
    late.add(10**12)
    assert late.quantile_ns(0.5) == pytest.approx(500_000, abs=10_000)
    assert late.quantile_ns(1.0) == late.max_ns == 10**12
    assert late.count == 1002
    seconds = Latency()
    for k in range(1000):
        seconds.add(k * 10_000_000)
    assert seconds.quantile_ns(0.5) == pytest.approx(5_000_000_000, abs=10_000_000)
    assert seconds.quantile_ns(0.99) == pytest.approx(9_900_000_000, abs=10_000_000)
