"""The receive loop, over a real socket where it matters."""

from __future__ import annotations

import queue
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future
from typing import Any

import pytest

from l2lidar_node.config import DriverConfig
from l2lidar_node.demo.processes import free_udp_ports
from l2lidar_node.driver import device as device_module
from l2lidar_node.driver.device import TRIES, Answer
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.protocol import commands, wire
from l2lidar_node.settings import build as configure
from l2lidar_node.transport.session import Session
from l2lidar_node.transport.udp import UdpTransport
from l2lidar_node.types import NOT_AWAITED, Datagram, HostNs, ImuSample, Sweep
from tests.support import build

DEVICE, HOST = "127.0.0.1", "127.0.0.3"
LIMIT_S = 60.0  # generous: only a failure waits that long
VALUES = {
    "l2_ip": DEVICE, "host_ip": HOST, "UseSystemTimeTS": True, "enable_l2_host_sync": False,
    "imu_adjust": False, "aggregateNframes": 20,
}  # fmt: skip


class Running:
    """A session and the device at the other end of its socket."""

    def __init__(self, device: socket.socket, **values: Any) -> None:
        self.device = device
        (port,) = free_udp_ports(1)
        ports = {"l2_port": device.getsockname()[1], "host_port": port}
        config = configure(DriverConfig, VALUES | ports | values)
        self.address = (HOST, port)
        self.events: queue.Queue[Event] = queue.Queue()
        self.transport = UdpTransport(config.network)
        self.session = Session(Driver(config), self.transport, self.events.put)

    def send(self, *frames: bytes) -> None:
        for frame in frames:
            self.device.sendto(frame, self.address)

    def wait_for(self, kind: type, count: int = 1) -> list[Any]:
        """Return the next events of a kind; others are dropped."""
        found: list[Any] = []
        while len(found) < count:
            event = self.events.get(timeout=LIMIT_S)
            found += [event] if isinstance(event, kind) else []
        return found

    def rest(self) -> list[Event]:
        """Return all events that wait."""
        return [self.events.get_nowait() for _ in range(self.events.qsize())]

    def received(self, command: commands.Command) -> int:
        """Return the type of the command, once the device has received it."""
        while self.device.recvfrom(2000)[0] != command.encode():
            pass
        return command.packet_type

    def is_closed(self) -> bool:
        return self.transport._socket.fileno() < 0


@pytest.fixture
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the driver wait for an answer however long this test takes to give it."""
    monkeypatch.setattr(device_module, "REPEAT_NS", 10**12)


@pytest.fixture
def device() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind((DEVICE, 0))
        end.settimeout(LIMIT_S)
        yield end


@pytest.fixture
def running(device: socket.socket) -> Iterator[Running]:
    result = Running(device)
    result.session.start()
    yield result
    result.session.stop()


def test_datagrams_become_sweeps_and_samples_and_stop_hands_out_the_rest(running: Running) -> None:
    running.send(*(data for _, data in build.capture(0.5)))
    events: list[Event] = []
    while sum(isinstance(event, ImuSample) for event in events) < 125:
        events.append(running.events.get(timeout=LIMIT_S))
    running.session.stop()
    events += running.rest()
    stamps = [event.stamp for event in events if isinstance(event, ImuSample)]
    starts = [event.start for event in events if isinstance(event, Sweep)]
    assert stamps == sorted(stamps)
    assert starts == sorted(starts)
    sizes = [event.packets for event in events if isinstance(event, Sweep)]
    assert sum(sizes) == 108
    assert max(sizes) <= 20
    assert running.is_closed()
    assert running.session.failure is None


def test_a_stalled_stream_is_handed_out_without_being_asked(running: Running) -> None:
    running.send(*build.frames_3d(build.points_3d(seq, seq * 2_000_000) for seq in range(7)))
    packets = 0
    while packets < 7:
        packets += running.wait_for(Sweep)[0].packets
    assert packets == 7


def test_calls_run_in_the_loops_thread_and_return_or_raise(running: Running) -> None:
    def who(driver: Driver, now: HostNs) -> tuple[bool, str]:
        return now > build.EPOCH_NS, threading.current_thread().name

    assert running.session.call(who).result(LIMIT_S) == (True, "l2lidar-receive")

    def fail(driver: Driver, now: HostNs) -> None:
        raise KeyError("no such thing")

    with pytest.raises(KeyError, match="no such thing"):
        running.session.call(fail).result(LIMIT_S)
    assert running.session.failure is None


def test_a_call_that_nobody_wants_any_more_harms_nothing(running: Running) -> None:
    reached, go_on = threading.Event(), threading.Event()

    def held(*_: object) -> None:
        reached.set()
        go_on.wait(LIMIT_S)

    running.session.call(held)
    assert reached.wait(LIMIT_S)
    unwanted: Future[int] = running.session.call(lambda *_: 1)
    assert unwanted.cancel()
    wanted = running.session.call(lambda *_: 2)
    go_on.set()
    assert wanted.result(LIMIT_S) == 2


def test_a_command_reaches_the_device_and_its_ack_comes_back(
    unhurried: None, running: Running
) -> None:
    ticket = running.session.call(lambda driver, now: driver.start_rotation(now)).result(LIMIT_S)
    packet_type = running.received(commands.start())
    running.send(build.frame(wire.PacketType.ACK, build.ack(packet_type, 2, 0)))
    (answer,) = running.wait_for(Answer)
    assert (answer.ticket, answer.ok) == (ticket, True)
    assert answer.round_trip_ns is not None
    assert 0 < answer.round_trip_ns < LIMIT_S * 1e9


def test_a_device_that_answers_nothing_is_asked_again_and_given_up(running: Running) -> None:
    running.session.call(lambda driver, now: driver.start_rotation(now))
    for _ in range(TRIES):
        running.received(commands.start())
    (answer,) = running.wait_for(Answer)
    assert not answer.ok
    assert answer.text == "start rotation: the device did not acknowledge it"


def test_others_cannot_inject_samples_points_or_answers(unhurried: None, running: Running) -> None:
    """Everything is right about their packets but where they come from."""
    ticket = running.session.call(lambda driver, now: driver.start_rotation(now)).result(LIMIT_S)
    packet_type = running.received(commands.start())
    fakes = [
        build.frame(wire.PacketType.IMU, build.imu(500)),
        *build.frames_3d(build.points_3d(seq, seq * 2_000_000) for seq in range(30)),
        build.frame(wire.PacketType.ACK, build.ack(packet_type, 2, 0)),
        build.frame(wire.PacketType.VERSION, build.version()),
    ]
    for address in ("127.0.0.9", HOST):  # another machine's, and another program's on this host
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as foreigner:
            foreigner.bind((address, 0))
            for fake in fakes:
                foreigner.sendto(fake, running.address)
    running.send(build.frame(wire.PacketType.IMU, build.imu(0, acceleration=(1.0, 2.0, 3.0))))
    (sample,) = running.wait_for(ImuSample)
    assert sample.linear_acceleration == (1.0, 2.0, 3.0)
    assert running.transport.foreign == 2 * len(fakes)
    assert running.rest() == []
    running.send(build.frame(wire.PacketType.ACK, build.ack(packet_type, 2, 0)))
    (answer,) = running.wait_for(Answer)
    assert (answer.ticket, answer.ok) == (ticket, True)


def test_silence_comes_by_itself(device: socket.socket) -> None:
    running = Running(device, watchdog_timeout_ms=100)
    running.session.start()
    assert running.events.get(timeout=LIMIT_S).duration_ns > 100_000_000
    running.session.stop()


def test_calls_after_the_end_are_cancelled(running: Running) -> None:
    running.session.stop()
    with pytest.raises(CancelledError):
        running.session.call(lambda *_: 1).result(LIMIT_S)


def test_stopping_twice_and_without_a_start(device: socket.socket) -> None:
    running = Running(device)
    running.session.stop()
    assert running.is_closed()
    running.session.stop()


def test_a_receiver_may_stop_the_session(device: socket.socket) -> None:
    running = Running(device)
    seen = threading.Event()

    def stop(event: Event) -> None:
        running.session.stop()
        seen.set()

    session = Session(running.session.driver, running.transport, stop)
    running.session = session
    session.start()
    running.send(build.frame(wire.PacketType.IMU, build.imu()))
    assert seen.wait(LIMIT_S)
    session._thread.join(LIMIT_S)
    assert not session._thread.is_alive()
    assert running.is_closed()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_receiver_that_fails_ends_the_session_and_says_why(device: socket.socket) -> None:
    running = Running(device)

    def fail(event: Event) -> None:
        raise RuntimeError("publisher gone")

    session = Session(running.session.driver, running.transport, fail)
    session.start()
    waiting = session.call(lambda *_: threading.current_thread().name)
    assert waiting.result(LIMIT_S) == "l2lidar-receive"
    running.send(build.frame(wire.PacketType.IMU, build.imu()))
    session._thread.join(LIMIT_S)
    assert str(session.failure) == "publisher gone"
    assert running.is_closed()
    with pytest.raises(CancelledError):
        session.call(lambda *_: 1).result(LIMIT_S)
    session.stop()


class Scripted:
    """A transport that hands out what it was given, then nothing."""

    foreign = kernel_drops = send_errors = 0
    stranger = ""

    def __init__(self, *batches: list[Datagram]) -> None:
        self.batches = list(batches)
        self.sent: list[bytes] = []
        self.closed = 0
        self.is_empty = threading.Event()

    def receive(self, timeout_s: float, awaited: HostNs = NOT_AWAITED) -> list[Datagram]:
        del awaited
        if self.batches:
            return self.batches.pop(0)
        self.is_empty.set()
        return []

    def send(self, frame: bytes) -> None:
        self.sent.append(frame)

    def close(self) -> None:
        self.closed += 1


class Notes:
    """A tap that remembers what it is told."""

    def __init__(self) -> None:
        self.received_data: list[bytes] = []
        self.sent_frames: list[bytes] = []
        self.steps: list[int] = []
        self.closed = 0

    def received(self, data: bytes, arrival: HostNs) -> None:
        self.received_data.append(data)

    def sent(self, frame: bytes, at: HostNs) -> None:
        self.sent_frames.append(frame)

    def waited(self, until: HostNs) -> None:
        pass

    def stepped(self, by_ns: int, at: HostNs) -> None:
        self.steps.append(by_ns)

    def slewed(self, by_ns: int, at: HostNs) -> None:
        pass

    def close(self) -> None:
        self.closed += 1


def test_a_tap_hears_everything_in_both_directions() -> None:
    datagrams = [Datagram(data, HostNs(arrival)) for arrival, data in build.capture(0.2)]
    transport, notes = Scripted(datagrams[:50], datagrams[50:]), Notes()
    events: list[Event] = []
    driver = Driver(configure(DriverConfig, VALUES))
    session = Session(driver, transport, events.append, notes)
    session.call(lambda driver, now: driver.start_rotation(now))
    session.start()
    assert transport.is_empty.wait(LIMIT_S)
    session.stop()
    assert notes.received_data == [item.data for item in datagrams]
    assert notes.sent_frames == transport.sent
    assert commands.start().encode() in transport.sent
    assert notes.steps == [0]  # the clock is watched, and nobody set it
    assert (notes.closed, transport.closed) == (1, 1)
    assert sum(isinstance(event, ImuSample) for event in events) == 50
