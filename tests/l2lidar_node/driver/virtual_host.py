"""A host in virtual time: a real session that takes a moment for a minute, busy on request."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.emulator.config import DeviceConfig, FaultConfig, IdentityConfig, PowerConfig
from l2lidar_node.emulator.unit.device import VirtualL2
from l2lidar_node.emulator.unit.stream import PatternScanner, StillInertial
from l2lidar_node.protocol.wire import WorkMode
from l2lidar_node.recording.capture import Endpoint
from l2lidar_node.recording.recording import RecordingWriter
from l2lidar_node.settings import build
from l2lidar_node.transport.host_clock import HostClock
from l2lidar_node.transport.session import Session
from l2lidar_node.types import NOT_AWAITED, Datagram, HostNs, ImuSample, Sweep

EPOCH_NS = 1_700_000_000_000_000_000
DEVICE = Endpoint("192.168.1.62", 6101)
HOST = Endpoint("192.168.1.2", 6201)
READY = PowerConfig(boot_scale=0.0)
STANDARD = WorkMode(0)


class MemoryTap(RecordingWriter):
    """A recorder into memory."""

    def __init__(self) -> None:
        self.stream = io.BytesIO()
        super().__init__(self.stream, DEVICE, HOST)

    def close(self) -> None:
        pass


class VirtualClock(HostClock):
    """A clock that shows what it is told, is set at given instants and slewed in between."""

    def __init__(
        self, steps: Sequence[tuple[float, float]], slews: Sequence[tuple[float, float, float]]
    ) -> None:
        super().__init__()
        self.true_ns = EPOCH_NS
        self._slews = slews
        self._steps = [(EPOCH_NS + round(at * 1e9), round(by * 1e9)) for at, by in steps]
        self._noticed = 0

    def shown(self, true_ns: int) -> HostNs:
        stepped = sum(by for at, by in self._steps if at <= true_ns)
        return HostNs(true_ns + stepped + self.slewed(true_ns))

    def slewed(self, true_ns: int) -> int:
        at = (true_ns - EPOCH_NS) * 1e-9
        moved = (max(min(at, stop) - start, 0.0) * ppm for start, stop, ppm in self._slews)
        return round(sum(moved) * 1e3)

    def now(self) -> HostNs:
        return self.shown(self.true_ns)

    def step_ns(self) -> int:
        ahead = self.now() - self.true_ns - self.slewed(self.true_ns)
        before, self._noticed = self._noticed, ahead
        return self._noticed - before

    def _read_slewing(self) -> tuple[int, int, int]:
        slewed = self.slewed(self.true_ns)
        return self.true_ns + slewed, slewed + int(self.true_ns * 7919 % 401) - 200, 200


class VirtualHost:
    """Transport and clock of a session with a virtual L2."""

    foreign = 0
    stranger = ""
    kernel_drops = 0
    send_errors = 0

    def __init__(
        self,
        device: VirtualL2,
        clock: VirtualClock,
        seconds: float,
        busy: float,
        late: Sequence[tuple[float, float, float]],
        seed: int,
    ) -> None:
        self.now = EPOCH_NS
        self._clock = clock
        self._late = late
        self._way: deque[tuple[int, bytes]] = deque()
        self.session: Session | None = None
        self.todo: list[tuple[int, Callable[[], None]]] = []
        self._device = device
        self._end = EPOCH_NS + round(seconds * 1e9)
        self._busy = busy
        self._rng = np.random.default_rng(seed)
        self._held: list[Datagram] = []

    def receive(self, timeout_s: float, awaited: HostNs = NOT_AWAITED) -> list[Datagram]:
        del awaited
        is_busy = self._rng.random() < self._busy
        step_s = self._rng.uniform(0.05, 0.5) if is_busy else self._rng.uniform(0.0, timeout_s)
        self.now += round(step_s * 1e9)
        self._clock.true_ns = self.now
        if self.now >= self._end and self.session is not None:
            self.session.stop()
        while self.todo and self.todo[0][0] <= self.now:
            self.todo.pop(0)[1]()
        self._way += [(self._arrival(at), data) for at, data in self._device.advance(self.now)]
        while self._way and self._way[0][0] <= self.now:
            at, data = self._way.popleft()
            self._held.append(Datagram(data, self._clock.shown(at)))
        batch, self._held = self._held[:64], self._held[64:]
        return batch

    def _arrival(self, at: int) -> int:
        """Return when a datagram arrives that would at an instant; none overtakes another."""
        seconds = (at - EPOCH_NS) / 1e9
        late = sum(by for begin, end, by in self._late if begin <= seconds < end)
        return max(at + round(late * 1e9), self._way[-1][0] if self._way else 0)

    def send(self, frame: bytes) -> None:
        self._device.command(frame, self.now)

    def close(self) -> None:
        pass


def live_run(
    seconds: float = 5.0,
    *,
    settings: dict[str, Any] | None = None,
    faults: dict[str, Any] | None = None,
    busy: float = 0.0,
    calls: Sequence[tuple[float, Callable[[Driver, HostNs], object]]] = (),
    host_steps: Sequence[tuple[float, float]] = (),
    host_slews: Sequence[tuple[float, float, float]] = (),
    late: Sequence[tuple[float, float, float]] = (),
    seed: int = 1,
    power: PowerConfig = READY,
    mode: WorkMode = STANDARD,
    empty: bool = False,
) -> tuple[DriverConfig, list[Event], MemoryTap]:
    """Run a session in virtual time; return its settings, its events and what its tap wrote."""
    unit = DeviceConfig(
        power=power,
        identity=IdentityConfig(work_mode=int(mode)),
        faults=build(FaultConfig, faults or {}),
        seed=seed,
    )
    scanner = PatternScanner(flat=bool(mode & WorkMode.MODE_2D), empty=empty)
    device = VirtualL2(unit, scanner, StillInertial(), power_on_ns=EPOCH_NS, modes={mode: scanner})
    clock = VirtualClock(host_steps, host_slews)
    host = VirtualHost(device, clock, seconds, busy, late, seed)
    config = build(DriverConfig, {"watchdog_action": "wait", **(settings or {})})
    tap = MemoryTap()
    events: list[Event] = []
    session = Session(Driver(config), host, events.append, tap, clock)
    host.session = session

    def command(function: Callable[[Driver, HostNs], object]) -> None:
        def run(driver: Driver, now: HostNs) -> None:
            result = function(driver, now)
            found = result[1] if isinstance(result, tuple) else result
            events.extend(found if isinstance(found, list) else [])

        session.call(run)

    host.todo = [
        (EPOCH_NS + round(at * 1e9), lambda function=function: command(function))
        for at, function in calls
    ]
    session.start()
    session._thread.join(600)
    assert session.failure is None
    return config, events, tap


def essence(events: Iterable[Event]) -> list[object]:
    """Return sweeps and samples in a form that compares equal when every bit is."""
    return [
        (event.start, event.end, event.packets, event.missing, event.points.tobytes())
        if isinstance(event, Sweep)
        else event
        for event in events
        if isinstance(event, Sweep | ImuSample)
    ]
