"""The serial transport over pseudo-terminals; every wait is for an event, with a limit."""

from __future__ import annotations

import os
import termios
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from l2lidar_node.config import DriverConfig, NetworkConfig
from l2lidar_node.driver import device as device_module
from l2lidar_node.driver.device import Answer
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.emulator.config import DeviceConfig, IdentityConfig, PowerConfig
from l2lidar_node.emulator.link.port import SerialPort
from l2lidar_node.emulator.server import Server
from l2lidar_node.emulator.unit.device import Link, VirtualL2
from l2lidar_node.emulator.unit.firmware import Flash
from l2lidar_node.emulator.unit.stream import PatternScanner, StillInertial
from l2lidar_node.protocol import commands, wire
from l2lidar_node.protocol.packets import Version
from l2lidar_node.protocol.wire import WorkMode
from l2lidar_node.recording import recording
from l2lidar_node.recording.recording import Recording
from l2lidar_node.settings import build
from l2lidar_node.transport.serial import SerialTransport
from l2lidar_node.transport.session import Session, describe_transport, open_transport
from l2lidar_node.transport.udp import TransportError
from l2lidar_node.types import Datagram, HostNs, Stream, Sweep
from tests.l2lidar_node.driver.virtual_host import MemoryTap, essence

LIMIT_S = 120.0  # generous: only a failure waits that long


class Line:
    """A pseudo-terminal: the device's end here, the host's by name."""

    def __init__(self) -> None:
        self.end, self._other = os.openpty()
        self.name = os.ttyname(self._other)
        tty.setraw(self._other)

    def hang_up(self) -> None:
        for descriptor in (self.end, self._other):
            if descriptor >= 0:
                os.close(descriptor)
        self.end = self._other = -1


@pytest.fixture
def line() -> Iterator[Line]:
    item = Line()
    yield item
    item.hang_up()


@pytest.fixture
def transport(line: Line) -> Iterator[SerialTransport]:
    item = SerialTransport(line.name)
    yield item
    item.close()


def read(transport: SerialTransport, octets: int) -> list[Datagram]:
    found: list[Datagram] = []
    deadline = time.monotonic() + LIMIT_S
    while sum(len(item.data) for item in found) < octets:
        found += transport.receive(0.1)
        assert time.monotonic() < deadline
    return found


def test_bytes_come_as_they_were_sent_with_the_time_of_arrival(
    line: Line, transport: SerialTransport
) -> None:
    data = bytes(range(256)) * 8
    before = time.time_ns()
    os.write(line.end, data)
    found = read(transport, len(data))
    assert b"".join(item.data for item in found) == data
    assert all(before <= item.arrival <= time.time_ns() for item in found)
    assert transport.receive(0.01) == []


def test_frames_go_out_as_they_are(line: Line, transport: SerialTransport) -> None:
    frame = commands.sync_time(HostNs(0x0A0D_1311_0403_7F00)).encode()
    transport.send(frame)
    assert os.read(line.end, 4096) == frame
    assert transport.send_errors == 0


def test_the_line_is_raw_at_4_mbaud_8n1(line: Line, transport: SerialTransport) -> None:
    descriptor = os.open(line.name, os.O_RDWR | os.O_NOCTTY)
    attributes = termios.tcgetattr(descriptor)
    os.close(descriptor)
    assert attributes[4] == attributes[5] == termios.B4000000
    assert attributes[2] & termios.CSIZE == termios.CS8
    assert not attributes[2] & (termios.PARENB | termios.CSTOPB | termios.CRTSCTS)
    assert not attributes[0] & (termios.IXON | termios.IXOFF | termios.ICRNL)
    assert not attributes[1] & termios.OPOST
    assert not attributes[3] & (termios.ICANON | termios.ECHO | termios.ISIG)


def test_nothing_is_lost_while_nobody_receives(line: Line, transport: SerialTransport) -> None:
    """Far more than the kernel keeps for a terminal."""
    block = bytes(range(250)) * 16
    for _ in range(100):
        left = block
        while left:
            left = left[os.write(line.end, left) :]
    found = read(transport, 100 * len(block))
    assert b"".join(item.data for item in found) == 100 * block
    assert transport.kernel_drops == 0


def test_closing_twice_and_while_waiting(line: Line) -> None:
    transport = SerialTransport(line.name)
    waiting = threading.Thread(target=transport.receive, args=(0.5,))
    waiting.start()
    transport.close()
    transport.close()
    waiting.join(LIMIT_S)
    assert not waiting.is_alive()
    transport.send(b"x")
    assert transport.send_errors == 1


def test_a_device_that_goes_away_is_taken_up_again(tmp_path: Path) -> None:
    name = tmp_path / "ttyL2"
    first, second = Line(), Line()
    name.symlink_to(first.name)
    transport = SerialTransport(str(name))
    name.unlink()
    first.hang_up()
    deadline = time.monotonic() + LIMIT_S
    while not transport.interruptions:
        assert time.monotonic() < deadline
        transport.receive(0.05)
    transport.send(b"into the void")
    assert transport.send_errors == 1
    name.symlink_to(second.name)
    found: list[Datagram] = []
    while not found:
        assert time.monotonic() < deadline
        os.write(second.end, b"back")
        found = transport.receive(0.1)
    assert set(b"".join(item.data for item in found)) <= set(b"back")
    assert transport.interruptions == 1
    transport.close()
    second.hang_up()


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("/dev/ttyNoSuch0", "does not exist.*ls /dev"),
        ("/dev/null", "not a serial device"),
        ("/", "cannot open the serial device /: "),
    ],
)
def test_what_cannot_be_opened_is_explained(path: str, words: str) -> None:
    with pytest.raises(TransportError, match=words):
        SerialTransport(path)


def test_settings_choose_the_transport(line: Line) -> None:
    network = NetworkConfig(serial_port=line.name)
    transport = open_transport(network)
    assert isinstance(transport, SerialTransport)
    transport.close()
    assert describe_transport(network) == f"listening on {line.name}"
    assert describe_transport(NetworkConfig()).startswith(
        "listening on 192.168.1.2:6201 for the L2 at"
    )


class UnhurriedPort(SerialPort):
    """A line that is given what it has room for, however late: nothing is lost on it."""

    def __init__(self) -> None:
        super().__init__("pty")
        self.has_reader = True

    def send(self, data: bytes) -> bool:
        while self.has_reader and not self.drain(0.05):
            pass
        return super().send(data)


def test_a_driver_works_over_a_serial_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_module, "REPEAT_NS", 10**12)  # the answer may take its time
    config = DeviceConfig(power=PowerConfig(boot_scale=0.0))
    flash = Flash.factory(config.addresses, IdentityConfig(work_mode=WorkMode.SERIAL))
    device = VirtualL2(
        config, PatternScanner(), StillInertial(), flash=flash, link=Link.SERIAL,
        power_on_ns=time.time_ns(),
    )  # fmt: skip
    port = UnhurriedPort()
    server = Server(device, port)
    thread = threading.Thread(target=server.run)
    events: list[Event] = []
    turns, answered = threading.Event(), threading.Event()

    def keep(event: Event) -> None:
        events.append(event)
        if isinstance(event, Answer):
            answered.set()
        elif sum(isinstance(item, Sweep) for item in events) >= 5:
            turns.set()

    driver = Driver(build(DriverConfig, {"sweep_cut": "turn", "imu_adjust": False}))
    tap = MemoryTap()
    session = Session(driver, SerialTransport(port.name.split()[1]), keep, tap)
    thread.start()
    session.start()
    try:
        assert turns.wait(LIMIT_S)
        session.call(lambda driver, now: driver.send(commands.request_config(), now))
        assert answered.wait(LIMIT_S)
    finally:
        session.stop()
        port.has_reader = False
        server.stop()
        thread.join(LIMIT_S)
        port.close()
    (answer,) = [item for item in events if isinstance(item, Answer)]
    assert answer.ok
    counters = driver.counters
    assert not counters.faults
    assert all(counters.sequence[stream].lost == 0 for stream in Stream)
    assert any(isinstance(item, Version) for item in events)
    assert counters.frames[wire.PacketType.POINTS_3D] > 200
    assert driver.clock_status().locked
    replayed = recording.events(Recording(tap.stream), driver.config)
    assert essence(list(replayed)) == essence(events)
    sweeps = [item for item in events if isinstance(item, Sweep)]
    assert {item.packets for item in sweeps} <= {49, 50}
    assert {item.missing for item in sweeps} == {0}
