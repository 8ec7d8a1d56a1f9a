"""Driver core: bytes with arrival times in, sweeps and IMU samples out; no socket.

Every method takes the time as an argument and returns what happened. What comes out depends on
the calls of :meth:`Driver.receive`, :meth:`Driver.sent`, :meth:`Driver.settle`,
:meth:`Driver.host_stepped` and :meth:`Driver.host_slewed`, their order and their arguments alone,
so a recording of those gives what the live sensor gave, bit for bit.
"""

from __future__ import annotations

import dataclasses
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from l2lidar_node.calibration.file import CalibrationFile
from l2lidar_node.clock import ClockEvent, ClockStatus, DeviceClock
from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.deferred import DeferredPoints
from l2lidar_node.driver.device import Answer, CommandClient, DeviceState, QuerySchedule, Watchdog
from l2lidar_node.driver.orientation import GravityAlignment, GravityMonitor
from l2lidar_node.driver.reorder import (
    REORDER_NS,
    Released,
    ReorderBuffer,
    SequenceCounts,
    Timed,
)
from l2lidar_node.driver.sweep import (
    MAX_GAP_NS,
    BlockChoice,
    Level,
    SweepAssembler,
    calibration_file,
)
from l2lidar_node.protocol import commands, wire
from l2lidar_node.protocol.commands import Command
from l2lidar_node.protocol.framing import FrameError, Framer
from l2lidar_node.protocol.packets import (
    Ack,
    DecodeError,
    ImuPacket,
    Packet,
    Parameters,
    PointPacket,
    Version,
    decode,
    decode_imu,
    decode_points,
)
from l2lidar_node.types import F64, Datagram, HostNs, ImuSample, Stream, Sweep, new_tuple


@dataclass(slots=True)
class Counters:
    """Counts since the start.

    Attributes
    ----------
    datagrams, octets : int
        What came from the device.
    frames : Counter
        Good frames by packet type; 0 stands for every type that is not known.
    faults : Counter
        Damaged frames by kind, see :class:`l2lidar_node.protocol.framing.Fault`.
    skipped_octets : int
        Bytes that belonged to no good frame.
    rejected : Counter
        Good frames with impossible content, by ``<packet type>.<reason>``.
    sequence : dict
        Counts of :class:`SequenceCounts` by stream.
    unlocked : Counter
        Packets not used because the clock could not tell their time yet, by stream.
    ignored_points : int
        Packets of the dimension (2D or 3D) that was not asked for.
    sweeps, empty_sweeps, samples : int
        What was made; an empty sweep has no valid point and is not published.
    fragments, fragment_packets : int
        Parts of a turn or half turn that were not made into a sweep, and their packets.
    points : int
        Points in all sweeps.
    slots : int
        Slots measured in all sweeps, with a return or without.
    stray_acks : int
        ACKs that belong to no command that waits for one.
    unleveled : int
        Points left out because ``imu_adjust`` had no orientation for them.
    """

    datagrams: int = 0
    octets: int = 0
    frames: Counter[int] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    skipped_octets: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    sequence: dict[Stream, SequenceCounts] = field(default_factory=dict)
    unlocked: Counter[Stream] = field(default_factory=Counter)
    ignored_points: int = 0
    sweeps: int = 0
    empty_sweeps: int = 0
    fragments: int = 0
    fragment_packets: int = 0
    samples: int = 0
    points: int = 0
    slots: int = 0
    stray_acks: int = 0
    unleveled: int = 0

    def snapshot(self) -> Counters:
        """Return a copy that does not change any more."""
        return dataclasses.replace(
            self,
            frames=Counter(self.frames),
            faults=Counter(self.faults),
            rejected=Counter(self.rejected),
            unlocked=Counter(self.unlocked),
            sequence={key: dataclasses.replace(value) for key, value in self.sequence.items()},
        )


_ROUND_TRIPS: Final = 60  # the last minute's
_POINTS_PERIOD_NS: Final = round(wire.MIRROR_PERIOD_S * 1e9)
_IMU_PERIOD_NS: Final = round(1e9 / wire.IMU_RATE_HZ)
_FOREVER_NS: Final = 1 << 62
# Looking up a member of an Enum takes long.
_IMU, _POINTS, _POINTS_3D = Stream.IMU, Stream.POINTS, wire.PacketType.POINTS_3D
_SAMPLES_AT_ONCE: Final = 64  # are handed on, at most
_IMU_TYPE: Final = int(wire.PacketType.IMU)
_IMU_SIZE: Final = wire.FRAME_SIZES[_IMU_TYPE]


@dataclass(frozen=True, slots=True)
class Silence:
    """The device has been silent for longer than the watchdog allows."""

    duration_ns: int


class Outgoing(NamedTuple):
    """A frame for the device, and the instant at which the driver counts it as sent."""

    frame: bytes
    at: HostNs


Event = Sweep | ImuSample | Version | Parameters | Answer | ClockEvent | Silence


class Driver:
    """One device: its byte stream, its clock, its sweeps, its commands.

    Parameters
    ----------
    config : DriverConfig
    calibration : CalibrationFile, optional
        Of the unit; read from the file that the settings name if left out.

    Raises
    ------
    SettingError
        If the calibration file cannot be used.
    """

    def __init__(self, config: DriverConfig, calibration: CalibrationFile | None = None) -> None:
        self.counters = Counters()
        self.version: Version | None = None
        self.parameters: Parameters | None = None
        self.last_points: bytes | None = None
        self._gravity = GravityMonitor()
        self._samples: list[ImuSample] = []  # not yet with those that use them
        self._last_imu: ImuSample | None = None
        self.round_trips: deque[int] = deque(maxlen=_ROUND_TRIPS)
        self._config = config
        self._imu_wait_ns = _imu_wait_ns(config)
        self._framer = Framer()
        self._reorder_buffer = ReorderBuffer(config.sweep.reorder_window)
        self._deferred = DeferredPoints()
        self._points_size = _points_size(config)
        self._owed: list[Event] = []  # made where nothing could be returned
        self.counters.sequence = self._reorder_buffer.counts
        self._clock = DeviceClock(config.clock)
        self._gravity_alignment = GravityAlignment(config.imu.roll_pitch_only)
        self.blocks = BlockChoice(config.sweep, calibration or calibration_file(config.files))
        self._assembler = SweepAssembler(config.sweep, self._level(), self.blocks)
        self._requests = CommandClient()
        self._watchdog = Watchdog(config.watchdog)
        self._outbox: list[Outgoing] = []
        self._queries = QuerySchedule(config.clock.enable_latency_measure)

    @property
    def config(self) -> DriverConfig:
        """The settings in force."""
        return self._config

    @property
    def last_imu(self) -> ImuSample | None:
        """The latest sample; None before there was one."""
        self._hand_on()
        return self._last_imu

    @property
    def gravity(self) -> GravityMonitor:
        """Gravity check of the samples."""
        self._hand_on()
        return self._gravity

    def receive(self, data: bytes, arrival: HostNs) -> list[Event]:
        """Return what the bytes of one datagram complete.

        Parameters
        ----------
        data : bytes
            As they came from the device, cut anywhere.
        arrival : HostNs
            When they reached this host, at best as the kernel noted it.
        """
        counters = self.counters
        counters.datagrams += 1
        counters.octets += len(data)
        if len(data) != self._points_size:
            events = self._take(data, arrival)
        elif self._deferred.takes(data, arrival):
            return []
        else:
            events = self._take(data, arrival)
            self._defer_next()
        if self._owed:
            events = self.catch_up() + events
        return events

    def catch_up(self) -> list[Event]:
        """Return what the packets of points make that have been put off.

        What the driver returns is the same whenever, and however often, this is called; but
        counters and states are those of now only after it.
        """
        events, self._owed = self._owed, []
        waiting = self._deferred.taken()
        if waiting:
            events += self._take_together(waiting)
        return events

    def _take_together(self, waiting: list[Datagram]) -> list[Event]:
        """Do what :meth:`_take` does with datagrams that were put off, one by one."""
        packets = decode_points(waiting)
        if packets is None or not self._reorder_buffer.all_follow(
            Timed(packets[0], waiting[0].arrival), Timed(packets[-1], waiting[-1].arrival)
        ):
            return [event for datagram in waiting for event in self._take(*datagram)]
        self.counters.frames[packets[0].packet_type] += len(packets)
        self._watchdog.heard(_POINTS, waiting[-1].arrival)
        events: list[Event] = []
        for packet, (_, arrival) in zip(packets, waiting, strict=True):
            events += self._points(packet, arrival)
            if self._clock.happened:
                events += self._clock.events()
        return events

    def _take(self, data: bytes, arrival: HostNs) -> list[Event]:
        events: list[Event] = []
        deferred, counters = self._deferred, self.counters
        # An IMU sample shows by its stamp and number whether it can go first.
        if deferred.waiting and (len(data) != _IMU_SIZE or arrival - deferred.newest > REORDER_NS):
            events = self.catch_up()
        if not deferred.waiting and not self._reorder_buffer.is_flowing(arrival):
            events += self.settle(arrival)
        if len(data) == _IMU_SIZE:
            sample = decode_imu(data)
            if sample is not None:
                counters.frames[_IMU_TYPE] += 1
                events += self._handle(sample, arrival)
                if self._clock.happened:
                    events += self._clock.events()
                return events
        for item in self._framer.feed(data):
            if isinstance(item, FrameError):
                counters.faults[item.fault.value] += 1
                counters.skipped_octets += item.skipped
                continue
            counters.frames[item.packet_type if item.packet_type in wire.FRAME_SIZES else 0] += 1
            events += self._handle(decode(item), arrival)
        if self._clock.happened:
            events += self._clock.events()
        return events

    def tick(self, now: HostNs, heard_until: HostNs | None = None) -> list[Event]:
        """Return what is due by now; to be called every few milliseconds.

        Parameters
        ----------
        now : HostNs
        heard_until : HostNs, optional
            Instant up to which everything that arrived has been handed to :meth:`receive`: where
            the host is behind, a packet that still waits in the socket is not late. ``now`` if
            left out.
        """
        events = self.settle(now if heard_until is None else heard_until)
        events += self._send_due(now)
        if self._deferred.waiting:
            self._watchdog.heard(_POINTS, self._deferred.newest)
        if self._watchdog.expired(now):
            events.append(Silence(self._watchdog.silence_ns(now)))
        return events

    def settle(self, until: HostNs) -> list[Event]:
        """Return what need not wait any longer, nothing more having arrived until then.

        Packets that waited :data:`~l2lidar_node.driver.reorder.REORDER_NS` for an earlier one, and
        the sweep of a stream of points that paused for :data:`MAX_GAP_NS`, unless it is a turn.
        """
        if self._deferred.waiting:
            is_flowing = until - self._deferred.newest <= REORDER_NS
        else:
            is_flowing = self._reorder_buffer.is_flowing(until)
        if is_flowing and not self._owed:
            return []
        events = self.catch_up()
        events += self._released(self._reorder_buffer.settle(until))
        if self._has_stalled(until):
            events += self._finished(self._assembler.flush())
        return events

    def host_stepped(self, by_ns: int, at: HostNs) -> list[Event]:
        """Record a step of the clock of arrivals, which shows ``at``; return the events.

        A step of 0 announces that steps will be reported. Without reports they are inferred.
        """
        events = self.catch_up()
        self._clock.host_stepped(by_ns, at)
        return events + self._clock.events()

    def host_slewed(self, by_ns: int, at: HostNs) -> None:
        """Record the total slewing of the clock of arrivals.

        To be called whenever the last two calls do not predict it; see
        :meth:`DeviceClock.host_slewed`.
        """
        self._owed = self.catch_up()
        self._clock.host_slewed(by_ns, at)

    def is_overdue(self, until: HostNs) -> bool:
        """Tell whether :meth:`settle` would do anything."""
        if self._deferred.waiting:
            return until - self._deferred.newest > REORDER_NS
        return self._reorder_buffer.is_overdue(until) or self._has_stalled(until)

    def awaited(self) -> HostNs:
        """Return when it is worth while to look for datagrams.

        When the packet is expected that completes a sweep, and ``receive_interval_ms`` after the
        next IMU sample is, if samples are published. Something else may wait longer.
        """
        points, imu = self._reorder_buffer.last_arrivals
        due = self._deferred.due
        if not due:
            due = HostNs(points + self._assembler.packets_left * _POINTS_PERIOD_NS)
        sample = imu + self._imu_wait_ns
        return HostNs(sample) if sample < due else due

    def outbox(self) -> list[Outgoing]:
        """Return the frames to send now, in order, once."""
        frames, self._outbox = self._outbox, []
        return frames

    def send(self, command: Command, now: HostNs) -> int:
        """Queue a command and return the ticket that its :class:`Answer` will carry."""
        self._outbox.append(Outgoing(command.encode(), now))
        if not command.acknowledged:
            return 0
        return self._requests.add(command, now)

    def sent(self, command: Command, at: HostNs) -> list[Event]:
        """Do what sending a command does to the driver itself; return what it completes.

        The driver calls it for everything it sends. A replay calls it for the
        recorded commands.
        """
        if command.is_latency:
            self._requests.add(command, at, tries=1)
            return []
        events = self.catch_up()
        if command.time is not None:
            self._clock.synced(command.time, at)
        elif command.is_start:
            self._watchdog.started(at)
            self._reorder_buffer.forget()
        elif command.is_standby:
            self._watchdog.stopped(at)
            events += self.flush()
        elif command.is_reset:
            self._watchdog.started(at)
            events += self.flush()
            self._reorder_buffer.forget()
            self._forget_device()
        return events

    def start_rotation(self, now: HostNs) -> int:
        """Queue the command to leave standby; return its ticket."""
        self._owed = self.sent(commands.start(), now)
        return self.send(commands.start(), now)

    def stop_rotation(self, now: HostNs) -> tuple[int, list[Event]]:
        """Queue the command for standby; return its ticket and what had been collected so far."""
        return self.send(commands.standby(), now), self.sent(commands.standby(), now)

    def reset_device(self, now: HostNs) -> list[Event]:
        """Queue the command to reboot and return what had been collected so far."""
        self.send(commands.reset(), now)
        return self.sent(commands.reset(), now)

    def flush(self) -> list[Event]:
        """Return everything that is still being collected."""
        events = self.catch_up()
        events += self._released(self._reorder_buffer.flush())
        return events + self._finished(self._assembler.flush())

    def configure(self, config: DriverConfig) -> None:
        """Use other live settings from the next packet on."""
        self._owed = self.catch_up()
        self._config = config
        self._points_size = _points_size(config)
        self._gravity_alignment.roll_pitch_only = config.imu.roll_pitch_only
        self._assembler.configure(config.sweep, self._level())
        self._clock.configure(config.clock)

    def clock_status(self) -> ClockStatus:
        """Return what is known about the device's clock."""
        return self._clock.status()

    def state(self, now: HostNs) -> DeviceState:
        """Return what the device is doing."""
        return self._watchdog.state(now)

    def is_there(self, now: HostNs) -> bool:
        """Tell whether the device was heard in the last seconds, or is silent as told."""
        return self._watchdog.is_there(now)

    def spin_up_left_s(self, now: HostNs) -> float:
        """Return the seconds until points can be expected."""
        return self._watchdog.spin_up_left_s(now)

    def _level(self) -> Level | None:
        return self._leveled if self._config.imu.adjust else None

    def _handle(self, packet: Packet, arrival: HostNs) -> list[Event]:
        if isinstance(packet, ImuPacket):
            self._watchdog.heard(_IMU, arrival)
            deferred = self._deferred
            if deferred.waiting and (
                packet.stamp >= deferred.until
                or not self._clock.predicts_imu(packet.seq, packet.stamp)
            ):
                events = self.catch_up()
                events += self._handle(packet, arrival)
                self._defer_next()
                return events
            if self._reorder_buffer.follows(_IMU, packet, arrival):
                return self._imu(packet, arrival)
            events = self.catch_up() if deferred.waiting else []
            return events + self._reordered(_IMU, packet, arrival)
        if isinstance(packet, PointPacket):
            self._watchdog.heard(_POINTS, arrival)
            if (packet.packet_type == _POINTS_3D) != self._config.sweep.frame3d:
                self.counters.ignored_points += 1
                return []
            if self._reorder_buffer.follows(_POINTS, packet, arrival):
                return self._points(packet, arrival)
            return self._reordered(_POINTS, packet, arrival)
        if isinstance(packet, Ack):
            return self._acknowledged(packet, arrival)
        if isinstance(packet, Version):
            known, self.version = self.version, packet
            return [] if packet == known else [packet]  # asked twice, it answers twice
        if isinstance(packet, Parameters):
            self.parameters = packet
            return [packet]
        if isinstance(packet, DecodeError):
            self.counters.rejected[f"{packet.packet_type}.{packet.reason}"] += 1
        return []

    def _defer_next(self) -> None:
        """Put off the packets of points from the next one on, as long as nobody misses them.

        That is until one may complete a sweep, or the clock has to know what has arrived. None if
        they come out of order.
        """
        left = self._assembler.packets_left
        last = self._reorder_buffer.last_in_order(_POINTS)
        if left <= 1 or last is None:
            return
        interchangeable = self._clock.interchangeable()
        if interchangeable is not None:
            due = HostNs(last.arrival + left * _POINTS_PERIOD_NS)
            self._deferred.begin(last, left, due, *interchangeable)

    def _reordered(
        self, stream: Stream, packet: PointPacket | ImuPacket, arrival: HostNs
    ) -> list[Event]:
        events: list[Event] = []
        if self._reorder_buffer.begins_anew(stream, packet, arrival):
            events = self._released(self._reorder_buffer.restart(stream))
            self._forget_device()
        return events + self._released(self._reorder_buffer.push(stream, packet, arrival))

    def _released(self, released: Released) -> list[Event]:
        events: list[Event] = []
        for missing, (packet, arrival) in released:
            if isinstance(packet, ImuPacket):
                events += self._imu(packet, arrival)
            else:
                events += self._points(packet, arrival, missing)
        return events

    def _imu(self, packet: ImuPacket, arrival: HostNs) -> list[Event]:
        stamp = self._clock.observe(_IMU, packet.seq, packet.stamp, arrival)
        if stamp is None:
            self.counters.unlocked[_IMU] += 1
            return []
        sample = new_tuple(ImuSample, (stamp, *packet[2:]))
        self.counters.samples += 1
        self._samples.append(sample)
        if len(self._samples) >= _SAMPLES_AT_ONCE:
            self._hand_on()
        return [sample]

    def _hand_on(self) -> None:
        """Give the latest samples to those that use them."""
        samples, self._samples = self._samples, []
        if samples:
            self._last_imu = samples[-1]
            self._gravity_alignment.add(samples)
            self._gravity.add(samples)

    def _leveled(self, starts: list[HostNs]) -> F64:
        self._hand_on()
        return self._gravity_alignment(starts)

    def _points(self, packet: PointPacket, arrival: HostNs, missing: int = 0) -> list[Event]:
        start = self._clock.observe(_POINTS, packet.seq, packet.stamp, arrival, packet.duration_ns)
        if start is None:
            self.counters.unlocked[_POINTS] += 1
            return []
        self.last_points = packet.payload
        events: list[Event] = []
        for sweep in self._assembler.push(packet, start, missing):
            events += self._finished(sweep)
        if self._assembler.fragments != self.counters.fragments:
            self._count_fragments()
        return events

    def _count_fragments(self) -> None:
        self.counters.fragments = self._assembler.fragments
        self.counters.fragment_packets = self._assembler.fragment_packets

    def _finished(self, sweep: Sweep | None) -> list[Event]:
        if sweep is None:
            self._count_fragments()  # of a turn that a stop or a gap cut short
            return []
        self.counters.sweeps += 1
        self.counters.unleveled = self._assembler.unleveled
        self.counters.points += len(sweep.points)
        is_3d = self._config.sweep.frame3d
        slots = wire.POINTS_PER_3D_PACKET if is_3d else wire.POINTS_PER_2D_PACKET
        self.counters.slots += sweep.packets * slots
        if not len(sweep.points):
            self.counters.empty_sweeps += 1
            return []
        return [sweep]

    def _acknowledged(self, ack: Ack, now: HostNs) -> list[Event]:
        answer = self._requests.answer(ack, now)
        if answer is None:
            self.counters.stray_acks += 1
            return []
        if answer.command.is_latency:
            if answer.round_trip_ns is not None:
                self.round_trips.append(answer.round_trip_ns)
                self._clock.round_trip(answer.round_trip_ns)
            return []
        return [answer]

    def _has_stalled(self, until: HostNs) -> bool:
        return self._assembler.ends_at_pause and self._reorder_buffer.pause_ns(until) > MAX_GAP_NS

    def _send_due(self, now: HostNs) -> list[Event]:
        due = [commands.sync_time(now)] if self._clock.sync_due(now) else []
        due += self._queries.due(
            now, version=self.version is not None, parameters=self.parameters is not None
        )
        repeats, given_up = self._requests.expire(now)
        events: list[Event] = []
        for command in due + repeats:
            self._outbox.append(Outgoing(command.encode(), now))
            events += self.sent(command, now)
        return events + [answer for answer in given_up if not answer.command.is_latency]

    def _forget_device(self) -> None:
        """Ask again who the device is: it may have another version or work mode after a reboot."""
        self._hand_on()
        self._gravity_alignment.clear()
        self.version = None
        self.parameters = None


def _points_size(config: DriverConfig) -> int:
    """Return the size of the expected point datagrams [B]."""
    is_3d = config.sweep.frame3d
    return wire.FRAME_SIZES[_POINTS_3D if is_3d else wire.PacketType.POINTS_2D]


def _imu_wait_ns(config: DriverConfig) -> int:
    """Return how long after an IMU sample it is worth while to look for the next ones [ns]."""
    if not config.imu.enable_publishing:
        return _FOREVER_NS
    return _IMU_PERIOD_NS + config.network.receive_interval_ms * 1_000_000
