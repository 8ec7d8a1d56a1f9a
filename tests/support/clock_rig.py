"""Runs the driver against the virtual L2 in simulated time and notes what its clock answers."""

from __future__ import annotations

import heapq
from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.clock import ClockEvent, DeviceClock
from l2lidar_node.config import ClockConfig, DriverConfig
from l2lidar_node.driver.driver import Driver
from l2lidar_node.driver.reorder import SequenceCounts
from l2lidar_node.emulator.config import (
    CrystalConfig,
    DeviceConfig,
    FaultConfig,
    IdentityConfig,
    PowerConfig,
)
from l2lidar_node.emulator.unit.device import VirtualL2
from l2lidar_node.emulator.unit.stream import PatternScanner, StillInertial
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType, WorkMode
from l2lidar_node.settings import Value, build
from l2lidar_node.transport.host_clock import HostClock
from l2lidar_node.types import DeviceNs, HostNs, Stream
from tests.support.clock_loads import Load, LoadedPath

NOTE: Final = np.dtype(
    [
        ("type", "<u2"),  # wire.PacketType
        ("boot", "<u2"),  # restarts of the device before
        ("seq", "<u4"),
        ("stamp", "<i8"),  # [ns] device clock
        ("truth", "<i8"),  # [ns] host clock at the instant the stamp marks
        ("arrival", "<i8"),  # [ns] host clock
        ("duration", "<i8"),  # [ns] first to last measurement
        ("sync", "<i8"),  # [ns] value of the last sync sent before the packet was handled; 0
        ("published", "<i8"),  # [ns] host clock; 0 for none
        ("uncertainty", "<i8"),  # [ns] what the status says after the packet
    ]
)
"""One packet that reached the clock, in the order in which it did."""

EPOCH_NS: Final = 1_760_000_000 * 10**9
_TICK_NS: Final = 2_000_000  # how often the driver looks what is due
_COMMAND_NS: Final = 150_000  # shortest way of a command; the rest is exponential with this mean
_TYPES: Final = {Stream.IMU: PacketType.IMU, Stream.POINTS: PacketType.POINTS_3D}


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One row of the benchmark: a device, a path and a sync mode.

    Attributes
    ----------
    ratio : float
        True seconds per second of the device's clock.
    sync : str
        ``off``, ``once`` or ``periodic`` (every 50 ms).
    crystal, faults : dict
        Further settings of the virtual L2.
    loads : tuple of Load
        What delays packets on their way, in seconds since power-on.
    stale : (float, float)
        How many old packets a second come again, and how old they are [s].
    slews : tuple of (float, float, float)
        From when to when [s] a time server slews the host's clock, and by how much [ppm].
    are_slews_told : bool
        Whether the driver is told, as by a session.
    standbys : tuple of (float, float)
        From when to when the driver puts the unit into standby [s].
    boot_scale : float
        How long the unit takes to come up, against a real one; 0 streams at once.
    imu : bool
        Whether the IMU is on.
    latency : bool
        Whether the driver measures the round trip.
    seconds : float
        Length of the run.
    """

    ratio: float
    sync: str
    crystal: dict[str, float] = field(default_factory=dict)
    faults: dict[str, Value] = field(default_factory=dict)
    loads: tuple[Load, ...] = ()
    stale: tuple[float, float] = (0.0, 0.0)
    slews: tuple[tuple[float, float, float], ...] = ()
    are_slews_told: bool = True
    standbys: tuple[tuple[float, float], ...] = ()
    boot_scale: float = 0.25
    imu: bool = True
    latency: bool = False
    seconds: float = 60.0


class RecordingClock(DeviceClock):
    """A clock that notes what it is asked and what it answers.

    Attributes
    ----------
    reported : list of ClockEvent
        Everything that happened, in order.
    sequence : dict
        What the driver counted by sequence numbers.
    uncertainties : list of int
        What the status said after each packet [ns].
    """

    def __init__(self, config: ClockConfig) -> None:
        super().__init__(config)
        self.notes: list[tuple[int, int, int, int, int, int, int]] = []
        self.uncertainties: list[int] = []
        self._sync = 0
        self.reported: list[ClockEvent] = []
        self.sequence: dict[Stream, SequenceCounts] = {}

    def events(self) -> list[ClockEvent]:
        """Return what happened since the last call, and note it."""
        happened = super().events()
        self.reported += happened
        return happened

    def observe(
        self, stream: Stream, seq: int, stamp: DeviceNs, arrival: HostNs, duration_ns: int = 0
    ) -> HostNs | None:
        """Answer as the clock does, and note it."""
        answer = super().observe(stream, seq, stamp, arrival, duration_ns)
        self.notes.append(
            (_TYPES[stream], seq, stamp, arrival, duration_ns, self._sync, answer or 0)
        )
        self.uncertainties.append(round(self._host.uncertainty_ns))
        return answer

    def synced(self, value: HostNs, sent: HostNs) -> None:
        """Take note of a sync, as the clock does."""
        super().synced(value, sent)
        self._sync = value


class _UnevenScanner(PatternScanner):
    """The pattern at a mirror whose period varies by 0.1 %, as a motor's does."""

    def __init__(self, seed: int, count: int) -> None:
        super().__init__()
        periods = np.random.default_rng([seed, 102]).normal(1.0, 1e-3, count)
        self._starts = np.cumsum(periods * wire.MIRROR_PERIOD_S)

    def packets(self, first: int, count: int) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        """Return packets and their start times; the angles are those of an even mirror."""
        payloads, _ = super().packets(first, count)
        return payloads, np.asarray(self._starts[first : first + count])


class _SlewedClock(HostClock):
    """The host's clock as a session watches it."""

    def __init__(self, case: Case) -> None:
        super().__init__()
        self.true_ns = EPOCH_NS
        self._case = case

    def _read_slewing(self) -> tuple[int, int, int]:
        return self.true_ns, slewed_ns(self._case, self.true_ns), 0


def run(case: Case, seed: int) -> tuple[NDArray[np.void], RecordingClock]:
    """Return what happened to every packet, shape (N,), dtype NOTE, and the clock at the end."""
    device = _device(case, seed)
    values: dict[str, Value] = {
        "l2_ip": "127.0.0.1",
        "imu_adjust": False,
        "enable_l2_host_sync": case.sync != "off",
        "l2_sync_mode": "once" if case.sync == "off" else case.sync,
        "enable_latency_measure": case.latency,
    }
    driver = Driver(build(DriverConfig, values))
    clock = RecordingClock(driver.config.clock)
    driver._clock = clock
    clock.sequence = driver.counters.sequence
    driver.host_stepped(0, HostNs(EPOCH_NS))  # nobody sets the host's clock, as a session knows
    host = _SlewedClock(case)
    rng = np.random.default_rng([seed, 106])
    commands: list[tuple[int, int, bytes]] = []
    path = LoadedPath(case.loads, seed)
    way: list[tuple[int, int, bytes]] = []
    old: deque[tuple[int, bytes]] = deque()
    next_stale = EPOCH_NS
    standbys = sorted(
        (at, is_start)
        for stop, start in case.standbys
        for at, is_start in ((stop, False), (start, True))
    )
    count = 0
    for now in range(EPOCH_NS, EPOCH_NS + round(case.seconds * 1e9), _TICK_NS):
        while commands and commands[0][0] <= now:
            instant, _, data = heapq.heappop(commands)
            device.command(data, instant)
        for arrival, datagram in device.advance(now):
            is_imu = len(datagram) < wire.FRAME_SIZES[PacketType.POINTS_3D]
            late = EPOCH_NS + path.deliver(arrival - EPOCH_NS, is_imu)
            heapq.heappush(way, (late, count, datagram))
            count += 1
            old.append((arrival, datagram))
        if case.stale[0] and now >= next_stale:
            next_stale += round(1e9 / case.stale[0])
            while len(old) > 1 and old[0][0] < now - round(case.stale[1] * 1e9):
                old.popleft()
            if old and now - old[0][0] > 0.9e9 * case.stale[1]:
                heapq.heappush(way, (now, count, old[0][1]))
                count += 1
        while way and way[0][0] <= now:
            arrival, _, datagram = heapq.heappop(way)
            driver.receive(datagram, HostNs(arrival + slewed_ns(case, arrival)))
        host.true_ns = now
        shown = HostNs(now + slewed_ns(case, now))
        slewed = host.slewed_ns()
        if slewed is not None and case.are_slews_told:
            driver.host_slewed(slewed, shown)
        while standbys and EPOCH_NS + standbys[0][0] * 1e9 <= now:
            _, is_start = standbys.pop(0)
            if is_start:
                driver.start_rotation(shown)
            else:
                driver.stop_rotation(shown)
        driver.tick(shown)
        for data, _ in driver.outbox():
            latency = _COMMAND_NS + round(rng.exponential(_COMMAND_NS))
            heapq.heappush(commands, (now + latency, count, data))
            count += 1
    return _with_truth(clock, device, case), clock


def slewed_ns(case: Case, instant: int) -> int:
    """Return how far the host's clock has been moved by slewing at a true instant [ns]."""
    at = (instant - EPOCH_NS) * 1e-9
    seconds = (max(min(at, stop) - start, 0.0) * ppm for start, stop, ppm in case.slews)
    return round(sum(seconds) * 1e3)


def _device(case: Case, seed: int) -> VirtualL2:
    mode = WorkMode(0) if case.imu else WorkMode.IMU_OFF
    config = DeviceConfig(
        power=PowerConfig(boot_scale=case.boot_scale),
        identity=IdentityConfig(work_mode=int(mode)),
        crystal=build(CrystalConfig, {"clock_ratio": case.ratio, **case.crystal}),
        faults=build(FaultConfig, case.faults),
        seed=seed,
    )
    count = round((case.seconds + 10.0) / wire.MIRROR_PERIOD_S)
    scanner = _UnevenScanner(seed, count)
    return VirtualL2(config, scanner, StillInertial(), power_on_ns=EPOCH_NS)


def _with_truth(clock: RecordingClock, device: VirtualL2, case: Case) -> NDArray[np.void]:
    """Join what the clock saw with the emulator's packet log; stamp and number name a packet."""
    packet_log = device.packet_log.packets
    truth = {
        (int(row["type"]), int(row["seq"]), int(row["stamp_ns"])): (
            int(row["boot"]),
            int(row["start_ns"]),
        )
        for row in packet_log
    }
    notes = np.zeros(len(clock.notes), NOTE)
    for at, (kind, seq, stamp, arrival, duration, sync, answer) in enumerate(clock.notes):
        boot, start = truth[kind, seq, stamp]
        start += slewed_ns(case, start)
        said = clock.uncertainties[at]
        notes[at] = (kind, boot, seq, stamp, start, arrival, duration, sync, answer, said)
    return notes
