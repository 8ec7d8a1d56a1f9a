"""Packets into sweeps: where they are cut, and what a sweep says of itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from l2lidar_node.config import SweepConfig
from l2lidar_node.driver.sweep import MAX_GAP_NS, MAX_PACKETS, SweepAssembler
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.framing import Frame
from l2lidar_node.protocol.packets import PointPacket, decode
from l2lidar_node.types import POINT, HostNs, Sweep
from tests.support import build

START = build.EPOCH_NS
PERIOD = build.PERIOD_NS
TURN = 2 * math.pi


def packet(kind: int = wire.PacketType.POINTS_3D, **fields: Any) -> PointPacket:
    maker = build.points_3d if kind == wire.PacketType.POINTS_3D else build.points_2d
    decoded = decode(Frame(kind, maker(**fields)))
    assert isinstance(decoded, PointPacket)
    return decoded


PLAIN = packet()
DURATION = PLAIN.duration_ns


class Stream:
    """Pushes packets at their pace and collects the sweeps."""

    def __init__(self, **config: Any) -> None:
        self.assembler = SweepAssembler(SweepConfig(**config))
        self.sweeps: list[Sweep] = []
        self.now = START

    def push(self, item: PointPacket = PLAIN, gap_ns: int = PERIOD, missing: int = 0) -> int:
        """Return how many sweeps this completed."""
        done = self.assembler.push(item, HostNs(self.now), missing)
        self.now += gap_ns
        self.sweeps += done
        return len(done)

    def turn(self, packets: int, per_turn: float, begin: float = 0.0, wobble: float = 0.0) -> None:
        for number in range(packets):
            angle = begin + TURN * number / per_turn
            angle += wobble * math.sin(angle)
            self.push(PLAIN._replace(head_angle=angle % TURN))


@pytest.mark.parametrize("count", [1, 2, 38, 100])
def test_a_number_of_packets(count: int) -> None:
    stream = Stream(packets=count)
    completed = [stream.push() for _ in range(3 * count)]
    assert completed == ([0] * (count - 1) + [1]) * 3
    assert [sweep.packets for sweep in stream.sweeps] == [count] * 3
    assert [len(sweep.points) for sweep in stream.sweeps] == [300 * count] * 3
    assert [sweep.start for sweep in stream.sweeps] == [
        START + n * count * PERIOD for n in range(3)
    ]


def test_zero_packets_means_every_packet() -> None:
    stream = Stream(packets=0)
    assert [stream.push() for _ in range(5)] == [1] * 5


def test_the_largest_number_of_packets() -> None:
    stream = Stream(packets=4000)
    small = packet(count=1)
    assert [stream.push(small) for _ in range(4000)] == [0] * 3999 + [1]
    assert stream.sweeps[0].packets == 4000


@pytest.mark.parametrize("per_turn", [38.9, 49.53])
@pytest.mark.parametrize("wobble", [0.0, math.radians(0.2)])
@pytest.mark.parametrize("begin", [0.0, 1.0, 3.2, 6.2])
def test_a_turn_of_the_head(per_turn: float, wobble: Any, begin: float) -> None:
    stream = Stream(cut="turn")
    stream.turn(round(10.5 * per_turn), per_turn, begin, wobble)
    counts = [sweep.packets for sweep in stream.sweeps]
    assert len(counts) >= 9
    assert set(counts) <= {math.floor(per_turn), math.ceil(per_turn)}


@pytest.mark.parametrize("per_turn", [38.9, 49.53])
@pytest.mark.parametrize("begin", [0.0, 1.0, 3.2, 6.2])
def test_half_a_turn_of_the_head(per_turn: float, begin: float) -> None:
    stream = Stream(cut="half_turn")
    stream.turn(round(10.5 * per_turn), per_turn, begin, math.radians(0.2))
    counts = [sweep.packets for sweep in stream.sweeps]
    assert len(counts) >= 18
    assert set(counts) <= {math.floor(per_turn / 2), math.ceil(per_turn / 2)}


def test_sweeps_of_a_turn_begin_within_a_packet_of_the_same_angle() -> None:
    stream = Stream(cut="turn")
    for number in range(300):
        stream.push(packet(theta=TURN * number / 49.53 % TURN))
    heads = [math.atan2(sweep.points["y"][0], sweep.points["x"][0]) for sweep in stream.sweeps]
    assert len(heads) == 5
    assert 0 < np.ptp(np.unwrap(heads)) < TURN / 49.53


@pytest.mark.parametrize("cut", ["turn", "half_turn"])
@pytest.mark.parametrize("begin", np.linspace(0, TURN, 23))
@pytest.mark.parametrize("lost", [10, 20, 28, 35, 40])
def test_a_turn_is_neither_missed_nor_invented_when_packets_are_lost(
    cut: str, begin: Any, lost: int
) -> None:
    """40 packets are 293 degrees; 42 would be longer than the longest gap."""
    stream = Stream(cut=cut)
    stream.push(PLAIN._replace(head_angle=begin % TURN), gap_ns=(lost + 1) * PERIOD)
    end = begin % TURN + TURN * (lost + 1) / 49.53
    period = TURN if cut == "turn" else math.pi
    passed = end // period > (begin % TURN) // period
    stream.push(PLAIN._replace(head_angle=end % TURN))
    assert stream.assembler.fragments == passed  # of a turn that began before the first packet
    assert stream.sweeps == []


@pytest.mark.parametrize("cut", ["turn", "half_turn"])
def test_a_head_that_stands_still_makes_no_turns(cut: str) -> None:
    stream = Stream(cut=cut)
    for number in range(500):
        stream.push(PLAIN._replace(head_angle=1.0 + 0.001 * (-1) ** number))
    assert stream.sweeps == []


def test_a_turn_that_ends_exactly_at_zero() -> None:
    stream = Stream(cut="turn")
    for number in range(200):
        stream.push(PLAIN._replace(head_angle=TURN * (number % 50) / 50))
    assert [sweep.packets for sweep in stream.sweeps] == [50, 50]


@pytest.mark.parametrize("duration_ms", [5, 100, 230])
def test_a_duration(duration_ms: int) -> None:
    stream = Stream(cut="duration", duration_ms=duration_ms)
    for _ in range(400):
        stream.push()
    lengths = {sweep.packets for sweep in stream.sweeps}
    assert lengths == {math.ceil(duration_ms * 1e6 / PERIOD)}


@pytest.mark.parametrize("cut", ["turn", "half_turn"])
def test_2d_packets_know_no_angle_and_are_cut_by_duration(cut: str) -> None:
    stream = Stream(cut=cut, duration_ms=100)
    flat = packet(wire.PacketType.POINTS_2D)
    for _ in range(21):
        stream.push(flat, gap_ns=20_000_000)
    assert [sweep.packets for sweep in stream.sweeps] == [5] * 4


def test_a_head_that_reports_no_angle_cannot_grow_a_sweep_for_ever() -> None:
    stream = Stream(cut="turn")
    small = packet(count=1)
    for _ in range(MAX_PACKETS + 5):
        stream.push(small)
    assert stream.sweeps == []
    assert (stream.assembler.fragments, stream.assembler.fragment_packets) == (1, MAX_PACKETS)


@pytest.mark.parametrize("cut", ["turn", "half_turn"])
@pytest.mark.parametrize("begin", [0.0, 0.05, 1.0, 3.0, 6.2])
def test_every_turn_is_whole_however_the_stream_begins_pauses_and_ends(
    cut: str, begin: float
) -> None:
    """LIO-SAM crashed on a first cloud of 1,158 points of 14,500."""
    stream = Stream(cut=cut)
    stream.turn(120, 49.53, begin)
    before = len(stream.sweeps)
    stream.now += MAX_GAP_NS
    stream.turn(120, 49.53, 2.0)
    assert stream.assembler.flush() is None
    per_sweep = 49.53 if cut == "turn" else 49.53 / 2
    assert before >= 1
    assert len(stream.sweeps) > before
    for sweep in stream.sweeps:
        assert abs(sweep.packets - per_sweep) <= 1
    left_out = stream.assembler.fragment_packets
    assert sum(sweep.packets for sweep in stream.sweeps) + left_out == 240
    assert stream.assembler.fragments == 4  # before and after each stretch


def test_a_half_turn_is_not_taken_for_a_turn_when_the_cut_changes() -> None:
    stream = Stream(cut="half_turn")
    stream.turn(80, 49.53, 0.3)  # ends 14 packets before the third half turn does
    assert len(stream.sweeps) == 2
    stream.assembler.configure(SweepConfig(cut="turn"), None)
    stream.turn(100, 49.53, 0.3 + TURN * 80 / 49.53)
    assert [abs(sweep.packets - 49.53) < 1 for sweep in stream.sweeps[2:]] == [True]
    stream.assembler.configure(SweepConfig(packets=5), None)
    assert stream.push() == 1  # as many packets as wanted have come


@pytest.mark.parametrize("cut", ["packets", "duration"])
def test_a_stall_ends_the_sweep(cut: str) -> None:
    stream = Stream(cut=cut, duration_ms=20_000)
    stream.push()
    stream.push(gap_ns=MAX_GAP_NS + 1)
    assert stream.push() == 1
    assert stream.sweeps[0].packets == 2
    assert stream.sweeps[0].end == START + PERIOD + DURATION


def test_a_clock_that_steps_back_ends_the_sweep() -> None:
    stream = Stream()
    stream.push(gap_ns=-1_000_000)
    assert stream.push() == 1
    assert stream.assembler.flush().start == START - 1_000_000


def test_another_type_ends_the_sweep() -> None:
    stream = Stream()
    stream.push()
    assert stream.push(packet(wire.PacketType.POINTS_2D)) == 1
    assert len(stream.sweeps[0].points) == 300
    assert len(stream.assembler.flush().points) == 1800


@pytest.mark.parametrize("cut", ["packets", "turn", "half_turn", "duration"])
def test_the_packets_left_are_told_never_too_many_and_hardly_too_few(cut: Any) -> None:
    """Somebody waits for the packet that completes a sweep; told are nine tenths of them."""
    stream = Stream(cut=cut)
    told, completing = [], []
    for number in range(200):
        angle = TURN * number / 49.5
        before = stream.assembler.fragments  # the first turn is not whole
        done = stream.push(PLAIN._replace(head_angle=(angle + 0.03 * math.sin(angle)) % TURN))
        if done or stream.assembler.fragments > before:
            completing.append(number)
        told.append(stream.assembler.packets_left)
    for number in range(2, completing[-1]):
        left = next(later for later in completing if later > number) - number
        assert 0.8 * left - 1 <= told[number] <= left or told[number] == 1


def test_two_sweeps_at_once() -> None:
    stream = Stream(packets=2)
    stream.push()
    stream.assembler.configure(SweepConfig(packets=1), None)
    assert stream.push(packet(wire.PacketType.POINTS_2D)) == 2


def test_flush_returns_what_there_is_once() -> None:
    stream = Stream()
    assert stream.assembler.flush() is None
    stream.push()
    sweep = stream.assembler.flush()
    assert sweep is not None
    assert sweep.packets == 1
    assert stream.assembler.flush() is None


def test_settings_changed_in_mid_sweep_take_effect_with_the_next_packet() -> None:
    stream = Stream(packets=38)
    for _ in range(20):
        stream.push()
    override = SweepConfig(packets=10, override_range_calibration=True, range_scale=0.002)
    stream.assembler.configure(override, None)
    assert stream.push() == 1
    assert stream.sweeps[0].packets == 21
    assert stream.sweeps[0].points["range"][0] == pytest.approx(0.002 * (3000 - 365.625))
    for _ in range(10):
        stream.push()
    assert stream.sweeps[1].packets == 10


def test_the_override_uses_the_users_scale_and_bias() -> None:
    config: dict[str, Any] = {
        "override_range_calibration": True,
        "range_scale": 0.001,
        "range_bias": -500.0,
    }
    stream = Stream(packets=1, **config)
    stream.push()
    assert stream.sweeps[0].points["range"][0] == pytest.approx(2.5)
    stream.assembler.configure(SweepConfig(**config | {"override_range_calibration": False}), None)
    assert stream.assembler._config.range_bias == -500.0


def test_the_users_range_limits() -> None:
    ranges = np.where(np.arange(300) % 2, 3000, 6000)
    for lo, hi, expected in ((0.0, 4.0, 150), (4.0, 100.0, 150), (0.0, 100.0, 300)):
        stream = Stream(packets=1, range_min=lo, range_max=hi)
        stream.push(packet(ranges=ranges))
        assert len(stream.sweeps[0].points) == expected


def test_the_start_is_the_first_kept_point() -> None:
    stream = Stream(packets=2)
    stream.push(packet(ranges=0))
    stream.push(packet(ranges=[0] * 7 + [3000] * 293))
    (sweep,) = stream.sweeps
    assert abs(sweep.start - (START + PERIOD + round(7 * build.SLOT_NS))) <= 1
    assert sweep.end == START + PERIOD + DURATION
    assert sweep.points["time"][0] == 0
    assert sweep.points["time"].dtype == np.float32
    assert sweep.packets == 2


def test_times_ascend_and_end_with_the_sweep() -> None:
    stream = Stream(packets=50)
    for number in range(50):
        stream.push(gap_ns=PERIOD + (number % 7) * 1000)
    (sweep,) = stream.sweeps
    times = sweep.points["time"].astype(np.float64)
    assert (np.diff(times) > 0).all()
    assert times[-1] * 1e9 == pytest.approx(sweep.end - sweep.start, abs=20)


def test_a_packet_that_seems_to_begin_before_the_last_one_ended_is_put_behind_it() -> None:
    stream = Stream(packets=3)
    stream.push(gap_ns=DURATION // 2)
    stream.push(gap_ns=PERIOD)
    stream.push()
    times = stream.sweeps[0].points["time"]
    assert (np.diff(times) >= 0).all()
    assert times[300] == pytest.approx(DURATION / 1e9)


def test_a_burst_of_arrivals_is_one_sweep() -> None:
    """With stamps of arrival a backlog comes microseconds apart; that is no clock step."""
    stream = Stream(packets=38)
    for _ in range(38):
        stream.push(gap_ns=10_000)
    (sweep,) = stream.sweeps
    assert sweep.packets == 38
    assert (np.diff(sweep.points["time"]) >= 0).all()
    assert sweep.end == START + 38 * DURATION


def test_missing_packets_are_counted_within_the_sweep() -> None:
    stream = Stream(packets=4)
    for missing in (9, 0, 2, 1, 5, 0, 0, 3):
        stream.push(missing=missing)
    assert [sweep.missing for sweep in stream.sweeps] == [3, 3]


def test_points_cannot_be_written_and_are_not_used_again() -> None:
    stream = Stream(packets=2)
    for _ in range(4):
        stream.push()
        stream.push(packet(ranges=4000))
    first, second = stream.sweeps[:2]
    assert not first.points.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        first.points["x"] = 0
    assert not np.shares_memory(first.points, second.points)
    np.testing.assert_array_equal(first.points["x"], second.points["x"])


def test_a_sweep_without_points_is_a_sweep() -> None:
    stream = Stream(packets=2)
    stream.push(packet(ranges=0))
    stream.push(packet(ranges=0))
    (sweep,) = stream.sweeps
    assert len(sweep.points) == 0
    assert sweep.points.dtype == POINT
    assert sweep.start == START


def test_gravity_alignment_sees_every_packets_start_and_turns_its_points() -> None:
    seen: list[list[int]] = []

    def level(starts: list[HostNs]) -> np.ndarray:
        seen.append(list(starts))
        upside_down = np.diag([1.0, -1.0, -1.0])
        return np.array([np.eye(3), upside_down, np.full((3, 3), np.nan)])

    assembler = SweepAssembler(SweepConfig(packets=3), level)
    sweeps: list[Sweep] = []
    for number in range(3):
        sweeps += assembler.push(PLAIN, HostNs(START + number * PERIOD))
    points = sweeps[0].points
    assert seen == [[START, START + PERIOD, START + 2 * PERIOD]]
    assert len(points) == 600
    assert assembler.unleveled == 300
    for name, sign in (("x", 1), ("y", -1), ("z", -1)):
        np.testing.assert_array_equal(points[name][300:], sign * points[name][:300])


@given(
    st.sampled_from(["packets", "turn", "half_turn", "duration"]),
    st.lists(
        st.tuples(
            st.sampled_from([PERIOD, PERIOD, 0, -5_000_000, 10**9]),
            st.floats(-100, 100),
            st.integers(0, 300),
            st.booleans(),
        ),
        max_size=25,
    ),
)
def test_whatever_comes_no_packet_is_lost_or_doubled_and_times_ascend(
    cut: Any, steps: Any
) -> None:
    stream = Stream(cut=cut, packets=7)
    for gap, angle, count, is_3d in steps:
        kind = wire.PacketType.POINTS_3D if is_3d else wire.PacketType.POINTS_2D
        item = packet(kind, count=count)._replace(head_angle=angle)
        stream.push(item, gap_ns=gap)
    last = stream.assembler.flush()
    sweeps = [*stream.sweeps, *([last] if last else [])]
    left_out = stream.assembler.fragment_packets
    assert sum(sweep.packets for sweep in sweeps) + left_out == len(steps)
    if not left_out:
        assert sum(len(sweep.points) for sweep in sweeps) == sum(step[2] for step in steps)
    for sweep in sweeps:
        assert (np.diff(sweep.points["time"]) >= 0).all()
        assert sweep.end >= sweep.start or not len(sweep.points)
