"""The clock's parts by themselves."""

import itertools

import pytest
from hypothesis import given, strategies as st

from l2lidar_node.clock.cadence import Cadence
from l2lidar_node.clock.device_clock import SyncSchedule
from l2lidar_node.clock.host_clock_model import HostClockModel, HostSlewing
from l2lidar_node.clock.lower_envelope import supporting_line
from l2lidar_node.config import ClockConfig
from l2lidar_node.types import HostNs

MS = 1_000_000
PACKETS = st.lists(
    st.tuples(st.integers(0, 10**6), st.integers(-(10**6), 10**6)),
    min_size=2,
    max_size=12,
    unique_by=lambda packet: packet[0],
)


@given(PACKETS)
def test_the_supporting_line_is_the_best_one_below_all_packets(
    packets: list[tuple[int, int]],
) -> None:
    packets = sorted(packets)

    line = supporting_line(packets, 1.0)

    assert line is not None
    heights = [host - line.at(u) for u, host in packets]
    assert min(heights) >= -2  # rounded to nanoseconds
    best = min(
        sum(_heights(packets, pair))
        for pair in itertools.combinations(packets, 2)
        if min(_heights(packets, pair)) >= -1e-3
    )
    assert sum(heights) <= best + 2 * len(packets)


def _heights(
    packets: list[tuple[int, int]], pair: tuple[tuple[int, int], tuple[int, int]]
) -> list[float]:
    (u0, h0), (u1, h1) = pair
    return [host - h0 - (h1 - h0) / (u1 - u0) * (u - u0) for u, host in packets]


def test_the_supporting_line_is_exact_far_from_zero() -> None:
    begin = 1_760_000_000_123_456_789
    packets = [(begin + 7 * n, begin + 14 * n + (0 if n % 5 else 3)) for n in range(1000)]

    line = supporting_line(packets, 2.0)

    assert line is not None
    assert line.ratio == 2.0
    assert line.at(begin + 7_000_000) == begin + 14_000_000


def test_packets_of_one_instant_have_no_line() -> None:
    assert supporting_line([(5, 1), (5, 2), (5, 3)], 2.0) is None


def _learned(period: int, first: int = 0) -> Cadence:
    cadence = Cadence(0.1)
    known = [cadence.learn(first + n, n * period) for n in range(9)]
    assert known == [False] * 8 + [True]
    return cadence


@pytest.mark.parametrize(("off", "follows"), [(1_900, True), (2_100, False), (-2_100, False)])
def test_a_packet_2_us_off_an_even_cadence_is_a_step(off: int, follows: bool) -> None:
    assert _learned(2 * MS).follows(9, 2 * MS + off) == follows


def test_a_cadence_predicts_over_missing_packets() -> None:
    cadence = _learned(2 * MS)

    assert cadence.follows(11, 3 * 2 * MS)
    assert not cadence.follows(12, 2 * MS + 30_000)
    assert cadence.gap(20, 0) == 9
    assert cadence.advance(9) == 18 * MS


@pytest.mark.parametrize("modulus", [16, 1000, 1024, 1025, 65536])
def test_a_cadence_learns_where_numbers_wrap(modulus: int) -> None:
    cadence = _learned(2 * MS, first=modulus - 10)

    assert cadence.follows(modulus - 1, 2 * MS)
    if not cadence.follows(0, 2 * MS):
        assert cadence.gap(0, 2 * MS) == 1
        cadence.resume(0, 2 * MS)
    for number in itertools.chain(range(1, modulus), range(3)):
        assert cadence.follows(number, 2 * MS)


def test_one_step_does_not_spoil_what_is_learned() -> None:
    cadence = Cadence(0.1)
    for n in range(9):
        cadence.learn(n, n * 2 * MS + (25 * MS if n > 4 else 0))

    assert cadence.advance(1) == 2 * MS


@pytest.mark.parametrize("correction", [True, False])
def test_no_sync_is_due_when_none_is_wanted(correction: bool) -> None:
    config = ClockConfig(enable_l2_host_sync=False, enable_l2_time_correction=correction)
    schedule = SyncSchedule(config)

    assert not schedule.due(HostNs(10**18))
    assert schedule.in_force


def test_a_single_sync_is_repeated_until_it_is_in_force() -> None:
    schedule = SyncSchedule(ClockConfig(l2_sync_mode="once"))
    now = HostNs(10**18)

    assert schedule.due(now)
    assert not schedule.due(HostNs((1 << 32) * 1000 * MS))  # 2106, more than the device can show
    schedule.sent(now, now)
    assert not schedule.due(HostNs(now + 900 * MS))
    schedule.seen(stamp=60_000 * MS, arrival=now + 100 * MS)
    assert schedule.due(HostNs(now + 1000 * MS))
    schedule.sent(HostNs(now + 1000 * MS), HostNs(now + 1000 * MS))
    schedule.seen(stamp=now + 1010 * MS, arrival=now + 1020 * MS)
    assert schedule.in_force
    assert not schedule.due(HostNs(now + 10**12))

    schedule.reset()
    assert schedule.due(HostNs(now + 10**12))


def test_periodic_syncs_come_at_their_rate_even_if_the_host_clock_is_set_back() -> None:
    schedule = SyncSchedule(ClockConfig(l2_sync_mode="periodic", l2_sync_rate_ms=50))
    now = HostNs(10**18)
    schedule.sent(now, now)

    assert not schedule.due(HostNs(now + 49 * MS))
    assert schedule.due(HostNs(now + 50 * MS))
    assert schedule.due(HostNs(now - 1))


@pytest.mark.parametrize(("off", "follows"), [(1_900, True), (2_600, False)])
def test_the_least_deviation_that_is_no_longer_regular(off: int, follows: bool) -> None:
    """A clock of this resolution: steps of 5 us, as at ratios near 1, must not pass as noise."""
    assert _learned(2 * MS).follows(9, 2 * MS + off) is follows


def test_packets_from_before_a_told_step_do_not_count_in_the_new_time() -> None:
    model = HostClockModel(2.0)
    model.stepped(0, 0)
    begin = 10**18
    for number in range(500):
        model.add(number * 2 * MS, begin + number * 4 * MS)
        model.update(number * 2 * MS)
    assert model.ready
    stepped_at = begin + 500 * 4 * MS + 10**9
    model.stepped(10**9, stepped_at)
    before = model.at(500 * 2 * MS)
    for number in range(500, 740):  # they waited in the socket, with the arrivals of then
        model.add(number * 2 * MS, begin + number * 4 * MS)
        model.update(number * 2 * MS)
    assert model.at(500 * 2 * MS) == before
    assert not model.steps
    assert model.at(740 * 2 * MS) == pytest.approx(begin + 740 * 4 * MS + 10**9, abs=1000)


@pytest.mark.parametrize("step", [10**9, 20 * MS, -20 * MS])
def test_an_early_block_of_before_a_told_step_does_not_count_after_it(step: int) -> None:
    """From packet 500 on packets come 50 ms earlier; the step is told between the first two."""
    model = HostClockModel(2.0)
    model.stepped(0, 0)
    begin = 10**18
    for number in range(900):
        is_stepped, is_early = number > 500, number >= 500
        if number == 501:
            assert not model.steps
            model.stepped(step, begin + number * 4 * MS + step)
        arrival = begin + number * 4 * MS + is_stepped * step - is_early * 50 * MS
        model.add(number * 2 * MS, arrival)
        if number * 2 * MS >= model.due:
            model.update(number * 2 * MS)
    assert list(model.steps) == [-50 * MS]
    assert model.at(900 * 2 * MS) == begin + 900 * 4 * MS + step - 50 * MS


def test_a_clock_that_is_being_slewed_while_it_locks_has_the_ratio_of_the_oscillators() -> None:
    """Slewed by 1 % for 4 s, not for 4 s, by -1 %: what is published follows at once."""
    model = HostClockModel(2.0)
    model.stepped(0, 0)
    begin = 10**18

    def shown(even: int) -> int:
        return even + min(even, 4_000 * MS) // 100 - max(even - 8_000 * MS, 0) // 100

    for number in range(3_000):
        even = number * 4 * MS
        if number % 4 == 0:
            model.slewed(shown(even) - even, begin + shown(even))
        model.add(number * 2 * MS, begin + shown(even))
        if number * 2 * MS >= model.due:
            model.update(number * 2 * MS)
        if model.ready:
            place = number * 2 * MS
            # the end of slewing is known when it is told, 16 ms later
            assert model.at(place) == pytest.approx(begin + shown(even), abs=400_000)
            if number < 1_000:
                assert model.at(place) == pytest.approx(begin + shown(even), abs=20_000)
                assert model.line.ratio == pytest.approx(2.0, rel=1e-5)
    assert model.slew_rate == pytest.approx(-0.01, rel=0.05)


def test_what_a_cadence_allows_for() -> None:
    cadence = _learned(2 * MS)
    assert cadence.slip(1) == 2 * MS + 2_000  # a packet that was not counted
    assert cadence.slip(40) == 4 * MS + 2_000  # 5 % of the advance
    assert cadence.wander(1) == 102_000
    assert cadence.wander(100) == 10 * MS + 16 * 2_000
    cadence.resume(9, 2 * MS + 1_000)  # a small deviation corrects the phase by the gain
    assert cadence.advance(1) == 2 * MS - 900
    cadence.resume(10, 2 * MS + 9_000)  # the packet is the new reference
    assert cadence.advance(1) == 2 * MS


def test_a_cadence_whose_numbers_are_unknown_takes_each_packet_for_the_next() -> None:
    cadence = _learned(2 * MS, first=2_000)  # beyond every modulus it knows of
    assert cadence.gap(5, 500 * MS) == 1
    assert cadence.gap(2_010, 500 * MS) == 2


def test_packets_on_no_credible_line_are_left_behind() -> None:
    """A second and a half at a ratio that no clock has, then a clock that is right."""
    model = HostClockModel(2.0)
    begin = 10**18
    for number in range(400):
        model.add(number * 40 * MS, begin + number * 4 * MS)
        model.update(number * 40 * MS)
    assert not model.ready
    place, arrival = 400 * 40 * MS, begin + 400 * 4 * MS
    needed = 0
    while not model.ready and needed < 1_500:
        needed += 1
        model.add(place + needed * 2 * MS, arrival + needed * 4 * MS)
        model.update(place + needed * 2 * MS)
    # 1.6 s are given up by half: 0.8 s of both kinds are left, and fill up to 1.6 s again
    assert 195 <= needed <= 205
    assert model.line.ratio == pytest.approx(2.0, rel=1e-6)


TOLD = st.lists(
    st.tuples(st.integers(-(10**18), 10**18), st.integers(-(10**12), 10**12)), min_size=1
)


@given(TOLD, st.integers(-(10**18), 10**18), st.integers(-(10**18), 10**18))
def test_slewing_takes_whatever_it_is_told(
    told: list[tuple[int, int]], at: int, step: int
) -> None:
    slewing = HostSlewing()
    assert (slewing.at(at), slewing.rate, slewing.host(at)) == (0, 0.0, at)
    for instant, by in told:
        slewing.told(by, instant)
        assert slewing.at(instant) == by - told[0][1]  # the latest word counts
        assert abs(slewing.rate) <= 0.1
    before = slewing.at(at)
    slewing.stepped(step)
    assert slewing.at(at + step) == pytest.approx(before, abs=2 + abs(before) * 1e-9)


def test_slewing_is_a_polygon_through_what_was_told_and_goes_on_as_it_ended() -> None:
    slewing = HostSlewing()
    for instant, by in [(1_000, 500), (2_000, 510), (4_000, 490)]:
        slewing.told(by, instant)

    assert [slewing.at(at) for at in (0, 1_000, 1_500, 2_000, 3_000, 4_000, 4_200)] == [
        0, 0, 5, 10, 0, -10, -12,
    ]  # fmt: skip
    assert slewing.rate == -0.01
    assert slewing.host(4_210) == 4_198
    for number in range(1_000):
        slewing.told(490, 5_000 + number)
    assert len(slewing._knots) == 64
    assert slewing.at(10**9) == -10


def test_a_step_that_is_told_for_the_far_future_does_not_end_the_fit() -> None:
    model = HostClockModel(2.0)
    model.stepped(10**18, 2 * 10**18)
    for n in range(10_400):
        u = n * 2 * MS
        model.add(u, 10**15 + 2 * u)
        model.update(u)
        assert model.ready == (n >= 10_101)  # 0.4 s of data after the last one refused
    assert model.at(0) == 10**15
