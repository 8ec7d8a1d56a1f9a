"""Both streams on their way from arrival to use."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, strategies as st

from l2lidar_node.driver.reorder import REORDER_NS, Released, ReorderBuffer
from l2lidar_node.protocol.framing import Frame
from l2lidar_node.protocol.packets import ImuPacket, PointPacket, decode
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.types import DeviceNs, HostNs, Stream
from tests.support import build

MS = 1_000_000
S = 1_000_000_000
PERIOD = 4 * MS
IMU = Stream.IMU


class Arriving:
    """An intake that IMU packets arrive at, 4 ms apart, the device's clock running with them."""

    def __init__(self, uptime_s: float = 10.0) -> None:
        self.reorder_buffer = ReorderBuffer(8)
        self.clock_ns = round(uptime_s * S)  # what the device's clock shows for number 0
        self.now = build.EPOCH_NS
        self.restarts = 0

    def packet(self, seq: int, clock_ns: int | None = None) -> ImuPacket:
        stamp = (self.clock_ns if clock_ns is None else clock_ns) + seq * PERIOD // 2
        packet = decode(Frame(PacketType.IMU, build.imu(seq % 1025, stamp)))
        assert isinstance(packet, ImuPacket)
        return packet

    def take(self, packet: ImuPacket, by_the_long_way: bool = False) -> list[int]:
        """Return the numbers a packet releases."""
        self.now += PERIOD
        if not by_the_long_way and self.reorder_buffer.follows(IMU, packet, HostNs(self.now)):
            return [packet.seq]
        released: Released = []
        if self.reorder_buffer.begins_anew(IMU, packet, HostNs(self.now)):
            self.restarts += 1
            released += self.reorder_buffer.restart(IMU)
        released += self.reorder_buffer.push(IMU, packet, HostNs(self.now))
        return [timed.packet.seq for _, timed in released]

    def run(self, *numbers: int) -> list[int]:
        return [seq for number in numbers for seq in self.take(self.packet(number))]

    @property
    def counts(self) -> Any:
        return self.reorder_buffer.counts[IMU]


def points(seq: int) -> PointPacket:
    packet = decode(Frame(PacketType.POINTS_3D, build.points_3d(seq, 1)))
    assert isinstance(packet, PointPacket)
    return packet


def test_packets_keep_their_own_arrival() -> None:
    arriving = Arriving()
    arriving.run(0)
    waited = arriving.now + PERIOD
    assert arriving.run(2) == []
    released = arriving.reorder_buffer.push(IMU, arriving.packet(1), HostNs(arriving.now + PERIOD))
    assert [(missing, timed.packet.seq) for missing, timed in released] == [(0, 1), (0, 2)]
    assert [timed.arrival for _, timed in released] == [waited + PERIOD, waited]


def test_streams_do_not_disturb_each_other() -> None:
    arriving = Arriving()
    assert arriving.run(7) == [7]
    other = points(500)
    assert not arriving.reorder_buffer.begins_anew(Stream.POINTS, other, HostNs(arriving.now))
    assert len(arriving.reorder_buffer.push(Stream.POINTS, other, HostNs(arriving.now))) == 1
    assert arriving.run(8) == [8]


def test_what_waits_is_overdue_after_so_long() -> None:
    arriving = Arriving()
    arriving.run(0, 2, 4)
    first, second = (HostNs(arriving.now - PERIOD + REORDER_NS + after) for after in (0, PERIOD))
    assert not arriving.reorder_buffer.is_overdue(first)
    assert arriving.reorder_buffer.settle(first) == []
    assert arriving.reorder_buffer.is_overdue(HostNs(first + 1))
    (released,) = arriving.reorder_buffer.settle(HostNs(first + 1))
    assert released[1].packet.seq == 2
    assert arriving.reorder_buffer.settle(second) == []
    assert len(arriving.reorder_buffer.settle(HostNs(second + 1))) == 1
    assert not arriving.reorder_buffer.is_overdue(HostNs(second + S))


def test_a_pause_is_one_of_the_points() -> None:
    arriving = Arriving()
    arriving.run(0)
    assert arriving.reorder_buffer.pause_ns(HostNs(arriving.now + 5)) == 0
    arriving.reorder_buffer.push(Stream.POINTS, points(500), HostNs(arriving.now + 2))
    arriving.run(1)
    assert arriving.reorder_buffer.pause_ns(HostNs(arriving.now + 5)) == 3 + PERIOD


def test_nothing_can_be_overdue_while_it_flows() -> None:
    arriving = Arriving()
    reorder_buffer = arriving.reorder_buffer
    assert not reorder_buffer.is_flowing(HostNs(arriving.now))
    reorder_buffer.push(Stream.POINTS, points(500), HostNs(arriving.now))
    arriving.run(0, 1)
    assert reorder_buffer.is_flowing(HostNs(arriving.now))
    assert not reorder_buffer.is_flowing(HostNs(arriving.now + REORDER_NS))
    arriving.run(3)
    assert not reorder_buffer.is_flowing(HostNs(arriving.now))
    arriving.run(2)
    assert reorder_buffer.is_flowing(HostNs(arriving.now))


@given(
    st.lists(
        st.tuples(
            st.sampled_from([1] * 12 + [0, 0, 2, 3, -1, -2, -40, 5, 1000]),
            st.sampled_from([1] * 8 + [0, 2, -3, 600, -600]),
            st.sampled_from([PERIOD] * 9 + [0, -PERIOD, 2 * REORDER_NS, 2 * S]),
        ),
        max_size=60,
    )
)
def test_the_short_way_is_the_long_way(steps: Any) -> None:
    """What follows the packet before it is handled as if it had gone through everything."""
    short, long = Arriving(), Arriving()
    seq, stamp = 1000, 10 * S
    for ahead, passed, gap in steps:
        seq, stamp = max(seq + ahead, 0), max(stamp + passed * PERIOD, 0)
        packet = short.packet(0)._replace(seq=seq % 1025, stamp=DeviceNs(stamp))
        for arriving in (short, long):
            arriving.now += gap - PERIOD
        assert short.take(packet) == long.take(packet, by_the_long_way=True)
    assert short.counts == long.counts
    assert short.restarts == long.restarts


@pytest.mark.parametrize("last", [5, 500, 1024])
def test_a_reboot_is_told_by_falling_stamps(last: int) -> None:
    arriving = Arriving(uptime_s=100.0)
    arriving.run(*range(last + 1))
    arriving.clock_ns = 4 * S
    assert arriving.run(*range(200))[-150:] == list(range(50, 200))
    assert arriving.restarts == 1
    assert arriving.counts.restarts == 1
    assert arriving.counts.lost == 0


def test_a_reboot_is_told_though_the_clock_was_set_soon_after_it() -> None:
    """The other stream may have shown the reboot already, and the host has set the clock."""
    arriving = Arriving(uptime_s=100.0)
    arriving.run(*range(60))
    arriving.clock_ns = 200 * S
    assert arriving.run(*range(20)) == list(range(20))
    assert arriving.restarts == 1


def test_a_reboot_costs_nothing_unless_its_numbers_look_late() -> None:
    arriving = Arriving(uptime_s=100.0)
    arriving.run(*range(500))
    arriving.clock_ns = 4 * S
    assert arriving.run(0, 1, 2) == [0, 1, 2]


def test_a_reboot_after_a_pause_costs_nothing_though_its_numbers_look_late() -> None:
    arriving = Arriving(uptime_s=100.0)
    arriving.run(*range(43))
    arriving.clock_ns = 4 * S
    arriving.now += 2 * REORDER_NS
    assert arriving.run(*range(12)) == list(range(12))
    assert arriving.restarts == 1


@pytest.mark.parametrize("late", [[9], [8, 9], [9, 8], [5, 6, 7, 8, 9]])
def test_late_packets_from_before_a_sync_are_no_reboot(late: Any) -> None:
    """The device's clock is set forward by decades; some packets from before are still to come."""
    arriving = Arriving(uptime_s=10.0)
    out = arriving.run(*(n for n in range(10) if n not in late))
    before, arriving.clock_ns = arriving.clock_ns, build.EPOCH_NS
    out += arriving.run(10)
    for number in late:
        out += arriving.take(arriving.packet(number, before))
    out += arriving.run(*range(11, 40))
    assert out == list(range(40))
    assert arriving.restarts == arriving.counts.lost == 0


def test_a_clock_set_back_in_mid_stream_loses_nothing() -> None:
    arriving = Arriving(uptime_s=100.0)
    out = arriving.run(*range(10))
    arriving.clock_ns = 50 * S
    out += arriving.run(*range(10, 30))
    assert out == list(range(30))
    assert arriving.counts.lost == 0


def test_after_a_silence_numbers_go_on_where_they_are() -> None:
    arriving = Arriving()
    arriving.run(*range(100))
    arriving.now += 4 * S
    assert arriving.run(*range(1100, 1110)) == [n % 1025 for n in range(1100, 1110)]
    assert arriving.counts.lost == 1000
    assert arriving.counts.late == arriving.counts.duplicates == 0


@pytest.mark.parametrize("far", [200, 900, 1030, 100_000, 2_000_000, 4_000_000_000])
def test_a_far_number_adds_no_more_to_the_lost_than_time_allows(far: int) -> None:
    """One valid packet in a stream of which nothing is lost."""
    arriving = Arriving()
    out = arriving.run(*range(500))
    stray = arriving.packet(500)._replace(seq=far)
    out += arriving.take(stray)
    for number in range(500, 2000):
        released = arriving.reorder_buffer.settle(HostNs(arriving.now))
        out += [timed.packet.seq for _, timed in released]
        out += arriving.run(number)
    assert sorted(n for n in out if n != far) == sorted(
        n % 1025 for n in range(2000) if n % 1025 != far
    )
    assert arriving.counts.lost <= 100


@pytest.mark.parametrize("age", [300, 375, 700, 1020, 1100, 4000])
def test_a_stale_packet_is_dropped_and_counted(age: int) -> None:
    """One from ``age`` packets ago between the current ones, and after it a whole burst."""
    arriving = Arriving(uptime_s=1000.0)
    out = arriving.run(*range(5000, 5100))
    for number in range(5100, 5300, 10):
        out += arriving.run(number - age, *range(number, number + 10))
    for number in range(5280 - age, 5300 - age):
        arriving.now += 1 - PERIOD  # at once
        out += arriving.run(number)
    out += arriving.run(*range(5300, 5400))
    assert out == [n % 1025 for n in range(5000, 5400)]
    assert arriving.restarts == arriving.counts.lost == arriving.counts.late == 0
    counts = arriving.counts
    assert counts.stale + counts.duplicates == 40


def test_a_reboot_in_bursts_loses_nothing() -> None:
    """As behind an adapter that hands over what came in 100 ms."""
    arriving = Arriving(uptime_s=1000.0)
    arriving.run(*range(500))
    arriving.clock_ns = 4 * S
    out = []
    for first in range(0, 75, 25):
        arriving.now += 25 * PERIOD - 25
        for number in range(first, first + 25):
            arriving.now += 1 - PERIOD
            out += arriving.run(number)
    assert out == list(range(75))
    assert arriving.restarts == 1
    assert arriving.counts.stale == arriving.counts.lost == 0


def test_what_is_forgotten_is_not_missed() -> None:
    arriving = Arriving()
    arriving.run(*range(100))
    arriving.reorder_buffer.forget()
    assert arriving.run(600, 601) == [600, 601]
    assert arriving.counts.lost == 0


def test_flush_releases_what_waits() -> None:
    arriving = Arriving()
    arriving.run(0, 2, 5)
    assert [timed.packet.seq for _, timed in arriving.reorder_buffer.flush()] == [2, 5]
    assert arriving.reorder_buffer.flush() == []
