"""The composed driver: datagrams with their arrival in, everything that happens out."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2lidar_node.clock import ClockEvent
from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.device import REPEAT_NS, TRIES, Answer, DeviceState
from l2lidar_node.driver.driver import Counters, Driver, Event, Silence
from l2lidar_node.driver.reorder import REORDER_NS, SequenceCounts
from l2lidar_node.protocol import commands, wire
from l2lidar_node.protocol.packets import Parameters, Version
from l2lidar_node.protocol.wire import AckStatus, PacketType, UserCommand
from l2lidar_node.settings import build as configure
from l2lidar_node.types import HostNs, ImuSample, Stream, Sweep
from tests.support import build
from tests.support.build import Datagram

PLAIN: dict[str, Any] = {"enable_l2_host_sync": False, "imu_adjust": False}
END = HostNs(build.EPOCH_NS)
TICK_NS = 10_000_000


class Run:
    """A driver that hears datagrams and is ticked every 10 ms, as a session does it."""

    def __init__(self, **values: Any) -> None:
        self.driver = Driver(configure(DriverConfig, PLAIN | values))
        self.events: list[Event] = []
        self.sent: list[bytes] = []
        self.now = build.EPOCH_NS

    def play(self, datagrams: Iterable[Datagram]) -> Run:
        for arrival, data in datagrams:
            self.wait((arrival - self.now) / 1e9)
            self.events += self.driver.receive(data, HostNs(arrival))
        return self

    def hear(self, packet_type: int, payload: bytes) -> list[Event]:
        events = self.driver.receive(build.frame(packet_type, payload), HostNs(self.now))
        self.events += events
        return events

    def wait(self, seconds: float) -> Run:
        end = self.now + round(seconds * 1e9)
        while self.now + TICK_NS <= end:
            self.now += TICK_NS
            self.events += self.driver.tick(HostNs(self.now))
            self.sent += self.outbox()
        return self

    def outbox(self) -> list[bytes]:
        return [item.frame for item in self.driver.outbox()]

    def of(self, kind: type) -> list[Any]:
        return [event for event in self.events if isinstance(event, kind)]

    @property
    def state(self) -> DeviceState:
        return self.driver.state(HostNs(self.now))


@pytest.fixture(scope="module")
def datagrams() -> list[Datagram]:
    return build.capture(2.0)


@pytest.fixture(scope="module")
def played(datagrams: list[Datagram]) -> Run:
    return Run().play(datagrams)


def same(one: list[Event], other: list[Event]) -> bool:
    """Tell whether two runs gave the same, points to the bit."""
    return len(one) == len(other) and all(map(_same, one, other))


def _same(one: Event, other: Event) -> bool:
    if not (isinstance(one, Sweep) and isinstance(other, Sweep)):
        return one == other
    facts = [(s.start, s.end, s.packets, s.missing, s.points.tobytes()) for s in (one, other)]
    return facts[0] == facts[1]


def test_sweeps_and_samples_come_once_the_clock_is_locked(
    played: Run, datagrams: list[Datagram]
) -> None:
    assert played.driver.catch_up() == []
    counters = played.driver.counters
    unlocked = counters.unlocked
    assert 0 < unlocked[Stream.IMU] < 250
    assert counters.samples == len(played.of(ImuSample)) == 500 - unlocked[Stream.IMU]
    packets = 431 - unlocked[Stream.POINTS]
    assert counters.sweeps == len(played.of(Sweep)) == packets // 38
    assert counters.points == sum(len(sweep.points) for sweep in played.of(Sweep))
    assert counters.slots == counters.sweeps * 38 * 300
    assert counters.datagrams == len(datagrams)
    assert counters.octets == sum(len(data) for _, data in datagrams)
    assert counters.frames == {102: 431, 104: 500}
    assert counters.faults.total() == counters.rejected.total() == 0
    assert [event.kind.name for event in played.of(ClockEvent)] == ["LOCKED"]


def test_stamps_are_true_but_for_the_constant_latency(played: Run) -> None:
    """The unit's clock runs at half speed; arrivals are 0.2 ms late, which nothing can tell."""
    first = played.driver.counters.unlocked[Stream.POINTS]
    for number, sweep in enumerate(played.of(Sweep)):
        true = build.EPOCH_NS + (first + 38 * number) * build.PERIOD_NS
        assert abs(sweep.start - 200_000 - true) < 20_000
    first = played.driver.counters.unlocked[Stream.IMU]
    for number, sample in enumerate(played.of(ImuSample)):
        true = build.EPOCH_NS + (first + number) * build.IMU_PERIOD_NS
        assert abs(sample.stamp - 200_000 - true) < 20_000


def test_a_replay_gives_the_same(played: Run, datagrams: list[Datagram]) -> None:
    assert same(played.events, Run().play(datagrams).events)


def test_a_sample_carries_what_was_sent() -> None:
    fields: dict[str, Any] = {
        "quaternion_wxyz": np.array([0.5, 0.5, -0.5, 0.5]) * 0.9983,
        "rate": (0.25, -0.5, 1.0),
        "acceleration": (1.0, -2.0, 9.5),
    }
    run = Run().play(build.capture(1.0, imu_fields=fields))
    sample = run.of(ImuSample)[-1]
    assert sample.orientation_wxyz == pytest.approx((0.5, 0.5, -0.5, 0.5), abs=1e-7)
    assert sample.angular_velocity == (0.25, -0.5, 1.0)
    assert sample.linear_acceleration == (1.0, -2.0, 9.5)
    assert run.driver.last_imu == sample


@pytest.mark.parametrize("pieces", [1, 3, 9])
def test_how_packets_are_cut_into_datagrams_does_not_matter(
    played: Run, datagrams: list[Datagram], pieces: int
) -> None:
    """Each piece comes when its packet came, the last one completes it."""
    cut = []
    for arrival, data in datagrams:
        size = -(-len(data) // pieces)
        cut += [Datagram(arrival, data[at : at + size]) for at in range(0, len(data), size)]
    assert same(played.events, Run().play(cut).events)


def test_coalesced_packets_give_the_same_points(played: Run, datagrams: list[Datagram]) -> None:
    pairs = zip(datagrams[::2], datagrams[1::2], strict=False)
    joined = [Datagram(second.arrival_ns, first.data + second.data) for first, second in pairs]
    run = Run().play(joined)
    counters = run.driver.counters
    assert counters.frames == {102: 431, 104: 499} or counters.frames == {102: 430, 104: 500}
    assert counters.faults.total() == 0
    assert int(build.digest(run.of(Sweep)[0].points)["points"]) > 10_000


def test_late_packets_are_put_into_their_place(played: Run, datagrams: list[Datagram]) -> None:
    late = list(datagrams)
    for at in range(400, 800, 50):
        item = late.pop(at)
        late.insert(at + 3, Datagram(late[at + 2].arrival_ns + 1000, item.data))
    run = Run().play(late)
    counts = run.driver.counters.sequence
    assert sum(count.reordered for count in counts.values()) > 0
    assert all(count.lost == count.late == 0 for count in counts.values())
    for one, other in zip(played.of(Sweep), run.of(Sweep), strict=True):
        assert abs(one.start - other.start) < 20_000
        for name in ("x", "y", "z", "intensity", "range"):
            np.testing.assert_array_equal(one.points[name], other.points[name])


def test_lost_packets_are_counted_by_stream_and_sweep(datagrams: list[Datagram]) -> None:
    points = [item for item in datagrams if len(item.data) == 1044]
    gone = set(points[200:203]) | {points[300]}
    gone |= {item for item in datagrams[700:720] if len(item.data) == 80}
    run = Run().play(item for item in datagrams if item not in gone)
    counts = run.driver.counters.sequence
    assert counts[Stream.POINTS].lost == 4
    assert counts[Stream.IMU].lost == len(gone) - 4
    assert sum(sweep.missing for sweep in run.of(Sweep)) == 4


def test_doubled_packets_are_used_once(played: Run, datagrams: list[Datagram]) -> None:
    run = Run().play(item for item in datagrams for _ in range(2))
    assert same(played.of(Sweep), run.of(Sweep))
    counts = run.driver.counters.sequence
    assert counts[Stream.POINTS].duplicates == 431
    assert counts[Stream.IMU].duplicates == 500


def test_damage_is_counted_and_costs_the_packet_it_hit(datagrams: list[Datagram]) -> None:
    damaged = list(datagrams)
    for at in (500, 600):
        arrival, data = damaged[at]
        damaged[at] = Datagram(arrival, data[:30] + b"\xee\xee" + data[32:])
    run = Run().play(damaged)
    counters = run.driver.counters
    assert counters.faults == {"crc": 2}
    assert counters.skipped_octets == sum(len(datagrams[at].data) for at in (500, 600))
    assert sum(count.lost for count in counters.sequence.values()) == 2


def test_impossible_contents_are_counted_by_reason() -> None:
    run = Run()
    run.hear(PacketType.POINTS_3D, build.points_3d(count=301))
    run.hear(PacketType.IMU, build.imu(quaternion_wxyz=(0, 0, 0, 0)))
    run.hear(PacketType.IMU, build.imu(rate=(np.nan, 0, 0)))
    assert run.driver.counters.rejected == {
        "102.point_num": 1, "104.quaternion_norm": 1, "104.not_finite": 1,
    }  # fmt: skip


def test_unknown_types_are_counted_as_one() -> None:
    run = Run()
    for packet_type in (42, 4242, 0xFFFF_FFFF):
        assert run.hear(packet_type, b"whatever") == []
    assert run.driver.counters.frames == {0: 3}


@pytest.mark.parametrize("frame3d", [True, False])
def test_packets_of_the_other_dimension_are_left_out_but_heard(frame3d: bool) -> None:
    run = Run(frame3d=frame3d, publish_unlocked=True, aggregateNframes=1)
    run.hear(PacketType.POINTS_3D, build.points_3d())
    run.hear(PacketType.POINTS_2D, build.points_2d())
    assert run.driver.counters.ignored_points == 1
    assert [len(sweep.points) for sweep in run.of(Sweep)] == [300 if frame3d else 1800]
    assert run.state is DeviceState.STREAMING


def test_an_empty_sweep_is_counted_and_not_published() -> None:
    run = Run(publish_unlocked=True, aggregateNframes=1)
    assert run.hear(PacketType.POINTS_3D, build.points_3d(ranges=0)) == []
    assert run.driver.counters.empty_sweeps == run.driver.counters.sweeps == 1


def test_gravity_alignment_turns_the_cloud(played: Run, datagrams: list[Datagram]) -> None:
    tilt = Rotation.from_euler("ZYX", [30, 20, -10], degrees=True)
    x, y, z, w = tilt.as_quat()
    tilted = build.capture(
        2.0, imu_fields={"quaternion_wxyz": [0.9983 * part for part in (w, x, y, z)]}
    )
    run = Run(imu_adjust=True, imuRollPitchOnly=False).play(tilted)
    for flat, turned in zip(played.of(Sweep), run.of(Sweep), strict=True):
        before, after = (
            np.stack([sweep.points[axis] for axis in "xyz"], axis=1) for sweep in (flat, turned)
        )
        np.testing.assert_allclose(after, tilt.apply(before), atol=1e-5)
    assert run.driver.counters.unleveled == 0


def test_gravity_alignment_without_imu_publishes_nothing_and_says_so(
    datagrams: list[Datagram],
) -> None:
    run = Run(imu_adjust=True).play(item for item in datagrams if len(item.data) == 1044)
    assert run.of(Sweep) == []
    counters = run.driver.counters
    assert counters.empty_sweeps == counters.sweeps > 5
    assert counters.unleveled > 10_000 * counters.sweeps


def test_live_settings(datagrams: list[Datagram]) -> None:
    run = Run().play(datagrams[:600])
    live = {"aggregateNframes": 10, "EnableCalRangeOVR": True, "calRangeScale": 0.002}
    run.driver.configure(configure(DriverConfig, PLAIN | live))
    assert run.driver.config.sweep.packets == 10
    run.events.clear()
    run.play(datagrams[600:])
    sweeps = run.of(Sweep)
    assert {sweep.packets for sweep in sweeps[1:]} == {10}
    raw = sweeps[-1].points["range"] / 0.002 + 365.625
    np.testing.assert_allclose(raw, np.round(raw), atol=0.01)


# Time that passes without packets


def test_a_stalled_stream_hands_out_what_there_is(datagrams: list[Datagram]) -> None:
    run = Run().play(datagrams)
    complete = len(run.of(Sweep))
    run.wait(0.1)
    assert len(run.of(Sweep)) == complete
    run.wait(0.2)
    assert len(run.of(Sweep)) == complete + 1
    assert run.of(Sweep)[-1].packets < 38
    run.wait(1.0)
    assert len(run.of(Sweep)) == complete + 1


@pytest.mark.parametrize("cut", ["turn", "half_turn"])
@pytest.mark.parametrize("every_ms", [300, 900])
def test_turns_are_whole_where_packets_come_in_bursts(
    datagrams: list[Datagram], cut: str, every_ms: int
) -> None:
    """A busy host or a Wi-Fi holds packets back; none is lost, and no turn is given up."""
    every = every_ms * 1_000_000
    locked = datagrams[0][0] + 1_000_000_000
    held_back = [
        Datagram(HostNs(locked - (locked - at) // every * every if at > locked else at), data)
        for at, data in datagrams
    ]
    smooth = Run(sweep_cut=cut).play(datagrams)
    bursts = Run(sweep_cut=cut).play(held_back)
    assert len(smooth.of(Sweep)) >= 5
    for one, other in zip(bursts.of(Sweep), smooth.of(Sweep), strict=True):
        np.testing.assert_array_equal(one.points["range"], other.points["range"])
    assert bursts.driver.counters.fragments == 1  # of the turn during which the clock locked


def test_flush_hands_out_everything(datagrams: list[Datagram]) -> None:
    run = Run().play(datagrams)
    (sweep,) = (event for event in run.driver.flush() if isinstance(event, Sweep))
    used = sum(item.packets for item in run.of(Sweep)) + sweep.packets
    assert used + run.driver.counters.unlocked[Stream.POINTS] == 431
    assert run.driver.flush() == []


def test_a_packet_waits_for_a_lost_one_so_long_and_no_longer() -> None:
    run = Run(publish_unlocked=True, reorder_window=200)
    run.hear(PacketType.IMU, build.imu(0, 1_000_000))
    run.now += TICK_NS
    run.hear(PacketType.IMU, build.imu(2, 9_000_000))
    assert len(run.of(ImuSample)) == 1
    run.wait(REORDER_NS / 1e9)
    assert len(run.of(ImuSample)) == 1
    run.wait(TICK_NS / 1e9)
    assert len(run.of(ImuSample)) == 2


def test_waiting_is_limited_while_the_stream_goes_on() -> None:
    run = Run(publish_unlocked=True, reorder_window=200)
    run.hear(PacketType.IMU, build.imu(0, 0))
    for seq in range(2, 30):
        run.now += TICK_NS
        run.events += run.driver.tick(HostNs(run.now))
        run.hear(PacketType.IMU, build.imu(seq, seq * TICK_NS))
    assert len(run.of(ImuSample)) == 29
    assert run.driver.counters.sequence[Stream.IMU].lost == 1


def test_silence_is_reported_once_and_again_after_the_device_spoke(
    datagrams: list[Datagram],
) -> None:
    run = Run(watchdog_timeout_ms=1000).play(datagrams[:300])
    run.wait(5.0)
    (silence,) = run.of(Silence)
    assert silence.duration_ns == pytest.approx(1e9, abs=2 * TICK_NS)
    assert run.state is DeviceState.STALLED
    run.hear(PacketType.IMU, build.imu())
    run.wait(1.5)
    assert len(run.of(Silence)) == 2


def test_states_from_power_on() -> None:
    run = Run(publish_unlocked=True)
    assert run.state is DeviceState.WAITING
    run.hear(PacketType.IMU, build.imu(0))
    assert run.state is DeviceState.SPINNING_UP
    assert run.driver.spin_up_left_s(HostNs(run.now)) == 21
    run.hear(PacketType.POINTS_3D, build.points_3d(0))
    assert run.state is DeviceState.STREAMING
    run.driver.stop_rotation(HostNs(run.now))
    run.wait(3)
    assert run.state is DeviceState.STANDBY
    run.driver.start_rotation(HostNs(run.now))
    assert run.state is DeviceState.WAITING


# Interruptions of the stream


def shifted(datagrams: list[Datagram], seconds: float) -> list[Datagram]:
    return [Datagram(item.arrival_ns + round(seconds * 1e9), item.data) for item in datagrams]


def test_a_device_that_restarts_goes_on_without_loss(datagrams: list[Datagram]) -> None:
    run = Run().play(datagrams)
    run.hear(PacketType.VERSION, build.version())
    before = len(run.of(ImuSample))
    run.sent.clear()
    run.play(shifted(build.capture(2.0, uptime_s=4.0), 30.0))
    counts = run.driver.counters.sequence
    assert all(count.lost == count.late == 0 for count in counts.values())
    assert all(count.restarts == 1 for count in counts.values())
    assert len(run.of(ImuSample)) > before + 250
    assert "REBOOT" in [event.kind.name for event in run.of(ClockEvent)]
    assert run.driver.version is None
    assert commands.request_version().encode() in run.sent


def test_stamps_that_count_from_power_on_begin_anew_when_the_device_restarts(
    datagrams: list[Datagram],
) -> None:
    run = Run(enable_l2_time_correction=False).play(datagrams)
    before, sweeps = len(run.of(ImuSample)), len(run.of(Sweep))
    assert run.of(ImuSample)[-1].stamp > build.to_device_ns(101_000_000_000)
    run.play(shifted(build.capture(2.0, uptime_s=4.0), 30.0))
    samples = [sample.stamp for sample in run.of(ImuSample)[before:]]
    starts = [sweep.start for sweep in run.of(Sweep)[sweeps + 1 :]]  # the first one is the rest
    assert len(samples) > 450
    assert len(starts) > 8
    for stamps in (samples, starts):
        assert all(one < other for one, other in pairwise(stamps))
        assert build.to_device_ns(4_000_000_000) <= stamps[0] <= stamps[-1]
        assert stamps[-1] < build.to_device_ns(6_000_000_000)


@pytest.mark.parametrize("outage_s", [1.5, 4.0, 4.5, 9.0])
def test_after_an_outage_no_packet_is_taken_for_late(outage_s: float) -> None:
    """4 and 4.5 s are nearly a turn of the numbers: 1024 IMU or 970 point packets."""
    whole = build.capture(4.0 + outage_s)
    begin, end = (build.EPOCH_NS + round(s * 1e9) for s in (2.0, 2.0 + outage_s))
    run = Run().play(item for item in whole if not begin <= item.arrival_ns < end)
    counts = run.driver.counters.sequence
    assert all(count.late == count.duplicates == 0 for count in counts.values())
    for stream, period in ((Stream.IMU, build.IMU_PERIOD_NS), (Stream.POINTS, build.PERIOD_NS)):
        lost = outage_s * 1e9 / period
        assert counts[stream].lost == pytest.approx(lost % build.MODULUS, abs=2)
    late = [sample for sample in run.of(ImuSample) if sample.stamp > end]
    assert len(late) > 450
    assert all(one.stamp < other.stamp for one, other in pairwise(run.of(ImuSample)))


def test_standby_is_no_loss(datagrams: list[Datagram]) -> None:
    run = Run().play(datagrams)
    run.driver.stop_rotation(HostNs(run.now))
    run.wait(20)
    run.driver.start_rotation(HostNs(run.now))
    seconds = (run.now - build.EPOCH_NS) / 1e9
    run.play(shifted(build.capture(3.0, uptime_s=100.0 + seconds), seconds))
    counts = run.driver.counters.sequence
    assert all(count.lost == count.late == count.duplicates == 0 for count in counts.values())
    assert run.state is DeviceState.STREAMING


# Commands


def ack(run: Run, command: commands.Command, status: int = AckStatus.OK) -> list[Event]:
    number, value = (int.from_bytes(command.payload[at : at + 4], "little") for at in (0, 4))
    return run.hear(PacketType.ACK, build.ack(command.packet_type, number, value, status))


def test_start_is_sent_once_and_answered() -> None:
    run = Run()
    ticket = run.driver.start_rotation(HostNs(run.now))
    assert run.outbox() == [commands.start().encode()]
    assert run.outbox() == []
    (answer,) = ack(run, commands.start())
    assert answer == Answer(ticket, commands.start(), True, "start rotation: acknowledged", 0)
    assert run.driver.counters.stray_acks == 0


def test_a_refusal_is_answered_with_its_reason() -> None:
    run = Run()
    run.driver.start_rotation(HostNs(run.now))
    (answer,) = ack(run, commands.start(), AckStatus.NOT_READY)
    assert (answer.ok, answer.text) == (False, "start rotation: refused: not ready")


def test_without_an_ack_it_is_repeated_and_said_so() -> None:
    run = Run()
    ticket = run.driver.start_rotation(HostNs(run.now))
    run.wait(TRIES * REPEAT_NS / 1e9 + 0.1)
    assert run.sent.count(commands.start().encode()) == TRIES
    (answer,) = run.of(Answer)
    assert (answer.ticket, answer.ok) == (ticket, False)
    assert answer.text == "start rotation: the device did not acknowledge it"


def test_stop_hands_out_what_there_is_and_pauses_the_watchdog(datagrams: list[Datagram]) -> None:
    run = Run(watchdog_timeout_ms=1000).play(datagrams)
    ticket, events = run.driver.stop_rotation(HostNs(run.now))
    (sweep,) = events
    assert 0 < sweep.packets < 38
    assert commands.standby().encode() in run.outbox()
    (answer,) = ack(run, commands.standby())
    assert answer.ticket == ticket
    run.wait(60)
    assert run.of(Silence) == []


def test_a_stop_is_not_undone_by_repeats_of_an_earlier_start() -> None:
    run = Run()
    run.driver.start_rotation(HostNs(run.now))
    run.wait(0.1)
    run.driver.stop_rotation(HostNs(run.now))
    ack(run, commands.standby())
    run.sent.clear()
    run.wait(3)
    assert commands.start().encode() not in run.sent


def test_reset_is_not_answered_and_hands_out_what_there_is(datagrams: list[Datagram]) -> None:
    run = Run().play(datagrams)
    run.hear(PacketType.PARAMETERS, build.parameters())
    (sweep,) = run.driver.reset_device(HostNs(run.now))
    assert isinstance(sweep, Sweep)
    assert commands.reset().encode() in run.outbox()
    assert run.driver.parameters is None
    run.wait(3)
    assert commands.reset().encode() not in run.sent
    assert run.of(Answer) == []


def test_an_ack_of_nothing_is_counted() -> None:
    run = Run()
    assert run.hear(PacketType.ACK, build.ack(106)) == []
    assert run.driver.counters.stray_acks == 1


def test_version_and_parameters_are_asked_for_until_they_come() -> None:
    run = Run().wait(3.5)
    version, parameters = (
        command.encode() for command in (commands.request_version(), commands.request_parameters())
    )
    assert run.sent == [version, parameters] * 4
    (event,) = run.hear(PacketType.VERSION, build.version())
    assert isinstance(event, Version)
    assert run.driver.version == event
    assert run.hear(PacketType.VERSION, build.version()) == []  # an answer to an earlier question
    run.sent.clear()
    run.wait(2)
    assert run.sent == [parameters] * 2
    (event,) = run.hear(PacketType.PARAMETERS, build.parameters(work_mode=16))
    assert isinstance(event, Parameters)
    assert event.work_mode == 16
    run.sent.clear()
    run.wait(2)
    assert run.sent == []


def test_nothing_but_questions_is_sent_without_being_asked(played: Run) -> None:
    kinds = {wire.HEADER.unpack_from(frame)[1] for frame in played.sent}
    assert kinds == {PacketType.COMMAND}


def test_the_devices_clock_is_set_once_if_wanted() -> None:
    run = Run(enable_l2_host_sync=True).wait(0.5)
    syncs = [frame for frame in run.sent if wire.HEADER.unpack_from(frame)[1] == 106]
    assert len(syncs) == 1
    first_tick = build.EPOCH_NS + TICK_NS
    assert syncs == [commands.sync_time(HostNs(first_tick)).encode()]


def test_the_round_trip_is_measured_if_wanted() -> None:
    run = Run(enable_latency_measure=True).wait(1.0)
    requests = [commands.latency(101).encode(), commands.latency(102).encode()]
    assert [frame for frame in run.sent if frame in requests] == requests[:1]
    assert ack(run, commands.latency(101)) == []
    assert list(run.driver.round_trips) == [run.now - build.EPOCH_NS - TICK_NS] or not (
        run.driver.round_trips
    )
    run.wait(0.05)
    assert requests[1] in run.sent
    run.now += 3_000_000
    ack(run, commands.latency(102))
    assert 0 < run.driver.round_trips[-1] < 60_000_000
    assert run.driver.clock_status().path_delay_ns == min(run.driver.round_trips) // 2
    run.wait(5)
    assert run.of(Answer) == []


def test_nothing_is_counted_before_anything_comes() -> None:
    assert not any(dataclasses.asdict(Counters().snapshot()).values())
    assert not any(dataclasses.asdict(SequenceCounts()).values())


def test_counters_can_be_kept() -> None:
    run = Run()
    run.hear(42, b"x")
    kept = run.driver.counters.snapshot()
    run.hear(42, b"x")
    run.hear(PacketType.IMU, build.imu())
    run.hear(PacketType.IMU, build.imu())
    assert kept.frames == {0: 1}
    assert kept.sequence[Stream.IMU].duplicates == 0
    assert run.driver.counters.sequence[Stream.IMU].duplicates == 1
    assert dataclasses.asdict(kept) == dataclasses.asdict(kept.snapshot())


def test_standby_on_power_up_is_not_watched() -> None:
    run = Run(watchdog_timeout_ms=1000, standby_on_powerup_enabled=True).wait(5)
    assert run.of(Silence) == []


def test_user_command_numbers_are_not_confused_between_families() -> None:
    """2000/3 asks for parameters, 100/3 for the version; only the first is pending here."""
    run = Run()
    run.driver.send(commands.request_parameters(), HostNs(run.now))
    assert run.hear(PacketType.ACK, build.ack(100, UserCommand.VERSION, 3)) == []
    (answer,) = run.hear(PacketType.ACK, build.ack(2000, wire.Command.PARAM_GET, 3))
    assert answer.command == commands.request_parameters()


@pytest.mark.parametrize("with_imu", [True, False])
def test_the_next_datagram_that_somebody_waits_for_is_predicted(with_imu: bool) -> None:
    """An IMU sample, if they are published, or the packet that completes a sweep."""
    values = {
        "aggregateNframes": 5, "enable_IMU_publishing": with_imu, "receive_interval_ms": 0
    }  # fmt: skip
    driver = Driver(configure(DriverConfig, PLAIN | values))
    wanted: list[int] = []
    predicted: list[tuple[int, int]] = []
    for arrival, data in build.capture(2.0):
        events = driver.receive(data, HostNs(arrival))
        if any(isinstance(event, Sweep) or (with_imu and isinstance(event, ImuSample))
               for event in events):  # fmt: skip
            wanted.append(arrival)
            predicted.append((arrival, driver.awaited()))
    assert len(wanted) > (100 if with_imu else 10)
    for now, later in predicted[:-1]:
        following = wanted[wanted.index(now) + 1]
        assert abs(later - following) < 1_500_000
