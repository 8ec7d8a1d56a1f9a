"""Recordings of one L2 and their replay: data and commands with their times.

A recording runs through a driver at once (:func:`events`) or at its own pace in a thread
(:class:`Playback`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

from l2lidar_node.config import DriverConfig, NetworkConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.commands import Command, recorded
from l2lidar_node.protocol.framing import Frame, Framer
from l2lidar_node.recording.capture import (
    CaptureError,
    CaptureReader,
    CaptureWriter,
    Endpoint,
    UdpDatagram,
)
from l2lidar_node.recording.pacing import TimeLine
from l2lidar_node.transport.session import Loop
from l2lidar_node.types import (
    LAST_STAMP,
    NOT_AWAITED,
    Datagram,
    HostNs,
    ImuSample,
    Sweep,
    is_ros_time,
)

WAITED: Final = b"l2lidar_node: nothing that was due is waited for from here on"
"""Content of the datagram, from the host to itself, that stands for :class:`Waited`."""

STEPPED: Final = b"l2lidar_node: the host's clock was set by %+d ns"
"""Likewise for :class:`Stepped`."""

SLEWED: Final = b"l2lidar_node: the host's clock was slewed by %+d ns since the host started"
"""Likewise for :class:`Slewed`."""


def _pattern(note: bytes) -> re.Pattern[bytes]:
    return re.compile(re.escape(note).replace(re.escape(b"%+d"), rb"([+-][0-9]{1,19})"))


_STEP: Final = _pattern(STEPPED)
_SLEW: Final = _pattern(SLEWED)

LAP_GAP_NS: Final = 5_000_000  # between the last datagram of a lap and the first of the next
_CLOCK_NS: Final = 10_000_000
_LOOK_S: Final = 0.01  # longest time between two looks at calls and stop
_FORESEEN: Final = 512  # entries; twice what a session reads before it looks for a step
_FROM_DEVICE: Final = frozenset(
    int(kind)
    for kind in (
        wire.PacketType.ACK,
        wire.PacketType.POINTS_3D,
        wire.PacketType.POINTS_2D,
        wire.PacketType.IMU,
        wire.PacketType.VERSION,
        wire.PacketType.PARAMETERS,
    )
)
_ENOUGH: Final = 2_000  # datagrams of L2s after which no further one is looked for
_IN_FLIGHT_NS: Final = 50_000_000  # from making a sync to seeing it on the network, at most


class Received(NamedTuple):
    """Bytes that came from the device, and when."""

    data: bytes
    time: HostNs


class Sent(NamedTuple):
    """A command that was sent to the device, and when."""

    command: Command
    time: HostNs


class Waited(NamedTuple):
    """The instant until which the driver had waited when it gave up on what was due."""

    time: HostNs


class Stepped(NamedTuple):
    """Step of the host's clock [ns], and the time at which the driver was told."""

    by_ns: int
    time: HostNs


class Slewed(NamedTuple):
    """How far slewing had moved the host's clock [ns] when the driver was told."""

    by_ns: int
    time: HostNs


Entry = Received | Sent | Waited | Stepped | Slewed


class Recording:
    """The part of a capture that belongs to one L2.

    Parameters
    ----------
    stream : binary file
        Seekable, pcap or pcapng; read anew for every iteration.
    l2_ip : str
        Whose packets to take if there are those of several. With only one L2 in the capture it is
        taken whatever its address, unless ``is_selected``.
    is_selected : bool
        Whether a user asked for this L2, rather than a parameter that is always set.

    Attributes
    ----------
    device : Endpoint
        The L2.
    host : Endpoint
        Whom it sent to.
    start : HostNs
        Time of the first datagram of the L2.

    Raises
    ------
    CaptureError
        If this is no capture, or there is no L2 in it, or several and none has ``l2_ip``; while
        iterating, where the file is damaged.
    """

    def __init__(self, stream: BinaryIO, l2_ip: str = "", *, is_selected: bool = False) -> None:
        self._stream = stream
        self._reader = CaptureReader(stream)
        talks: Counter[tuple[Endpoint, Endpoint]] = Counter()
        starts: dict[Endpoint, HostNs] = {}
        seen: Counter[Endpoint] = Counter()
        try:
            for datagram in islice(_of_devices(self._from_start(), seen), _ENOUGH):
                talks[datagram.source, datagram.destination] += 1
                starts.setdefault(datagram.source, datagram.time)
        except CaptureError:
            if not talks:  # what is before the damage can be used
                raise
        self.device, self.host = _chosen(talks, l2_ip, seen, self._reader)
        if is_selected and l2_ip not in ("", self.device.ip):
            raise CaptureError(f"it has no packets of an L2 at {l2_ip}, only {self.device.ip}")
        self.start = starts[self.device]

    @property
    def is_cut_off(self) -> bool:
        """Whether the file, read to its end, ended within a packet."""
        return self._reader.is_cut_off

    @property
    def position(self) -> int:
        """How much of the file has been read [B]."""
        return self._stream.tell()

    def __iter__(self) -> Iterator[Entry]:
        """Yield everything in the order of the capture."""
        framer = Framer()
        for datagram in self._from_start():
            is_for_host = datagram.destination == self.host
            if datagram.source != self.host:
                # As on a live socket the address counts, not the port. Cooked captures of the
                # loopback interface show everything twice.
                is_device = datagram.source.ip == self.device.ip
                if is_device and is_for_host and not datagram.outgoing:
                    yield Received(datagram.data, datagram.time)
            elif is_for_host:
                note = _noted(datagram.data, datagram.time)
                if note is not None:
                    yield note
            elif datagram.destination == self.device and datagram.outgoing is not False:
                for item in framer.feed(datagram.data):
                    if isinstance(item, Frame):
                        yield from _sent(item, datagram.time)

    def close(self) -> None:
        """Close the stream; may be called more than once."""
        self._stream.close()

    def _from_start(self) -> Iterator[UdpDatagram]:
        self._stream.seek(0)
        self._reader = CaptureReader(self._stream)
        return iter(self._reader)


class RecordingWriter:
    """Writes a capture that :class:`Recording` reads.

    Parameters
    ----------
    stream : binary file
        At its beginning.
    device, host : Endpoint
    """

    def __init__(self, stream: BinaryIO, device: Endpoint, host: Endpoint) -> None:
        self._capture = CaptureWriter(stream)
        self._device = device
        self._host = host

    def received(self, data: bytes, arrival: HostNs) -> None:
        """Append bytes that came from the device."""
        self._capture.write(UdpDatagram(arrival, self._device, self._host, data))

    def sent(self, frame: bytes, at: HostNs) -> None:
        """Append a frame that goes to the device."""
        self._capture.write(UdpDatagram(at, self._host, self._device, frame))

    def waited(self, until: HostNs) -> None:
        """Append that the driver gave up waiting."""
        self._capture.write(UdpDatagram(until, self._host, self._host, WAITED))

    def stepped(self, by_ns: int, at: HostNs) -> None:
        """Append a step of the host's clock."""
        self._capture.write(UdpDatagram(at, self._host, self._host, STEPPED % by_ns))

    def slewed(self, by_ns: int, at: HostNs) -> None:
        """Append the slewing of the host's clock."""
        self._capture.write(UdpDatagram(at, self._host, self._host, SLEWED % by_ns))


def written(entry: Entry) -> tuple[str, tuple[Any, ...]]:
    """Return the method of :class:`RecordingWriter` that appends an entry, and its arguments."""
    if isinstance(entry, Received):
        return "received", (entry.data, entry.time)
    if isinstance(entry, Sent):
        return "sent", (entry.command.encode(), entry.time)
    if isinstance(entry, Stepped):
        return "stepped", (entry.by_ns, entry.time)
    if isinstance(entry, Slewed):
        return "slewed", (entry.by_ns, entry.time)
    return "waited", (entry.time,)


def _noted(data: bytes, time: HostNs) -> Waited | Stepped | Slewed | None:
    """Return the note in a datagram from the host to itself."""
    if data == WAITED:
        return Waited(time)
    step = _STEP.fullmatch(data)
    if step is not None:
        return Stepped(int(step[1]), time)
    slew = _SLEW.fullmatch(data)
    return None if slew is None else Slewed(int(slew[1]), time)


def _sent(frame: Frame, time: HostNs) -> Iterator[Sent]:
    command = recorded(frame.packet_type, frame.payload)
    if command is None:
        return
    # It was captured a little after it was made, and the driver counts from then.
    made = command.time
    if made is not None and 0 <= time - made < _IN_FLIGHT_NS:
        time = made
    yield Sent(command, time)


def _of_devices(
    datagrams: Iterator[UdpDatagram], seen: Counter[Endpoint]
) -> Iterator[UdpDatagram]:
    for datagram in datagrams:
        seen[datagram.destination] += 1
        header = datagram.data[: wire.HEADER.size]
        if len(header) == wire.HEADER.size:
            magic, packet_type, _ = wire.HEADER.unpack(header)
            if magic == wire.MAGIC and packet_type in _FROM_DEVICE:
                yield datagram


def _chosen(
    talks: Counter[tuple[Endpoint, Endpoint]],
    l2_ip: str,
    seen: Counter[Endpoint],
    reader: CaptureReader,
) -> tuple[Endpoint, Endpoint]:
    if not talks:
        ports = ", ".join(f"{count} to port {end.port}" for end, count in seen.most_common(3))
        others = ", ".join(f"{count} {reason}" for reason, count in reader.ignored.most_common(3))
        found = f"{sum(seen.values())} UDP datagrams" + (f" ({ports})" if ports else "")
        raise CaptureError(
            f"it has no L2 packets, only {found}" + (f"; packets {others}" if others else "")
        )
    devices = sorted({source.ip for source, _ in talks})
    if l2_ip not in devices and len(devices) > 1:
        raise CaptureError(
            f"it has packets of several L2s ({', '.join(devices)}); select one with l2_ip"
        )
    wanted = l2_ip if l2_ip in devices else devices[0]
    return max((talk for talk in talks if talk[0].ip == wanted), key=lambda talk: talks[talk])


_BUFFER: Final = 1 << 20
_FLUSH_NS: Final = 1_000_000_000  # so much at most is lost when the process is killed


class Recorder:
    """A session's tap that writes a pcap file continuously.

    Parameters
    ----------
    path : Path
        Must not exist yet; missing folders are made.
    network : NetworkConfig
        Addresses that the capture names.
    on_error : callable
        Called once, with a sentence, when the file cannot be written any further.

    Attributes
    ----------
    octets : int
        Size of the file so far.
    datagrams : int
        How many have come from the device.

    Raises
    ------
    OSError
        If the file cannot be made; :class:`FileExistsError` if there is one.
    """

    def __init__(
        self, path: Path, network: NetworkConfig, on_error: Callable[[str], None]
    ) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.octets = 0
        self.datagrams = 0
        self._on_error = on_error
        self._file = path.open("xb", buffering=_BUFFER)
        self._is_open = True
        self._flushed = HostNs(0)
        device, host = endpoints(network)
        try:
            self._writer = RecordingWriter(self._file, device, host)
            self._file.flush()
        except OSError:
            # nothing came into the file: an empty one would stand in the way of the next attempt
            with contextlib.suppress(OSError):
                self._file.close()
            path.unlink(missing_ok=True)
            raise

    def received(self, data: bytes, arrival: HostNs) -> None:
        """Write bytes that came from the device."""
        self.datagrams += 1
        self._write(lambda: self._writer.received(data, arrival), arrival)

    def sent(self, frame: bytes, at: HostNs) -> None:
        """Write a frame that goes to the device."""
        self._write(lambda: self._writer.sent(frame, at), at)

    def waited(self, until: HostNs) -> None:
        """Write that the driver gave up waiting."""
        self._write(lambda: self._writer.waited(until), until)

    def stepped(self, by_ns: int, at: HostNs) -> None:
        """Write a step of the host's clock."""
        self._write(lambda: self._writer.stepped(by_ns, at), at)

    def slewed(self, by_ns: int, at: HostNs) -> None:
        """Write the slewing of the host's clock."""
        self._write(lambda: self._writer.slewed(by_ns, at), at)

    def close(self) -> None:
        """Write the rest and close the file; may be called more than once."""
        if self._is_open:
            self._is_open = False
            try:
                self._file.close()
            except OSError as error:
                self._fail(error)

    def _write(self, write: Callable[[], None], now: HostNs) -> None:
        if not self._is_open:
            return
        try:
            write()
            self.octets = self._file.tell()
            if not 0 <= now - self._flushed < _FLUSH_NS:
                self._flushed = now
                self._file.flush()
        except OSError as error:
            self._is_open = False
            # Closing tries to write the rest once more.
            with contextlib.suppress(OSError):
                self._file.close()
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self._on_error(f"recording to {self.path} ended: {error.strerror}")


def endpoints(network: NetworkConfig) -> tuple[Endpoint, Endpoint]:
    """Return the device's end and this host's as they look on the network."""
    device = Endpoint(network.l2_ip, network.l2_port)
    host_ip = network.host_ip
    if host_ip == "0.0.0.0":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(device)
                host_ip = probe.getsockname()[0]
            except OSError:
                host_ip = wire.HOST_IP
    return device, Endpoint(host_ip, network.host_port)


def feed(driver: Driver, entry: Entry) -> list[Event]:
    """Return the events of a driver for an entry of a recording.

    Raises
    ------
    CaptureError
        If its time is beyond what a ROS 2 stamp can hold.
    """
    _checked(entry)
    if isinstance(entry, Received):
        return driver.receive(entry.data, entry.time)
    if isinstance(entry, Sent):
        return driver.sent(entry.command, entry.time)
    if isinstance(entry, Stepped):
        return driver.host_stepped(entry.by_ns, entry.time)
    if isinstance(entry, Slewed):
        driver.host_slewed(entry.by_ns, entry.time)
        return []
    return driver.settle(entry.time)


def _checked(entry: Entry) -> Entry:
    if not is_ros_time(entry.time):
        raise CaptureError(
            f"its times reach {entry.time // 1_000_000_000} s after 1970; stamps of ROS 2 end at "
            f"{(LAST_STAMP + 1) // 1_000_000_000} s, in January 2038; check whether the clock of "
            "that machine was set"
        )
    return entry


def events(recording: Recording, config: DriverConfig) -> Iterator[Event]:
    """Yield everything a driver hands out for a recording, in order.

    Parameters
    ----------
    recording : Recording
    config : DriverConfig
        The settings of the live run give what it gave; others decode the same data otherwise.
    """
    driver = Driver(config)
    for entry in recording:
        yield from feed(driver, entry)
    yield from driver.flush()


def measurements(
    recording: Recording, config: DriverConfig
) -> Iterator[tuple[HostNs, Sweep | ImuSample]]:
    """Yield sweeps and IMU samples, each with the time at which a driver could hand it out.

    Parameters
    ----------
    recording : Recording
    config : DriverConfig
        See :func:`events`.
    """
    driver = Driver(config)
    now = recording.start
    for entry in recording:
        now = entry.time
        for event in feed(driver, entry):
            if isinstance(event, Sweep | ImuSample):
                yield now, event
    for event in driver.flush():
        if isinstance(event, Sweep | ImuSample):
            yield now, event


def shifted(event: Event, by_ns: int) -> Event:
    """Return an event as if it had happened that much later."""
    if isinstance(event, Sweep):
        return dataclasses.replace(
            event, start=HostNs(event.start + by_ns), end=HostNs(event.end + by_ns)
        )
    if isinstance(event, ImuSample):
        return event._replace(stamp=HostNs(event.stamp + by_ns))
    return event


class NoTransport:
    """Transport of a recording, which has none."""

    foreign = 0
    stranger = ""
    kernel_drops = 0
    send_errors = 0

    def receive(self, timeout_s: float, awaited: HostNs = NOT_AWAITED) -> list[Datagram]:
        """Return nothing."""
        del timeout_s, awaited
        return []

    def send(self, frame: bytes) -> None:
        """Send nothing: there is no device."""

    def close(self) -> None:
        """Do nothing."""


def timed(entries: Iterable[Entry], line: TimeLine) -> Iterator[tuple[Entry, int]]:
    """Yield the entries of a recording, each with when it is due.

    Parameters
    ----------
    entries : iterable of Entry
        Such as a :class:`Recording`.
    line : TimeLine
        Told of each step some entries before its note.

    Yields
    ------
    entry : Entry
    due_ns : int
        After the first datagram, at the pace of the recording [ns].

    Raises
    ------
    CaptureError
        Where the recording is damaged, after all before that.
    """
    coming: deque[Entry] = deque()
    damage: CaptureError | None = None
    try:
        for entry in entries:
            if isinstance(entry, Stepped):
                line.foresee(entry.by_ns)
            coming.append(entry)
            if len(coming) > _FORESEEN:
                yield _placed(coming.popleft(), line)
    except CaptureError as error:
        damage = error
    while coming:
        yield _placed(coming.popleft(), line)
    if damage is not None:
        raise damage


def _placed(entry: Entry, line: TimeLine) -> tuple[Entry, int]:
    if isinstance(entry, Received) and not line.has_begun:
        line.begin(entry.time)
    elif isinstance(entry, Stepped):
        line.step()
    return entry, line.place(entry.time)


class Playback(Loop):
    """The session of a recording instead of a device.

    Parameters
    ----------
    recording : Recording
        Closed when the loop ends.
    config : DriverConfig
        With ``replay_rate`` and ``replay_loop``.
    on_event : callable
        Called in the loop's thread with everything that happens, in order.
    on_time : callable
        Called with the recording's time every 10 ms of it, before what happens then.
    on_lap : callable
        Called at the end of each lap with the nanoseconds by which all that follows is later than
        recorded; None after the last one.

    Attributes
    ----------
    damage : str
        Why the recording could not be read to its end; empty while it could.

    Notes
    -----
    Each lap begins with a new driver, so all give the same, each later by the length of those
    before it: stamps never go backwards.

    Entries come at the pace at which they were recorded, also where the host's clock was set
    meanwhile, but a pause of more than a minute lasts a minute.
    """

    def __init__(
        self,
        recording: Recording,
        config: DriverConfig,
        on_event: Callable[[Event], None],
        on_time: Callable[[HostNs], None],
        on_lap: Callable[[int | None], None],
    ) -> None:
        super().__init__(Driver(config), NoTransport(), on_event)
        self._recording = recording
        self._rate = config.files.replay_rate
        self._is_loop = config.files.replay_loop
        self._on_time = on_time
        self._on_lap = on_lap
        self._time = recording.start
        self._reached = recording.start  # the latest time of the lap
        self._shift_ns = 0
        self.damage = ""

    def stamp(self, now: HostNs) -> HostNs:
        """Return a time of the driver, later by the laps before, as events are stamped."""
        return HostNs(now + self._shift_ns)

    def _now(self) -> HostNs:
        """Return the recording's own time: the driver knows no other."""
        return self._time

    def _work(self) -> None:
        while True:
            self._play()
            if self._stopping.is_set():
                return
            if not self._is_loop:
                self._on_lap(None)
                return
            self._shift_ns += self._reached - self._recording.start + LAP_GAP_NS
            self._on_lap(self._shift_ns)
            self._time = self._reached = self._recording.start
            self.driver = Driver(self.driver.config, self.driver.blocks.file)

    def _release(self) -> None:
        super()._release()
        self._recording.close()

    def _play(self) -> None:
        line = TimeLine(self._recording.start)
        begun = time.monotonic()
        next_clock = 0
        for entry, due_ns in self._entries(line):
            if self._rate:
                self._wait(begun + due_ns / (1e9 * self._rate))
            self._run_calls()
            if self._stopping.is_set():
                break
            self._time = line.now
            self._reached = max(self._reached, entry.time)
            if self._reached >= next_clock:
                next_clock = self._reached + _CLOCK_NS
                self._on_time(HostNs(self._reached + self._shift_ns))
            self._give(feed(self.driver, entry))
        self._give(self.driver.flush())

    def _entries(self, line: TimeLine) -> Iterator[tuple[Entry, int]]:
        try:
            # before they are waited for
            yield from timed(map(_checked, self._recording), line)
        except CaptureError as error:
            self.damage = str(error)

    def _wait(self, until: float) -> None:
        while (left := until - time.monotonic()) > 0 and not self._stopping.is_set():
            self._stopping.wait(min(left, _LOOK_S))
            self._run_calls()

    def _give(self, events: list[Event]) -> None:
        shift = self._shift_ns
        self._hand_out([shifted(event, shift) for event in events] if shift else events)
