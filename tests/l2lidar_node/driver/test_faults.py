"""The whole driver against every fault of the virtual L2, whose packet log knows what arrived."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import Any

import pytest

from l2lidar_node.clock import ClockEvent
from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.emulator.config import DeviceConfig, FaultConfig, IdentityConfig
from l2lidar_node.emulator.unit.device import VirtualL2
from l2lidar_node.emulator.unit.stream import PatternScanner, StillInertial
from l2lidar_node.protocol.framing import Frame, Framer
from l2lidar_node.protocol.packets import ImuPacket, PointPacket, decode
from l2lidar_node.protocol.wire import WorkMode
from l2lidar_node.settings import build as configure
from l2lidar_node.types import HostNs, ImuSample, Stream, Sweep
from tests.l2lidar_node.emulator import rig
from tests.support import build

TICK_NS = 10_000_000
MODES = [WorkMode(0), WorkMode.MODE_2D]

DAMAGE = {
    "bad_crc": {"bad_crc": 0.05},
    "truncate": {"truncate": 0.05},
    "hostile_size": {"hostile_size": 0.05},
    "garbage": {"garbage": 0.1},
    "damage_and_cuts": {
        "bad_crc": 0.02, "truncate": 0.02, "garbage": 0.05, "hostile_size": 0.02, "split": 0.5,
        "coalesce": 0.5,
    },
}  # fmt: skip
CONTENT = {"hostile_count": {"hostile_count": 0.05}, "nan": {"nan": 0.05}}
HARMLESS = {"none": {}, "coalesce": {"coalesce": 0.5}, "split": {"split": 0.5}}
TRAFFIC = {"loss": {"loss": 0.05}, "duplicate": {"duplicate": 0.1}, "reorder": {"reorder": 0.05}}
EVERYTHING = {
    "everything": DAMAGE["damage_and_cuts"]
    | {"loss": 0.02, "duplicate": 0.05, "reorder": 0.02, "nan": 0.02, "hostile_count": 0.02}
}
CASES = DAMAGE | CONTENT | HARMLESS | TRAFFIC | EVERYTHING


class Outcome:
    """What a driver made of a faulty device, and what it could have made of it."""

    def __init__(self, faults: dict[str, Any], mode: WorkMode, seconds: float = 3.0) -> None:
        unit = DeviceConfig(
            power=rig.READY,
            identity=IdentityConfig(work_mode=int(mode)),
            faults=configure(FaultConfig, faults),
            seed=3,
        )
        self.device = VirtualL2(
            unit, PatternScanner(), StillInertial(), power_on_ns=build.EPOCH_NS
        )
        values = {"imu_adjust": False, "frame3d": not mode & WorkMode.MODE_2D}
        self.driver = Driver(configure(DriverConfig, values))
        self.events: list[Event] = []
        self.decoded: Counter[tuple[int, int, int]] = Counter()
        framer = Framer()
        for tick in range(1, round(seconds * 1e9 / TICK_NS)):
            now = build.EPOCH_NS + tick * TICK_NS
            for at, data in self.device.advance(now):
                self.events += self.driver.receive(data, HostNs(at))
                for item in framer.feed(data):
                    self._note(item)
            self.events += self.driver.tick(HostNs(now))
            for outgoing in self.driver.outbox():
                self.device.command(outgoing.frame, now)
        self.events += self.driver.flush()

    def _note(self, item: object) -> None:
        packet = decode(item) if isinstance(item, Frame) else None
        if isinstance(packet, ImuPacket | PointPacket) and isinstance(item, Frame):
            self.decoded[(item.packet_type, packet.seq, packet.stamp)] += 1

    def of(self, kind: type) -> list[Any]:
        return [event for event in self.events if isinstance(event, kind)]

    def used(self, stream: Stream) -> int:
        """Return how many packets became samples or parts of sweeps, or came before the lock."""
        if stream is Stream.IMU:
            made = len(self.of(ImuSample))
        else:
            made = sum(sweep.packets for sweep in self.of(Sweep))
        return made + self.driver.counters.unlocked[stream]

    def distinct(self, stream: Stream) -> int:
        """Return how many different packets arrived in a usable state."""
        types = (104,) if stream is Stream.IMU else (102, 103)
        return sum(packet[0] in types for packet in self.decoded)


def is_measurement(identity: tuple[int, int, int]) -> bool:
    return identity[0] in (102, 103, 104)


@pytest.fixture(scope="module")
def outcomes() -> dict[tuple[str, int], Outcome]:
    return {}


@pytest.fixture(params=MODES, ids=["3d", "2d"])
def mode(request: pytest.FixtureRequest) -> WorkMode:
    return request.param


@pytest.fixture
def outcome(
    request: pytest.FixtureRequest, outcomes: dict[tuple[str, int], Outcome], mode: WorkMode
) -> Outcome:
    key = (request.param, int(mode))
    if key not in outcomes:
        seconds = 3.0 if request.param in CONTENT else 1.8
        outcomes[key] = Outcome(CASES[request.param], mode, seconds)
    return outcomes[key]


@pytest.mark.parametrize("outcome", CASES, indirect=True)
def test_every_packet_that_arrived_whole_is_decoded(outcome: Any) -> None:
    booked = Counter({k: n for k, n in rig.booked(outcome.device).items() if is_measurement(k)})
    assert booked - outcome.decoded == Counter()
    assert booked.total() > 400


@pytest.mark.parametrize("outcome", CASES, indirect=True)
@pytest.mark.parametrize("stream", Stream)
def test_every_packet_that_was_decoded_is_used_once_and_in_order(
    outcome: Any, stream: Any
) -> None:
    counts = outcome.driver.counters.sequence[stream]
    assert outcome.used(stream) + counts.late == outcome.distinct(stream)
    assert counts.restarts == 0
    stamps = [sample.stamp for sample in outcome.of(ImuSample)]
    starts = [sweep.start for sweep in outcome.of(Sweep)]
    for instants in (stamps, starts):
        assert all(one < other for one, other in pairwise(instants))


@pytest.mark.parametrize("outcome", CASES, indirect=True)
@pytest.mark.parametrize("stream", Stream)
def test_the_loss_counted_is_the_loss(outcome: Any, stream: Any) -> None:
    types = (104,) if stream is Stream.IMU else (102, 103)
    numbers = [
        (int(row["stamp_ns"]), int(row["seq"]))
        for row in outcome.device.packet_log.packets
        if row["type"] in types
    ]
    known = {(stamp, seq) for kind, seq, stamp in outcome.decoded if kind in types}
    place = [index for index, pair in enumerate(numbers) if pair in known]
    between = place[-1] - place[0] + 1
    assert outcome.driver.counters.sequence[stream].lost == between - len(place)


@pytest.mark.parametrize("outcome", [*HARMLESS, *CONTENT], indirect=True)
def test_nothing_is_called_damaged_that_is_not(outcome: Any) -> None:
    assert outcome.driver.counters.faults.total() == 0


@pytest.mark.parametrize("outcome", DAMAGE, indirect=True)
def test_damage_is_counted(outcome: Any) -> None:
    counters = outcome.driver.counters
    assert counters.faults.total() > 20
    assert counters.rejected.total() == 0


@pytest.mark.parametrize(
    ("outcome", "reason"),
    [("nan", "not_finite"), ("hostile_count", "point_num")],
    indirect=["outcome"],
)
def test_impossible_content_is_counted_by_reason(outcome: Any, reason: str) -> None:
    rejected = outcome.driver.counters.rejected
    assert rejected.total() > 5
    assert {name.split(".")[1] for name in rejected} == {reason}


def test_a_reboot_loses_no_packet(mode: WorkMode) -> None:
    outcome = Outcome({"reboot_at": [1.9]}, mode)
    for stream in Stream:
        counts = outcome.driver.counters.sequence[stream]
        assert counts.restarts == 1
        assert counts.lost == counts.late == counts.duplicates == 0
    # Numbers and stamps of both lives are the same: here packets have to be counted one by one.
    assert sum(map(outcome.used, Stream)) == outcome.decoded.total()
    assert "REBOOT" in [event.kind.name for event in outcome.of(ClockEvent)]


def test_a_pulled_cable_costs_what_was_sent_meanwhile() -> None:
    outcome = Outcome({"silence_at": [1.5], "silence_s": 4.2}, WorkMode(0), seconds=8.0)
    for stream in Stream:
        assert outcome.used(stream) == outcome.distinct(stream)
        counts = outcome.driver.counters.sequence[stream]
        assert counts.late == counts.duplicates == counts.restarts == 0
        assert counts.lost > 0


@pytest.mark.parametrize("fault", [{"clock_step_at": [1.5]}, {"foreign_sync_at": [1.5]}])
def test_steps_of_the_devices_clock_lose_nothing(fault: Any, mode: WorkMode) -> None:
    outcome = Outcome(fault, mode)
    for stream in Stream:
        counts = outcome.driver.counters.sequence[stream]
        assert counts.lost == counts.late == counts.restarts == 0
        assert outcome.used(stream) == outcome.distinct(stream)
    stamps = [sample.stamp for sample in outcome.of(ImuSample)]
    assert all(one < other for one, other in pairwise(stamps))
