"""Virtual L2 without sockets or clocks: bytes and times in, datagrams and times out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Final, NamedTuple

from l2lidar_node.emulator.config import DeviceConfig
from l2lidar_node.emulator.link.faults import Dice, Path, is_silent, stages
from l2lidar_node.emulator.truth import Datagram, Fault, PacketLog
from l2lidar_node.emulator.unit.firmware import Firmware, Flash, Inbox, Network, Received
from l2lidar_node.emulator.unit.stream import (
    VIEW,
    Feed,
    InertialSource,
    MeasurementStream,
    Outbox,
    PointSource,
    Reply,
    imu_feed,
    point_feeds,
)
from l2lidar_node.protocol.wire import AckStatus, PacketType, WorkMode

_S: Final = 1_000_000_000
_IMU_STREAM: Final = "imu"
_POINTS_STREAM: Final = "points"


class Link(Enum):
    """Which connector the host is plugged into; the other one is dead."""

    ETHERNET = "ethernet"
    SERIAL = "serial"


class _Event(NamedTuple):
    """A scheduled event."""

    time_ns: int
    fault: Fault
    happen: Callable[[int], None]


class VirtualL2:
    """A virtual unit: firmware, two streams of measurements, and the faulty way to the host.

    All instants are integer nanoseconds of true time, which is the host's time line; they must not
    decrease from call to call.

    Parameters
    ----------
    config : DeviceConfig
    scanner : PointSource
        3D packets; its time line starts at power-on and goes on over restarts and standby.
    inertial : InertialSource
        IMU packets on the same time line.
    power_on_ns : int
        True instant of power-on.
    flash : Flash, optional
        Stored settings, a new unit's if left out.
    link : Link
        Where the host is plugged in.
    modes : mapping from WorkMode to PointSource, optional
        Sources for ``WIDE_FOV``, ``MODE_2D`` and both together; a plain pattern where left out.
    packet_log : PacketLog, optional
        Where the truth is booked.

    Attributes
    ----------
    packet_log : PacketLog
    received : Counter
        Packets heard from the host by type.
    """

    def __init__(
        self,
        config: DeviceConfig,
        scanner: PointSource,
        inertial: InertialSource,
        *,
        power_on_ns: int = 0,
        flash: Flash | None = None,
        link: Link = Link.ETHERNET,
        modes: Mapping[WorkMode, PointSource] | None = None,
        packet_log: PacketLog | None = None,
    ) -> None:
        self.config = config
        self.packet_log = PacketLog() if packet_log is None else packet_log
        self.received: Counter[int] = Counter()
        self._origin_ns = self._now_ns = power_on_ns
        self._firmware = Firmware(
            config, flash or Flash.factory(config.addresses, config.identity), power_on_ns
        )
        self._link = link
        self._inbox = Inbox()
        self._path = Path(
            stages(config.faults, power_on_ns, config.seed, self.packet_log), self.packet_log
        )
        self._deaf = Dice(
            Fault.COMMAND_LOSS,
            config.faults.command_loss,
            config.faults,
            power_on_ns,
            config.seed,
            self.packet_log,
        )
        self._points = point_feeds(scanner, modes or {})
        self._imu = imu_feed(inertial)
        self._events = self._scheduled()
        self._outbox = Outbox(self._firmware.clock, self.packet_log)
        self._replies: list[Reply] = []
        self._streams: dict[str, MeasurementStream] = {}
        self._tuned: dict[str, tuple[Feed, int] | None] = {}
        self._retune(power_on_ns)

    @property
    def network(self) -> Network:
        """Network settings in force."""
        return self._firmware.network

    @property
    def flash(self) -> Flash:
        """Stored settings."""
        return self._firmware.flash

    @property
    def boots(self) -> int:
        """How often the unit restarted."""
        return self._firmware.boots

    @property
    def power_on_ns(self) -> int:
        """True instant of the first power-on."""
        return self._origin_ns

    @property
    def now_ns(self) -> int:
        """True instant up to which everything has happened."""
        return self._now_ns

    @property
    def sent(self) -> Counter[PacketType]:
        """Packets that left the unit so far by type, over restarts."""
        return self._outbox.sent.copy()

    @property
    def is_reachable(self) -> bool:
        """Whether the host's connector is the one in use."""
        serial = bool(self._firmware.mode & WorkMode.SERIAL)
        return serial == (self._link is Link.SERIAL)

    @property
    def next_ns(self) -> int | None:
        """True instant at which something happens next; None when only a command changes that."""
        instants = [stream.next_ns for stream in self._streams.values()]
        instants += [item for item in (self._path.next_ns,) if item is not None]
        instants += [self._replies[0].leaves_ns] if self._replies else []
        instants += [self._events[0].time_ns] if self._events else []
        return min(instants, default=None)

    def advance(self, now_ns: int) -> list[tuple[int, bytes]]:
        """Advance time and return what reaches the host until ``now_ns``.

        Returns
        -------
        list of (int, bytes)
            True instant and datagram, in order of time.
        """
        self._run(now_ns)
        return [(item.time_ns, item.data) for item in self._path.arrivals(now_ns)]

    def command(self, data: bytes, now_ns: int) -> None:
        """Hear bytes from the host at a true instant; :meth:`advance` returns the answers."""
        self._run(now_ns)
        carrier = Datagram(now_ns, data, ())
        if self._deaf.strikes(carrier):
            self._deaf.note(carrier)
            return
        if not self.is_reachable or is_silent(self.config.faults, now_ns - self._origin_ns):
            return
        boots = self.boots
        for received in self._inbox.feed(data):
            if received.status is AckStatus.OK:
                self.received[received.packet_type] += 1
            self._obey(received, now_ns)
            if self.boots != boots:  # bytes after a reset are dropped
                self._restarted()
                break
        self._retune(now_ns)

    def _obey(self, received: Received, now_ns: int) -> None:
        leaves_ns = now_ns + round(self.config.delays.reply_delay_us * 1e3)
        for packet_type, payload in self._firmware.answer(received, now_ns):
            self._replies.append(Reply(leaves_ns, packet_type, payload))

    def _run(self, now_ns: int) -> None:
        """Bring everything up to a true instant, event by event."""
        now_ns = max(now_ns, self._now_ns)
        while self._events and self._events[0].time_ns <= now_ns:
            event = self._events.pop(0)
            self._produce(event.time_ns)
            self.packet_log.note(event.time_ns, event.fault)
            event.happen(event.time_ns)
            self._retune(event.time_ns)
        self._produce(now_ns)
        self._now_ns = now_ns

    def _produce(self, until_ns: int) -> None:
        """Send everything that leaves the unit until a true instant."""
        measured = [
            (stream.packet_type, stream.take(until_ns))
            for stream in self._streams.values()
            if stream.next_ns <= until_ns
        ]
        replies = [reply for reply in self._replies if reply.leaves_ns <= until_ns]
        self._replies = self._replies[len(replies) :]
        self._path.send(self._outbox.send(measured, replies), until_ns)

    def _retune(self, now_ns: int) -> None:
        """Let each stream begin, change its source or end, as power and work mode want it."""
        power, mode = self._firmware.power, self._firmware.mode
        reachable = self.is_reachable
        points = self._points[mode & VIEW]
        points_from = power.points_from_ns if reachable else None
        imu_from = power.imu_from_ns if reachable and not mode & WorkMode.IMU_OFF else None
        delays = self.config.delays
        self._tune(_IMU_STREAM, self._imu, imu_from, delays.imu_delay_us, now_ns)
        self._tune(_POINTS_STREAM, points, points_from, delays.points_delay_us, now_ns)

    def _tune(
        self, name: str, feed: Feed, from_ns: int | None, delay_us: float, now_ns: int
    ) -> None:
        wanted = None if from_ns is None else (feed, from_ns)
        if self._tuned.get(name) == wanted:
            return
        self._tuned[name] = wanted
        self._streams.pop(name, None)
        if from_ns is not None:
            begin_ns = max(from_ns, now_ns)
            self._streams[name] = MeasurementStream(
                feed, self._origin_ns, round(delay_us * 1e3), begin_ns
            )

    def _reboot(self, now_ns: int) -> None:
        self._firmware.reboot(now_ns)
        self._restarted()

    def _restarted(self) -> None:
        """Drop what a restart clears from the unit's memory."""
        self._inbox = Inbox()
        self._replies.clear()
        self._outbox.restart()
        self._streams.clear()
        self._tuned.clear()

    def _scheduled(self) -> list[_Event]:
        """Return the events that the configuration asks for in order of time."""
        faults, clock = self.config.faults, self._firmware.clock
        error_ns = round(faults.foreign_sync_error_s * _S)
        happenings: list[tuple[Fault, tuple[float, ...], Callable[[int], None]]] = [
            (Fault.REBOOT, faults.reboot_at, self._reboot),
            (
                Fault.CLOCK_STEP,
                faults.clock_step_at,
                lambda now_ns: clock.step(now_ns, round(faults.clock_step_ms * 1e6)),
            ),
            (
                Fault.FOREIGN_SYNC,
                faults.foreign_sync_at,
                lambda now_ns: clock.set(now_ns, max(now_ns + error_ns, 0)),
            ),
        ]
        return sorted(
            (
                _Event(self._origin_ns + round(at_s * _S), fault, happen)
                for fault, instants, happen in happenings
                for at_s in instants
            ),
            key=lambda event: event.time_ns,
        )
