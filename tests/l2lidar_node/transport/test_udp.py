"""The socket, over the loopback interface."""

from __future__ import annotations

import errno
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from l2lidar_node.config import NetworkConfig
from l2lidar_node.demo.processes import free_udp_ports
from l2lidar_node.transport import udp
from l2lidar_node.transport.recvmmsg import SO_TIMESTAMPNS, DatagramReader
from l2lidar_node.transport.udp import TransportError, UdpTransport
from l2lidar_node.types import Datagram, HostNs

DEVICE, FOREIGNER, HOST = "127.0.0.1", "127.0.0.2", "127.0.0.3"
LIMIT_S = 60.0  # generous: only a failure waits that long


@pytest.fixture(scope="module", autouse=True)
def _stamping_kernel() -> Iterator[None]:
    """Have the kernel stamp arrivals: it begins a little after the first socket asks for it.

    Until then a datagram is stamped when it is read.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        link.bind((HOST, 0))
        reader = DatagramReader(link, HOST)
        deadline = time.monotonic() + LIMIT_S
        while time.monotonic() < deadline:
            link.sendto(b"", link.getsockname())
            sent = time.time_ns()
            reader.read()
            if reader.datagrams[-1].arrival <= sent:
                break
        yield


@pytest.fixture
def device() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind((DEVICE, 0))
        end.settimeout(LIMIT_S)
        yield end


@contextmanager
def opened(device: socket.socket, **config: Any) -> Iterator[UdpTransport]:
    given = {
        "l2_ip": DEVICE, "l2_port": device.getsockname()[1], "host_ip": HOST,
        "host_port": free_udp_ports(1)[0],
    }  # fmt: skip
    link = UdpTransport(NetworkConfig(**given | config))
    try:
        yield link
    finally:
        link.close()


def receive(link: UdpTransport, count: int) -> list[Datagram]:
    """Return so many datagrams, or as many as come in time."""
    deadline = time.monotonic() + LIMIT_S
    got: list[Datagram] = []
    while len(got) < count and time.monotonic() < deadline:
        got += link.receive(0.1)
    return got


def test_datagrams_come_whole_and_in_order(device: socket.socket) -> None:
    sent = [b"", b"x", bytes(1472), bytes(range(256)) * 200]
    with opened(device) as link:
        for data in sent:
            device.sendto(data, (HOST, link.port))
        assert [item.data for item in receive(link, 4)] == sent
        assert link.foreign == 0


def test_more_than_one_batch(
    device: socket.socket,
) -> None:  # and no more than the kernel keeps by default
    with opened(device) as link:
        for number in range(400):
            device.sendto(number.to_bytes(2), (HOST, link.port))
        assert [item.data for item in receive(link, 400)] == [n.to_bytes(2) for n in range(400)]


def test_arrivals_are_the_kernels_and_ascend(device: socket.socket) -> None:
    with opened(device) as link:
        before = time.time_ns()
        for _ in range(3):
            device.sendto(b"x", (HOST, link.port))
        time.sleep(0.05)  # read late: the stamps must not be those of the reading
        read = time.time_ns()
        arrivals = [item.arrival for item in receive(link, 3)]
    assert arrivals == sorted(arrivals)
    assert before - 1_000_000 <= arrivals[0] < read


def test_other_senders_are_counted_and_dropped(device: socket.socket) -> None:
    with opened(device) as link, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as foreigner:
        foreigner.bind((FOREIGNER, 0))
        for _ in range(3):
            foreigner.sendto(b"fake", (HOST, link.port))
        device.sendto(b"true", (HOST, link.port))
        assert [item.data for item in receive(link, 1)] == [b"true"]
        assert link.foreign == 3


def flood(link: UdpTransport, foreigner: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    """Send twice as many datagrams as are allowed in a second, and read them."""
    monkeypatch.setattr(udp, "_FLOOD_NS", 3600 * 10**9)  # a second may be too short for that
    for _ in range(2 * udp.FLOOD_HZ // 100):
        for _ in range(100):
            foreigner.sendto(bytes(100), (HOST, link.port))
        link.receive(0.001)


def test_a_flood_of_strangers_takes_no_room_from_the_device(
    device: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every datagram of the device comes, and every one of the strangers is counted."""
    with opened(device) as link, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as foreigner:
        foreigner.bind((FOREIGNER, 0))
        flood(link, foreigner, monkeypatch)
        # from here on nobody reads: what the kernel refuses cannot fill the buffer
        true = [number.to_bytes(2) for number in range(300)]
        for data in true:
            device.sendto(data, (HOST, link.port))
            for _ in range(100):
                foreigner.sendto(bytes(1400), (HOST, link.port))
        assert [item.data for item in receive(link, 300)] == true
        assert link.foreign == 2 * udp.FLOOD_HZ + 300 * 100
        assert link.kernel_drops == 0
        assert link.stranger == FOREIGNER


def test_after_a_flood_strangers_are_read_again(
    device: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    with opened(device) as link, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as foreigner:
        foreigner.bind((FOREIGNER, 0))
        flood(link, foreigner, monkeypatch)
        monkeypatch.setattr(udp, "_FLOOD_NS", 0)
        link.receive(0.001)  # ends the window in which there were many
        link.receive(0.001)  # and one with none
        link.stranger = ""
        foreigner.sendto(b"", (HOST, link.port))
        assert link.receive(1.0) == []
        assert link.stranger == FOREIGNER
        assert link.foreign == 2 * udp.FLOOD_HZ + 1


def test_another_port_of_the_device_is_the_device(device: socket.socket) -> None:
    with opened(device) as link, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((DEVICE, 0))
        other.sendto(b"x", (HOST, link.port))
        assert [item.data for item in receive(link, 1)] == [b"x"]


def test_nothing_comes_in_time(device: socket.socket) -> None:
    with opened(device) as link:
        assert link.receive(0.01) == []
        assert link.receive(0.0) == []


def test_a_listener_on_all_addresses(device: socket.socket) -> None:
    with opened(device, host_ip="0.0.0.0") as link:
        device.sendto(b"x", (DEVICE, link.port))
        assert [item.data for item in receive(link, 1)] == [b"x"]


def test_drops_of_the_kernel_are_counted(device: socket.socket) -> None:
    with opened(device, receive_buffer_bytes=4096) as link:
        assert 4096 <= link.receive_buffer_bytes < 100_000
        for _ in range(400):
            device.sendto(bytes(1000), (HOST, link.port))
        got = 0
        while batch := link.receive(0.05):
            got += len(batch)
        assert 0 < got < 400
        assert got + link.kernel_drops == 400


def test_frames_go_to_the_device_from_the_port_that_receives(device: socket.socket) -> None:
    with opened(device) as link:
        link.send(b"command")
        data, sender = device.recvfrom(100)
        assert data == b"command"
        assert sender == (HOST, link.port)


def test_a_frame_that_cannot_be_sent_is_counted(device: socket.socket) -> None:
    with opened(device) as link:
        link.send(bytes(70_000))
        assert link.send_errors == 1
        link.send(b"next")
        assert device.recvfrom(100)[0] == b"next"


def test_a_device_that_is_not_there_stops_nothing(device: socket.socket) -> None:
    with opened(device, l2_port=free_udp_ports(1)[0]) as link:
        for _ in range(3):
            link.send(b"x")
            assert link.receive(0.01) == []
        device.sendto(b"back", (HOST, link.port))
        assert [item.data for item in receive(link, 1)] == [b"back"]


def refusal(device: socket.socket, **config: Any) -> TransportError:
    """Return the error of listening where one cannot."""
    with pytest.raises(TransportError) as caught, opened(device, **config):
        pass
    return caught.value


def test_a_port_in_use(device: socket.socket) -> None:
    with opened(device) as first:
        error = refusal(device, host_port=first.port)
        assert error.errno == errno.EADDRINUSE
        assert f"cannot listen on {HOST}:{first.port}" in str(error)
        assert "in use; end the other program" in str(error)


def test_an_address_of_another_machine(device: socket.socket) -> None:
    error = refusal(device, host_ip="192.0.2.1")
    assert error.errno == errno.EADDRNOTAVAIL
    assert "host_ip '192.0.2.1' is not an address of this machine" in str(error)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may listen on any port")
def test_a_privileged_port(device: socket.socket) -> None:
    error = refusal(device, host_port=80)
    assert "no permission; set host_port to 1024 or above" in str(error)


@pytest.mark.parametrize(
    ("number", "advice"),
    [
        (errno.EACCES, "no permission; set host_port to 1024 or above"),
        (errno.ENOBUFS, os.strerror(errno.ENOBUFS)),
    ],
)
def test_the_advice_for_what_a_test_cannot_provoke(number: Any, advice: Any) -> None:
    error = OSError(number, os.strerror(number))
    text = udp._bind_advice(NetworkConfig(), error)
    assert text == f"cannot listen on 192.168.1.2:6201: {advice}"


def test_closing_twice_and_listening_again(device: socket.socket) -> None:
    with opened(device) as link:
        port = link.port
        link.close()
        link.close()
    with opened(device, host_port=port) as again:
        assert again.port == port


def test_what_is_awaited_later_is_waited_for_and_the_rest_waits_with_it(
    device: socket.socket,
) -> None:
    with opened(device, receive_interval_ms=20) as link:
        awaited = HostNs(time.time_ns() + 50_000_000)
        device.sendto(b"x", (HOST, link.port))
        batch = link.receive(10.0, awaited)
        read = time.time_ns()
    assert [item.data for item in batch] == [b"x"]
    assert batch[0].arrival < awaited < read


def test_a_pause_between_looks_costs_no_accuracy(device: socket.socket) -> None:
    """What came meanwhile is read at once, each with the instant at which it came."""
    with opened(device, receive_interval_ms=100) as link:
        link.receive(0.001)
        sent = []
        for number in range(5):
            sent.append(time.time_ns())
            device.sendto(bytes([number]), (HOST, link.port))
        got = receive(link, 5)
        read = time.time_ns()
    assert [item.data for item in got] == [bytes([number]) for number in range(5)]
    assert all(begin <= item.arrival for begin, item in zip(sent, got, strict=True))
    assert got[-1].arrival < read
