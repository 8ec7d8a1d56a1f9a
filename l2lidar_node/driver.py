"""Composes the driver's parts: bytes with their arrival in, sweeps and samples out; no socket.

Every method takes the time as an argument and returns what happened, so a recording gives the same
output as the live sensor did.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

from l2lidar_node import commands, wire
from l2lidar_node.assembler import MAX_GAP_NS, SweepAssembler
from l2lidar_node.clock import ClockEvent, ClockStatus, DeviceClock
from l2lidar_node.commands import Command
from l2lidar_node.config import DriverConfig
from l2lidar_node.counters import Counters
from l2lidar_node.framing import FrameError, Framer
from l2lidar_node.gravity import GravityMonitor
from l2lidar_node.levelling import Levelling
from l2lidar_node.packets import (
    Ack,
    DecodeError,
    ImuPacket,
    Packet,
    Parameters,
    PointPacket,
    Version,
    decode,
)
from l2lidar_node.requests import Answer, Requests
from l2lidar_node.sequence import SequenceOrder
from l2lidar_node.types import HostNs, ImuSample, Stream, Sweep
from l2lidar_node.watchdog import SILENCE_NS, DeviceState, Watchdog

QUERY_NS: Final = 1_000_000_000  # interval of version, parameter and latency requests
REORDER_NS: Final = 60_000_000  # a packet waits at most this long for an earlier one
_ROUND_TRIPS: Final = 60  # the last minute's
RESTART_NS: Final = 1_000_000_000  # device stamps that fall by more than this began anew


@dataclass(frozen=True, slots=True)
class Silence:
    """The device has been silent for longer than the watchdog allows."""

    duration_ns: int


Event = Sweep | ImuSample | Version | Parameters | Answer | ClockEvent | Silence


@dataclass(slots=True)
class _Timed:
    """A packet with its arrival."""

    packet: PointPacket | ImuPacket
    arrival: HostNs


class Driver:
    """One device: its byte stream, its clock, its sweeps, its commands.

    Parameters
    ----------
    config : DriverConfig
    """

    def __init__(self, config: DriverConfig) -> None:
        self.counters = Counters()
        self.version: Version | None = None
        self.parameters: Parameters | None = None
        self.last_points: bytes | None = None
        self.last_imu: ImuSample | None = None
        self.gravity = GravityMonitor()
        self.round_trips: deque[int] = deque(maxlen=_ROUND_TRIPS)
        self._config = config
        self._framer = Framer()
        self._orders = {
            stream: SequenceOrder[_Timed](config.sweep.reorder_window) for stream in Stream
        }
        self.counters.sequence = {stream: order.counts for stream, order in self._orders.items()}
        self._newest: dict[Stream, _Timed] = {}
        self._clock = DeviceClock(config.clock)
        self._levelling = Levelling(config.imu.roll_pitch_only)
        self._assembler = SweepAssembler(config.sweep, self._level())
        self._requests = Requests()
        self._watchdog = Watchdog(config.watchdog)
        self._outbox: list[bytes] = []
        self._next_query = HostNs(0)
        self._latency_id = 100

    @property
    def config(self) -> DriverConfig:
        """The settings in force."""
        return self._config

    def receive(self, data: bytes, arrival: HostNs) -> list[Event]:
        """Return what the bytes of one datagram complete.

        Parameters
        ----------
        data : bytes
            As they came from the device, cut anywhere.
        arrival : HostNs
            When they reached this host, at best as the kernel noted it.
        """
        self.counters.datagrams += 1
        self.counters.octets += len(data)
        events: list[Event] = []
        for item in self._framer.feed(data):
            if isinstance(item, FrameError):
                self.counters.faults[item.fault.value] += 1
                self.counters.skipped_octets += item.skipped
                continue
            is_known = item.packet_type in wire.FRAME_SIZES
            self.counters.frames[item.packet_type if is_known else 0] += 1
            events += self._handle(decode(item), arrival)
        events += self._clock.events()
        return events

    def tick(self, now: HostNs) -> list[Event]:
        """Return what is due by now; to be called every few milliseconds."""
        events: list[Event] = []
        for order in self._orders.values():
            while order.oldest and now - order.oldest.arrival > REORDER_NS:
                events += self._released(order.give_up())
        newest = self._newest.get(Stream.POINTS)
        if newest and now - newest.arrival > MAX_GAP_NS:
            events += self._finished(self._assembler.flush())
        self._send_due(now)
        repeats, given_up = self._requests.expire(now)
        self._outbox += [command.encode() for command in repeats]
        events += [answer for answer in given_up if not answer.command.is_latency]
        if self._watchdog.expired(now):
            events.append(Silence(self._watchdog.silence_ns(now)))
        return events

    def outbox(self) -> list[bytes]:
        """Return the frames to send now, in order, once."""
        frames, self._outbox = self._outbox, []
        return frames

    def send(self, command: Command, now: HostNs) -> int:
        """Queue a command and return the ticket that its :class:`Answer` will carry."""
        self._outbox.append(command.encode())
        if not command.acknowledged:
            return 0
        return self._requests.add(command, now)

    def start_rotation(self, now: HostNs) -> int:
        """Queue the command to leave standby; return its ticket."""
        self._watchdog.started(now)
        self._newest.clear()
        return self.send(commands.start(), now)

    def stop_rotation(self, now: HostNs) -> tuple[int, list[Event]]:
        """Queue the command for standby; return its ticket and what had been collected so far."""
        self._watchdog.stopped()
        return self.send(commands.standby(), now), self.flush()

    def reset_device(self, now: HostNs) -> list[Event]:
        """Queue the command to reboot and return what had been collected so far."""
        self.send(commands.reset(), now)
        self._watchdog.started(now)
        events = self.flush()
        self._newest.clear()
        self._forget_device()
        return events

    def flush(self) -> list[Event]:
        """Return everything that is still being collected."""
        events: list[Event] = []
        for order in self._orders.values():
            events += self._released(order.flush())
        return events + self._finished(self._assembler.flush())

    def configure(self, config: DriverConfig) -> None:
        """Use other live settings from the next packet on."""
        self._config = config
        self._levelling.roll_pitch_only = config.imu.roll_pitch_only
        self._assembler.configure(config.sweep, self._level())
        self._clock.configure(config.clock)

    def clock_status(self) -> ClockStatus:
        """Return what is known about the device's clock."""
        return self._clock.status()

    def state(self, now: HostNs) -> DeviceState:
        """Return what the device is doing."""
        return self._watchdog.state(now)

    def spin_up_left_s(self, now: HostNs) -> float:
        """Return the seconds until points can be expected."""
        return self._watchdog.spin_up_left_s(now)

    def _level(self) -> Levelling | None:
        return self._levelling if self._config.imu.adjust else None

    def _handle(self, packet: Packet, arrival: HostNs) -> list[Event]:
        if isinstance(packet, ImuPacket):
            return self._order(Stream.IMU, packet, arrival)
        if isinstance(packet, PointPacket):
            if (packet.packet_type == wire.PacketType.POINTS_3D) != self._config.sweep.frame3d:
                self.counters.ignored_points += 1
                self._watchdog.heard(Stream.POINTS, arrival)
                return []
            return self._order(Stream.POINTS, packet, arrival)
        if isinstance(packet, Ack):
            return self._acknowledged(packet, arrival)
        if isinstance(packet, Version):
            self.version = packet
            return [packet]
        if isinstance(packet, Parameters):
            self.parameters = packet
            return [packet]
        if isinstance(packet, DecodeError):
            self.counters.rejected[f"{packet.packet_type}.{packet.reason}"] += 1
        return []

    def _order(
        self, stream: Stream, packet: PointPacket | ImuPacket, arrival: HostNs
    ) -> list[Event]:
        self._watchdog.heard(stream, arrival)
        order = self._orders[stream]
        newest = self._newest.get(stream)
        timed = _Timed(packet, arrival)
        self._newest[stream] = timed
        if newest is None:
            return self._released(order.restart() + order.push(packet.seq, timed))
        if newest.packet.stamp - packet.stamp > RESTART_NS:
            events = self._released(order.restart())
            self._forget_device()
            return events + self._released(order.push(packet.seq, timed))
        if arrival - newest.arrival > SILENCE_NS:
            return self._released(order.resume(packet.seq, timed))
        return self._released(order.push(packet.seq, timed))

    def _released(self, released: list[tuple[int, _Timed]]) -> list[Event]:
        events: list[Event] = []
        for missing, timed in released:
            packet = timed.packet
            if isinstance(packet, ImuPacket):
                events += self._imu(packet, timed.arrival)
            else:
                events += self._points(packet, timed.arrival, missing)
        return events

    def _imu(self, packet: ImuPacket, arrival: HostNs) -> list[Event]:
        stamp = self._clock.observe(Stream.IMU, packet.seq, packet.stamp, arrival)
        if stamp is None:
            self.counters.unlocked[Stream.IMU] += 1
            return []
        sample = ImuSample(stamp, *packet[2:])
        self.counters.samples += 1
        self.last_imu = sample
        self._levelling.add(sample)
        self.gravity.add(sample)
        return [sample]

    def _points(self, packet: PointPacket, arrival: HostNs, missing: int) -> list[Event]:
        start = self._clock.observe(
            Stream.POINTS, packet.seq, packet.stamp, arrival, packet.duration_ns
        )
        if start is None:
            self.counters.unlocked[Stream.POINTS] += 1
            return []
        self.last_points = packet.payload
        events: list[Event] = []
        for sweep in self._assembler.push(packet, start, missing):
            events += self._finished(sweep)
        return events

    def _finished(self, sweep: Sweep | None) -> list[Event]:
        if sweep is None:
            return []
        self.counters.sweeps += 1
        self.counters.unlevelled = self._levelling.dropped
        self.counters.points += len(sweep.points)
        self.counters.slots += sweep.packets * self._slots
        if not len(sweep.points):
            self.counters.empty_sweeps += 1
            return []
        return [sweep]

    @property
    def _slots(self) -> int:
        is_3d = self._config.sweep.frame3d
        return wire.POINTS_PER_3D_PACKET if is_3d else wire.POINTS_PER_2D_PACKET

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

    def _send_due(self, now: HostNs) -> None:
        if self._clock.sync_due(now):
            self._outbox.append(commands.sync_time(now).encode())
            self._clock.synced(now, now)
        if 0 <= self._next_query - now <= QUERY_NS:
            return
        self._next_query = HostNs(now + QUERY_NS)
        if self.version is None:
            self._outbox.append(commands.request_version().encode())
        if self.parameters is None:
            self._outbox.append(commands.request_parameters().encode())
        if self._config.clock.enable_latency_measure:
            self._latency_id += 1
            command = commands.latency(self._latency_id)
            self._outbox.append(command.encode())
            self._requests.add(command, now, tries=1)

    def _forget_device(self) -> None:
        """Ask again who the device is: it may have another version or work mode after a reboot."""
        self._levelling.clear()
        self.version = None
        self.parameters = None
