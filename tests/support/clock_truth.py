"""Simulates what a clock is given: stamps and arrivals of both streams, with their truth.

A second, much faster model beside the emulator, of nothing but time: no bytes, no world. Tests and
``bench_clock`` use it; the emulator's own truth judges the same rows more slowly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import Stream
from tests.support.clock_loads import Load, LoadedPath

EVENT: Final = np.dtype(
    [
        ("kind", "u1"),  # IMU, POINTS, SYNC, STEP or SLEW
        ("seq", "<i8"),
        ("stamp", "<i8"),  # [ns] device clock; SYNC: the value sent; STEP, SLEW: by how much
        ("arrival", "<i8"),  # [ns] host clock; of a SYNC: when it was sent; a STEP: was noticed
        ("duration", "<i8"),  # [ns] from the stamped instant to the last measurement
        ("truth", "<i8"),  # [ns] host clock at the stamped instant
    ]
)
"""One thing that happens at the host, in the order in which it happens."""

IMU: Final = 0
POINTS: Final = 1
SYNC: Final = 2
STEP: Final = 3
SLEW: Final = 4
STREAMS: Final = {IMU: Stream.IMU, POINTS: Stream.POINTS}

_MS: Final = 1_000_000
_SEQ_MODULUS: Final = 1025
_POINTS_PERIOD: Final = 4.639e6
_SWEEP: Final = 299 * 7.7316e3  # [ns] first to last slot


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """What the device, the path and the hosts do, in seconds unless a name says otherwise.

    Attributes
    ----------
    ratio : float
        True seconds per device second.
    drift_ppm, drift_period : float
        Amplitude and period of a slow oscillation of the device's rate, as temperature makes it.
    sync : str
        ``off``, ``once`` or ``periodic`` (every ``sync_ms``).
    command_ms : float
        Mean of the exponential part of the way of a command to the device.
    path_ms : float
        Constant part of the way of a packet to the host.
    jitter : str
        ``none``; ``uniform`` up to ``jitter_ms``; ``exponential`` with that mean; ``heavy``:
        mostly nothing, 99th percentile ``jitter_ms``.
    fifo : bool
        Whether packets keep their order on the way (a datagram behind a late one is late too).
    burst_ms, burst_every : float
        For so long nothing arrives, then all at once; 0 = never.
    loss, reorder : float
        Probability that a packet is lost, or overtaken by later ones (``reorder_ms`` late).
    reboot_at, foreign_at : tuple of float
        When the device restarts (for ``reboot_s``), or another host sets its clock.
    foreign_steps : tuple of (float, float)
        When another host moves the device's clock, and by how many seconds.
    host_slews : tuple of (float, float, float)
        From when to when a time server adjusts the rate of the host's clock, and by how many ppm.
    are_slews_told : bool
        Whether the host tells by how much it was slewed, to 0.2 us: every 100 ms, and when the
        rate changes.
    host_steps : tuple of (float, float)
        When the host's clock is set, and by how many seconds.
    notice_ms : float
        How long it takes until the host notices that its clock was set, which it then tells, as
        it does that it will; negative: it never does.
    delays : tuple of (float, float, float)
        From when to when, and by how many seconds, packets leave later; they keep their order.
    loads : tuple of Load
        What delays packets meanwhile; those of one path keep their order.
    silences : tuple of (float, float)
        From when to when nothing arrives, and what is sent is lost.
    imu_noise_us : float
        Standard deviation of the instants at which the IMU is sampled.
    stamp_step : int
        Resolution of the device's stamps [ns].
    imu, points : bool
        Which streams there are.
    points_from : float
        When the first point packet is measured.
    """

    seconds: float = 30.0
    ratio: float = 1.99866
    drift_ppm: float = 0.0
    drift_period: float = 60.0
    sync: str = "off"
    sync_ms: float = 50.0
    sync_loss: float = 0.0
    command_ms: float = 0.3
    path_ms: float = 0.2
    jitter: str = "none"
    jitter_ms: float = 0.5
    fifo: bool = True
    burst_ms: float = 0.0
    burst_every: float = 1.0
    loss: float = 0.0
    reorder: float = 0.0
    reorder_ms: float = 10.0
    reboot_at: tuple[float, ...] = ()
    reboot_s: float = 1.0
    foreign_at: tuple[float, ...] = ()
    foreign_error: float = 5.0
    foreign_steps: tuple[tuple[float, float], ...] = ()
    host_slews: tuple[tuple[float, float, float], ...] = ()
    are_slews_told: bool = False
    host_steps: tuple[tuple[float, float], ...] = ()
    notice_ms: float = -1.0
    delays: tuple[tuple[float, float, float], ...] = ()
    silences: tuple[tuple[float, float], ...] = ()
    loads: tuple[Load, ...] = ()
    imu: bool = True
    imu_noise_us: float = 0.0
    stamp_step: int = 1
    points: bool = True
    points_from: float = 0.0
    points_jitter: float = 1e-3
    seq_modulus: int = _SEQ_MODULUS
    uptime: float = 40.0
    epoch: int = 1_760_000_000_000_000_000


def simulate(scenario: Scenario, seed: int) -> NDArray[np.void]:
    """Return what happens at the host, shape (N,), dtype EVENT, in order of time."""
    rng = np.random.default_rng(seed)
    parts = [_sent(scenario)]
    clock = _DeviceClock(scenario, parts[0], rng)
    if scenario.imu:
        instants = np.arange(0.0, scenario.seconds * 1e9, 4e6) + rng.uniform(0.0, 4e6)
        instants += rng.normal(0.0, scenario.imu_noise_us * 1e3, len(instants))
        parts.append(_packets(scenario, IMU, instants, 0.0, clock))
    if scenario.points:
        count = int((scenario.seconds - scenario.points_from) * 1e9 / _POINTS_PERIOD)
        periods = _POINTS_PERIOD * (1.0 + scenario.points_jitter * rng.normal(size=count))
        instants = scenario.points_from * 1e9 + np.cumsum(periods) + rng.uniform(0.0, 4e6)
        parts.append(_packets(scenario, POINTS, instants, _SWEEP, clock))
    syncs, packets = parts[0], np.concatenate(parts[1:])
    packets = _travel(scenario, packets[np.argsort(packets["arrival"], kind="stable")], rng)
    events = np.concatenate([_told(scenario), _slewed(scenario, rng), syncs, packets])
    events = events[np.argsort(events["arrival"], kind="stable")]
    return _on_host_clock(scenario, events)


def _told(scenario: Scenario) -> NDArray[np.void]:
    """Return what the host says of its clock; times still on the ideal line that starts at 0."""
    if scenario.notice_ms < 0.0:
        return np.zeros(0, EVENT)
    events = np.zeros(1 + len(scenario.host_steps), EVENT)
    events["kind"] = STEP
    for event, (at, by) in zip(events[1:], scenario.host_steps, strict=True):
        event["arrival"] = round(at * 1e9 + scenario.notice_ms * _MS)
        event["stamp"] = round(by * 1e9)
    return events


def _slewed(scenario: Scenario, rng: np.random.Generator) -> NDArray[np.void]:
    """Return what the host says of slewing; times still on the ideal line that starts at 0."""
    if not scenario.are_slews_told:
        return np.zeros(0, EVENT)
    changes = [
        round(at * 1e9) + delay * _MS
        for slew in scenario.host_slews
        for at in slew[:2]
        for delay in (10, 20)
    ]
    steady = np.arange(0, round(scenario.seconds * 1e9), 100 * _MS)
    instants = np.union1d(steady, np.array(changes, np.int64))
    events = np.zeros(len(instants), EVENT)
    events["kind"] = SLEW
    events["arrival"] = instants
    events["stamp"] = _host_slewed(scenario, instants) + rng.integers(-200, 200, len(instants))
    return events


def _sent(scenario: Scenario) -> NDArray[np.void]:
    """Return the syncs the host sends; times still on the ideal line that starts at 0."""
    first = 0.1
    instants = {
        "off": np.zeros(0),
        "once": np.array([first, *(at + scenario.reboot_s + 0.1 for at in scenario.reboot_at)]),
        "periodic": np.arange(first, scenario.seconds, scenario.sync_ms * 1e-3),
    }[scenario.sync]
    events = np.zeros(len(instants), EVENT)
    events["kind"] = SYNC
    events["arrival"] = events["stamp"] = events["truth"] = np.round(instants * 1e9)
    return events


class _DeviceClock:
    """The device's clock as piecewise integral of its rate."""

    def __init__(
        self, scenario: Scenario, syncs: NDArray[np.void], rng: np.random.Generator
    ) -> None:
        self._scenario = scenario
        shift = _host_shift(scenario, syncs["arrival"]) + scenario.epoch
        lost = rng.random(len(syncs)) < scenario.sync_loss
        latency = 0.15e6 + rng.exponential(scenario.command_ms * 1e6, len(syncs))
        steps = [(0.0, scenario.uptime * 1e9 / scenario.ratio)]
        for sent, value in zip(
            (syncs["arrival"] + latency)[~lost], (syncs["stamp"] + shift)[~lost], strict=True
        ):
            if not self._dead(sent):
                steps.append((float(sent), int(value)))
        steps += [((at + scenario.reboot_s) * 1e9, 2.0e9) for at in scenario.reboot_at]
        steps += [
            (at * 1e9, at * 1e9 + scenario.epoch + scenario.foreign_error * 1e9)
            for at in scenario.foreign_at
        ]
        steps.sort()
        self._starts = np.array([start for start, _ in steps])
        self._values = np.array([int(value) for _, value in steps], dtype=np.int64)

    def _dead(self, instant: float) -> bool:
        scenario = self._scenario
        return any(
            at <= instant * 1e-9 <= at + scenario.reboot_s for at in scenario.reboot_at
        ) or any(start <= instant * 1e-9 <= stop for start, stop in scenario.silences)

    def _elapsed(self, instants: NDArray[np.float64]) -> NDArray[np.float64]:
        scenario = self._scenario
        angular = 2.0 * np.pi / (scenario.drift_period * 1e9)
        wave = scenario.drift_ppm * 1e-6 / angular * (1.0 - np.cos(angular * instants))
        return np.asarray((instants + wave) / scenario.ratio)

    def at(self, instants: NDArray[np.float64]) -> NDArray[np.int64]:
        epoch = np.searchsorted(self._starts, instants, side="right") - 1
        elapsed = self._elapsed(instants) - self._elapsed(self._starts)[epoch]
        shown = self._values[epoch] + np.floor(elapsed).astype(np.int64)
        for at, by in self._scenario.foreign_steps:
            shown[instants >= at * 1e9] += round(by * 1e9)
        return np.asarray(shown)


def _packets(
    scenario: Scenario,
    kind: int,
    instants: NDArray[np.float64],
    duration: float,
    clock: _DeviceClock,
) -> NDArray[np.void]:
    events = np.zeros(len(instants), EVENT)
    events["kind"] = kind
    events["truth"] = instants
    events["stamp"] = clock.at(instants) // scenario.stamp_step * scenario.stamp_step
    events["duration"] = int(duration)
    events["arrival"] = instants + duration + scenario.path_ms * 1e6
    ordinal = np.arange(len(instants)) + (317 if kind == IMU else 801)
    for at in scenario.reboot_at:
        stop = (at + scenario.reboot_s) * 1e9
        alive = (instants < at * 1e9) | (instants >= stop)
        first = np.searchsorted(instants, stop)
        ordinal[first:] = np.arange(len(instants) - first)
        events["seq"] = ordinal % scenario.seq_modulus
        events, instants, ordinal = events[alive], instants[alive], ordinal[alive]
    events["seq"] = ordinal % scenario.seq_modulus
    return events


def _travel(
    scenario: Scenario, packets: NDArray[np.void], rng: np.random.Generator
) -> NDArray[np.void]:
    """Return the packets that arrive, with the time at which they do."""
    count = len(packets)
    jitter = _jitter(scenario, count, rng)
    arrival = packets["arrival"] + jitter * _MS
    if scenario.burst_ms:
        phase = np.mod(arrival, scenario.burst_every * 1e9)
        held = phase < scenario.burst_ms * _MS
        arrival[held] += scenario.burst_ms * _MS - phase[held]
    for start, stop, by in scenario.delays:
        held = (arrival >= start * 1e9) & (arrival < stop * 1e9)
        arrival[held] += by * 1e9
    if scenario.fifo or scenario.delays:
        arrival = np.maximum.accumulate(arrival)
    if scenario.loads:
        path = LoadedPath(scenario.loads, int(rng.integers(1 << 32)))
        for at in np.argsort(arrival, kind="stable").tolist():
            arrival[at] = path.deliver(int(arrival[at]), packets["kind"][at] == IMU)
    late = rng.random(count) < scenario.reorder
    arrival[late] += scenario.reorder_ms * _MS
    packets["arrival"] = arrival
    keep = rng.random(count) >= scenario.loss
    for start, stop in scenario.silences:
        keep &= (arrival < start * 1e9) | (arrival > stop * 1e9)
    return packets[keep]


def _jitter(scenario: Scenario, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return one random delay per packet [ms]."""
    width = scenario.jitter_ms
    if scenario.jitter == "uniform":
        return rng.uniform(0.0, width, count)
    if scenario.jitter == "exponential":
        return rng.exponential(width, count)
    if scenario.jitter == "heavy":
        return _heavy(rng, count, width)
    return np.zeros(count)


def _heavy(rng: np.random.Generator, count: int, p99_ms: float) -> NDArray[np.float64]:
    """Return Pareto delays (tail index 1.5) by their 99th percentile, at most 10 times that."""
    delays = (rng.random(count) ** (-1.0 / 1.5) - 1.0) * p99_ms / (0.01 ** (-1.0 / 1.5) - 1.0)
    return np.asarray(np.minimum(delays, 10.0 * p99_ms))


def _host_shift(scenario: Scenario, instants: NDArray[np.int64]) -> NDArray[np.int64]:
    shift = np.zeros(len(instants), np.int64)
    for at, step in scenario.host_steps:
        shift[instants >= at * 1e9] += int(step * 1e9)
    return shift + _host_slewed(scenario, instants)


def _host_slewed(scenario: Scenario, instants: NDArray[np.int64]) -> NDArray[np.int64]:
    shift = np.zeros(len(instants), np.int64)
    for start, stop, ppm in scenario.host_slews:
        slewed = np.clip(instants, start * 1e9, stop * 1e9) - start * 1e9
        shift += np.round(slewed * ppm * 1e-6).astype(np.int64)
    return shift


def _on_host_clock(scenario: Scenario, events: NDArray[np.void]) -> NDArray[np.void]:
    sync = events["kind"] == SYNC
    arrival_shift = _host_shift(scenario, events["arrival"])
    events["stamp"][sync] += (arrival_shift + scenario.epoch)[sync]
    events["truth"] += _host_shift(scenario, events["truth"]) + scenario.epoch
    events["arrival"] += arrival_shift + scenario.epoch
    return events
