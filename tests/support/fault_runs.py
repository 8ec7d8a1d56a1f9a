"""Runs the driver against a faulty virtual L2 in simulated time and judges it by the truth."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Driver
from l2lidar_node.driver.geometry import Projector
from l2lidar_node.emulator.config import DeviceConfig, FaultConfig, IdentityConfig, PowerConfig
from l2lidar_node.emulator.unit.device import VirtualL2
from l2lidar_node.emulator.unit.stream import PatternScanner, StillInertial
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType, WorkMode
from l2lidar_node.settings import Value, build
from l2lidar_node.types import HostNs, ImuSample, Sweep
from tests.support.clock_rig import RecordingClock

EPOCH_NS: Final = 1_760_000_000 * 10**9
_TICK_NS: Final = 5_000_000
_COMMAND_NS: Final = 150_000  # shortest way of a command; the rest is exponential with this mean
_SURE_NS: Final = 20_000_000  # the driver knows by then that the host's clock was set
_UNUSED: Final = 0  # what the clock answers for a packet that cannot be placed yet
_EXACT: Final = ("x", "y", "z", "intensity", "range")
_BOOT_SCALE: Final = 0.04  # a second until there are points


class FaultCase(NamedTuple):
    """One row of the table.

    Attributes
    ----------
    name : str
    faults : dict
        Settings of the virtual L2's faults.
    seconds : float
        Of simulated time.
    flat : bool
        2D packets.
    host_steps : tuple of (float, int)
        When [s] the host's own clock jumps, and how far [ns].
    values : dict
        Further settings of the driver.
    """

    name: str
    faults: dict[str, Value]
    seconds: float = 10.0
    flat: bool = False
    host_steps: tuple[tuple[float, int], ...] = ()
    values: dict[str, Value] | None = None


@dataclass(slots=True)
class Verdict:
    """What the driver made of a run, judged by the emulator's packet log.

    Attributes
    ----------
    sent, destroyed, used : int
        Measurements the unit sent; of these, those the faults let nothing arrive of, and those
        that were published.
    unlocked : int
        Packets that came while the clock was not locked; they are not published.
    lost_good : int
        Packets that arrived whole after the first lock and were neither published nor unlocked.
    late : int
        Of these, those that came after their place had been given up.
    worst_ms : float
        Largest error of a published stamp.
    backwards : int
        Published stamps that are not later than the one before.
    wrong_sweeps : int
        Sweeps with a point that was not measured, or without one that was.
    lock_s : float
        From the first packet to the first published one.
    gap_s : float
        Longest time after that, by the truth, in which packets arrived and none was published, or
        in which stamps went on along the host's time as it was before it was set.
    """

    sent: int = 0
    destroyed: int = 0
    used: int = 0
    unlocked: int = 0
    lost_good: int = 0
    late: int = 0
    worst_ms: float = 0.0
    backwards: int = 0
    wrong_sweeps: int = 0
    lock_s: float = 0.0
    gap_s: float = 0.0
    counted: dict[str, int] = field(default_factory=dict)


class _Placed(NamedTuple):
    """A packet that the clock was asked about, with its row of the packet log."""

    row: int
    published: int  # [ns] true time line; 0 for none
    is_old: bool = False  # published on the host's time as it was before it was set


def run(case: FaultCase, seed: int) -> Verdict:
    """Run a case and judge it."""
    mode = WorkMode.MODE_2D if case.flat else WorkMode(0)
    device = VirtualL2(
        DeviceConfig(
            power=PowerConfig(boot_scale=_BOOT_SCALE),
            identity=IdentityConfig(work_mode=int(mode)),
            faults=build(FaultConfig, case.faults),
            seed=seed,
        ),
        PatternScanner(),
        StillInertial(),
        power_on_ns=EPOCH_NS,
    )
    values: dict[str, Value] = {"imu_adjust": False, "frame3d": not case.flat}
    driver = Driver(build(DriverConfig, {**values, **(case.values or {})}))
    clock = driver._clock = RecordingClock(driver.config.clock)
    sweeps: list[Sweep] = []
    stamps: list[int] = []
    _simulate(case, seed, device, driver, lambda event: _sort(event, sweeps, stamps))
    verdict = Verdict(counted=_counted(driver))
    placed = _placed(case, device, clock)
    _judge_packets(verdict, device, placed)
    answers = [int(note[-1]) for note in clock.notes]
    fragments = driver.counters.fragment_packets
    _judge_sweeps(verdict, case, device, placed, answers, sweeps, fragments)
    starts = [sweep.start for sweep in sweeps]
    verdict.backwards = sum(b <= a for line in (stamps, starts) for a, b in pairwise(line))
    verdict.late = sum(counts.late for counts in driver.counters.sequence.values())
    return verdict


def _sort(event: object, sweeps: list[Sweep], stamps: list[int]) -> None:
    if isinstance(event, Sweep):
        sweeps.append(event)
    elif isinstance(event, ImuSample):
        stamps.append(event.stamp)


def _simulate(
    case: FaultCase,
    seed: int,
    device: VirtualL2,
    driver: Driver,
    on_event: Callable[[object], None],
) -> None:
    rng = np.random.default_rng([seed, 7])
    commands: list[tuple[int, int, bytes]] = []
    count = told = 0
    driver.host_stepped(0, HostNs(EPOCH_NS))
    for now in range(EPOCH_NS, EPOCH_NS + round(case.seconds * 1e9), _TICK_NS):
        while commands and commands[0][0] <= now:
            instant, _, data = heapq.heappop(commands)
            device.command(data, instant)
        for arrival, datagram in device.advance(now):
            for event in driver.receive(datagram, HostNs(arrival + shift_ns(case, arrival))):
                on_event(event)
        shift = shift_ns(case, now)
        if shift != told:
            driver.host_stepped(shift - told, HostNs(now + shift))
            told = shift
        for event in driver.tick(HostNs(now + shift)):
            on_event(event)
        for data, _ in driver.outbox():
            latency = _COMMAND_NS + round(rng.exponential(_COMMAND_NS))
            heapq.heappush(commands, (now + latency, count, data))
            count += 1
    for event in driver.flush():
        on_event(event)


def shift_ns(case: FaultCase, instant: int) -> int:
    """Return how far the host's clock is off at a true instant."""
    return sum(by for at, by in case.host_steps if instant - EPOCH_NS >= at * 1e9)


def _placed(case: FaultCase, device: VirtualL2, clock: RecordingClock) -> list[_Placed]:
    """Join the clock's queries with the packet log by type, number, stamp and age."""
    packets = device.packet_log.packets
    rows: dict[tuple[int, int, int], list[int]] = {}
    for row, (kind, seq, stamp) in enumerate(packets[["type", "seq", "stamp_ns"]].tolist()):
        rows.setdefault((kind, seq, stamp), []).append(row)
    left = packets["left_ns"]
    found = []
    for kind, seq, stamp, arrival, _, _, answer in clock.notes:
        if kind == PacketType.POINTS_3D and case.flat:
            kind = PacketType.POINTS_2D
        # After a reboot numbers and stamps come again; the one that just came counts.
        lives = rows[kind, seq, stamp]
        before = [row for row in lives if left[row] + shift_ns(case, int(left[row])) <= arrival]
        row = before[-1] if before else lives[0]
        truth = int(packets["start_ns"][row])
        # The host's time before a step goes on until the driver is sure of the step.
        shifts = [shift_ns(case, truth - before) for before in (0, _SURE_NS)]
        _, shift = min((abs(answer - shift - truth), shift) for shift in shifts)
        found.append(_Placed(row, answer - shift if answer else _UNUSED, shift != shifts[0]))
    return found


def _judge_packets(verdict: Verdict, device: VirtualL2, placed: list[_Placed]) -> None:
    packets = device.packet_log.packets
    measured = np.isin(packets["type"], (102, 103, 104))
    published = np.zeros(len(packets), np.int64)
    asked = np.zeros(len(packets), bool)
    old = np.zeros(len(packets), bool)
    for row, answer, is_old in placed:
        asked[row] = True
        published[row] = answer
        old[row] = is_old and answer != _UNUSED
    used = published != _UNUSED
    whole = measured & (packets["copies"] > 0)
    verdict.sent = int(measured.sum())
    verdict.used = int(used.sum())
    verdict.destroyed = int((measured & ~whole & ~asked).sum())
    verdict.unlocked = int((asked & ~used).sum())
    if not verdict.used:
        return
    error = published[used] - packets["start_ns"][used]
    verdict.worst_ms = float(np.abs(error).max()) / 1e6
    first = int(packets["start_ns"][used].min())
    verdict.lock_s = (first - int(packets["start_ns"][whole].min())) / 1e9
    after = whole & (packets["start_ns"] >= first)
    verdict.lost_good = int((after & ~asked).sum())
    for kinds in ((102, 103), (104,)):
        mine = after & np.isin(packets["type"], kinds)
        for fine in (used, ~old):
            verdict.gap_s = max(verdict.gap_s, _longest(packets["start_ns"][mine], fine[mine]))


def _longest(starts: NDArray[np.int64], used: NDArray[np.bool_]) -> float:
    """Return the longest span of instants [s] that were not used, from first to last of them."""
    if used.all():
        return 0.0
    edges = np.flatnonzero(np.diff(np.concatenate(([1], used.astype(np.int8), [1]))))
    spans = [starts[end - 1] - starts[begin] for begin, end in edges.reshape(-1, 2)]
    return float(max(spans)) / 1e9


def _judge_sweeps(
    verdict: Verdict,
    case: FaultCase,
    device: VirtualL2,
    placed: list[_Placed],
    answers: list[int],
    sweeps: list[Sweep],
    fragments: int,
) -> None:
    """Compare every sweep with the points of the packets it must consist of, bit by bit.

    Between sweeps lie the packets of fragments of turns, as many as the driver has counted.
    """
    kind = PacketType.POINTS_2D if case.flat else PacketType.POINTS_3D
    packets = device.packet_log.packets
    used = [item.published and packets["type"][item.row] == kind for item in placed]
    rows = [item.row for item, is_used in zip(placed, used, strict=True) if is_used]
    starts = [answer for answer, is_used in zip(answers, used, strict=True) if is_used]
    payloads, _ = PatternScanner(flat=case.flat).packets(
        0, int(packets["index"].max(initial=0)) + 1
    )
    projector = Projector(kind)
    stamps = {start: at for at, start in enumerate(starts)}
    at = left_out = 0
    for sweep in sweeps:
        begin = stamps.get(sweep.start, at)
        left_out += begin - at
        at = begin + sweep.packets
        truth = projector.points(
            [payloads[index].tobytes() for index in packets["index"][rows[begin:at]]],
            np.arange(sweep.packets, dtype=np.float64) * wire.MIRROR_PERIOD_S,
        ).points
        verdict.wrong_sweeps += len(truth) != len(sweep.points) or any(
            not np.array_equal(truth[name], sweep.points[name]) for name in _EXACT
        )
    left_out += len(rows) - at
    verdict.wrong_sweeps += left_out != fragments


def _counted(driver: Driver) -> dict[str, int]:
    """Return what the driver itself says went wrong."""
    counters = driver.counters
    counts = {"damaged": counters.faults.total(), "impossible": counters.rejected.total()}
    for one in counters.sequence.values():
        for name in ("lost", "duplicates", "late", "reordered", "restarts"):
            counts[name] = counts.get(name, 0) + int(getattr(one, name))
    return counts


SINGLE: Final = (
    FaultCase("none", {}),
    FaultCase("none, 2D", {}, flat=True),
    FaultCase("bad CRC 5 %", {"bad_crc": 0.05}),
    FaultCase("truncated 5 %", {"truncate": 0.05}),
    FaultCase("truncated 5 %, 2D", {"truncate": 0.05}, flat=True),
    FaultCase("hostile size 5 %", {"hostile_size": 0.05}),
    FaultCase("hostile count 5 %", {"hostile_count": 0.05}),
    FaultCase("not a number 5 %", {"nan": 0.05}),
    FaultCase("garbage 10 %", {"garbage": 0.1}),
    FaultCase("coalesced 50 %", {"coalesce": 0.5}),
    FaultCase("split 50 %", {"split": 0.5}),
    FaultCase("split 50 %, 2D", {"split": 0.5}, flat=True),
    FaultCase("loss 5 %", {"loss": 0.05}),
    FaultCase("loss 30 %", {"loss": 0.3}),
    FaultCase("commands lost 50 %", {"command_loss": 0.5}),
    FaultCase("duplicates 10 %", {"duplicate": 0.1}),
    FaultCase("reordered 5 %, 10 ms", {"reorder": 0.05}),
    FaultCase(
        "reordered 5 %, 45 ms, window 20",
        {"reorder": 0.05, "reorder_ms": 45.0},
        values={"reorder_window": 20},
    ),
    FaultCase("jitter uniform 2 ms", {"jitter": "uniform", "jitter_ms": 2.0}),
    FaultCase("jitter heavy 2 ms", {"jitter": "heavy", "jitter_ms": 2.0}),
    FaultCase("bursts 100 ms", {"burst_ms": 100.0}),
    FaultCase("cable out 3 s", {"silence_at": (5.0,), "silence_s": 3.0}, 14.0),
    FaultCase("cable out 10 s", {"silence_at": (5.0,), "silence_s": 10.0}, 22.0),
    FaultCase("reboot", {"reboot_at": (5.0,)}, 14.0),
    FaultCase("reboot twice", {"reboot_at": (5.0, 8.5)}, 18.0),
    FaultCase("reboot, 2D", {"reboot_at": (5.0,)}, 14.0, flat=True),
    FaultCase("device clock -50 ms", {"clock_step_at": (5.0,)}),
    FaultCase("device clock +2 s", {"clock_step_at": (5.0,), "clock_step_ms": 2000.0}),
    FaultCase("foreign sync +5 s", {"foreign_sync_at": (5.0,)}),
    FaultCase("foreign sync -1 h", {"foreign_sync_at": (5.0,), "foreign_sync_error_s": -3600.0}),
    FaultCase("host clock +1 s", {}, 14.0, host_steps=((5.0, 10**9),)),
    FaultCase("host clock +1 h", {}, 14.0, host_steps=((5.0, 3600 * 10**9),)),
    FaultCase("host clock -0.2 s", {}, 14.0, host_steps=((5.0, -200_000_000),)),
    FaultCase("host clock -4 s", {}, 14.0, host_steps=((5.0, -4 * 10**9),)),
)
"""Every fault of the virtual L2 alone, and steps of the host's own clock."""


def random_case(number: int, seconds: float) -> FaultCase:
    """Return a random combination of faults."""
    rng = np.random.default_rng([number, 8])
    rates = {
        "bad_crc": 0.02, "truncate": 0.02, "hostile_size": 0.02, "hostile_count": 0.02,
        "nan": 0.02, "garbage": 0.05, "coalesce": 0.5, "split": 0.3, "loss": 0.05,
        "command_loss": 0.3, "duplicate": 0.05, "reorder": 0.03,
    }  # fmt: skip
    faults: dict[str, Value] = {
        name: float(rng.uniform(0.0, rate)) for name, rate in rates.items() if rng.random() < 0.4
    }
    for name in ("silence_at", "reboot_at", "clock_step_at", "foreign_sync_at"):
        if rng.random() < 0.3:
            faults[name] = (float(rng.uniform(2.0, seconds - 4.0)),)
    if rng.random() < 0.3:
        faults |= {"jitter": "heavy", "jitter_ms": float(rng.uniform(0.1, 2.0))}
    if rng.random() < 0.2:
        faults |= {"burst_ms": float(rng.uniform(10.0, 100.0))}
    flat = rng.random() < 0.2
    cut = str(rng.choice(["packets", "turn", "half_turn", "duration"]))
    return FaultCase(f"random {number}", faults, seconds, flat=flat, values={"sweep_cut": cut})
