"""Packets back in order; what is missing, late or double is counted."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from hypothesis import given, strategies as st

from l2lidar_node.driver.reorder import SequenceCounts, SequenceOrder

WINDOW = 8


def run(numbers: Any, modulus: int = 1025, window: Any = WINDOW, first: int = 0) -> Any:
    """Push numbers that never wrap; return what came out of it and the order.

    Each comes out as (missing before it, number).
    """
    order: SequenceOrder[int] = SequenceOrder(window)
    released = [pair for n in range(first) for pair in order.push(n % modulus, n)]
    for number in numbers:
        released += order.push(number % modulus, number)
    released += order.flush()
    return released[first:], order


def counted(**counts: int) -> SequenceCounts:
    return SequenceCounts(**counts)


@pytest.mark.parametrize("start", [0, 1, 500, 1020, 1024])
def test_in_order_over_the_wrap_everything_comes_at_once(start: int) -> None:
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    for number in range(start, start + 3000):
        assert order.push(number % 1025, number) == [(0, number)]
    assert order.counts == counted()


@pytest.mark.parametrize("at", [5, 1020, 1024, 1025])
def test_a_lost_one_is_given_up_when_the_window_is_full(at: int) -> None:
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    for number in range(at):
        order.push(number % 1025, number)
    for number in range(at + 1, at + 1 + WINDOW):
        assert order.push(number % 1025, number) == []
    released = order.push((at + 1 + WINDOW) % 1025, at + 1 + WINDOW)
    assert released == [(1, at + 1), *((0, at + n) for n in range(2, WINDOW + 2))]
    assert order.counts == counted(lost=1)


def test_a_swap_is_put_right() -> None:
    released, order = run([0, 2, 1, 3])
    assert released == [(0, 0), (0, 1), (0, 2), (0, 3)]
    assert order.counts == counted(reordered=1)


def test_every_one_that_comes_after_a_later_one_is_reordered() -> None:
    released, order = run([0, 4, 3, 2, 1, 5])
    assert [number for _, number in released] == [0, 1, 2, 3, 4, 5]
    assert order.counts == counted(reordered=3)


def test_duplicates_come_once() -> None:
    released, order = run([0, 0, 1, 3, 3, 2, 2, 1])
    assert [number for _, number in released] == [0, 1, 2, 3]
    assert order.counts == counted(duplicates=4, reordered=1)


def test_a_late_one_is_dropped_and_counted_as_late_instead_of_lost() -> None:
    released, order = run([0, *range(2, 20), 1, 1])
    assert [number for _, number in released] == [0, *range(2, 20)]
    assert order.counts == counted(late=1, duplicates=1)


def test_late_ones_of_several_gaps_are_told_from_duplicates() -> None:
    numbers = [n for n in range(60) if n not in (5, 20, 35)]
    _, order = run([*numbers, 5, 20, 35, 20])
    assert order.counts == counted(late=3, duplicates=1)


def test_a_number_given_up_a_turn_ago_is_not_late_for_this_turn() -> None:
    numbers = [n for n in range(1025 + 20) if n != 5]
    released, order = run([*numbers, 1025 + 5])
    assert [number for _, number in released] == numbers
    assert order.counts == counted(lost=1, duplicates=1)


def test_window_zero_waits_for_nothing() -> None:
    order: SequenceOrder[int] = SequenceOrder(0)
    assert order.push(0, 0) == [(0, 0)]
    assert order.push(3, 3) == [(2, 3)]
    assert order.push(2, 2) == []
    assert order.counts == counted(lost=1, late=1)


def test_flush_releases_in_order_and_counts_gaps() -> None:
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    for number in (0, 5, 2):
        order.push(number, number)
    assert order.oldest == 5
    assert order.flush() == [(1, 2), (2, 5)]
    assert order.oldest is None
    assert order.counts.lost == 3


def test_give_up_releases_up_to_the_next_gap() -> None:
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    for number in (0, 5, 2, 3):
        order.push(number, number)
    assert order.give_up() == [(1, 2), (0, 3)]
    assert order.give_up() == [(1, 5)]
    assert order.give_up() == []


def test_restart_takes_the_next_number_as_the_first() -> None:
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    for number in (500, 502):
        order.push(number, number)
    assert order.restart() == [(1, 502)]
    assert order.push(3, 3) == [(0, 3)]
    assert order.push(4, 4) == [(0, 4)]
    assert order.counts == counted(lost=1, restarts=1)


def test_before_the_first_nothing_is_earlier() -> None:
    order = SequenceOrder[int](8)
    assert not order.is_earlier(1, 5)
    order.push(3, 0)
    assert order.is_earlier(4, 5)
    assert not order.is_earlier(5, 4)


def test_restart_of_one_that_never_ran_is_none() -> None:
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    assert order.restart() == []
    assert order.counts == counted()


@pytest.mark.parametrize("outage", [1, 500, 960, 1000, 1024])
def test_after_a_silence_nothing_is_taken_for_late(outage: int) -> None:
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    for number in range(100):
        order.push(number, number)
    first = 100 + outage
    assert order.resume(first % 1025, first) == [(outage, first)]
    for number in range(first + 1, first + 200):
        assert order.push(number % 1025, number) == [(0, number)]
    assert order.counts == counted(lost=outage)


def test_what_comes_after_the_one_that_ended_a_silence_is_late_and_not_twice() -> None:
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    order.push(0, 0)
    assert order.resume(10, 10) == [(9, 10)]
    assert order.push(9, 9) == []
    assert order.counts == counted(lost=8, late=1)


def test_a_silence_releases_what_waits_first() -> None:
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    for number in (0, 2):
        order.push(number, number)
    assert order.resume(10, 10) == [(1, 2), (7, 10)]


def test_the_first_packet_may_be_a_resumption() -> None:
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    assert order.resume(700, 700) == [(0, 700)]


@pytest.mark.parametrize("modulus", [256, 1000, 1024, 1025, 1026, 2048])
def test_another_modulus_is_learned_within_three_turns(modulus: int) -> None:
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    for number in range(3 * modulus):
        order.push(number % modulus, number)
    order.flush()
    before = order.counts.lost
    for number in range(3 * modulus, 6 * modulus):
        assert order.push(number % modulus, number) == [(0, number)]
    assert order.counts == counted(lost=before)
    assert before <= 1025


@pytest.mark.parametrize(("modulus", "window"), [(100, WINDOW), (1025, 256)])
def test_a_large_window_leaves_room_ahead(modulus: int, window: Any) -> None:
    order: SequenceOrder[int] = SequenceOrder(window)
    for number in range(3 * modulus):
        order.push(number % modulus, number)
    order.flush()
    before, first = order.counts.lost, 3 * modulus + 30
    released = [pair for n in range(first, first + 600) for pair in order.push(n % modulus, n)]
    assert released[0] == (30, first)
    assert order.counts == counted(lost=before + 30)


@pytest.mark.parametrize("modulus", [65536, 2**32])
def test_the_wrap_of_a_large_modulus_costs_nothing(modulus: Any) -> None:
    numbers = range(modulus - 300, modulus + 300)
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    released = [pair for number in numbers for pair in order.push(number % modulus, number)]
    assert released == [(0, number) for number in numbers]
    assert order.counts == counted()


def test_a_larger_modulus_costs_nothing() -> None:
    released, order = run(range(5000), modulus=2048)
    assert released == [(0, number) for number in range(5000)]
    assert order.counts == counted()


def test_a_loss_at_a_wrap_that_is_not_known_yet() -> None:
    numbers = [n for n in range(6000) if n not in (2047, 2048, 4095)]
    released, order = run(numbers, modulus=2048)
    assert [number for _, number in released] == numbers
    assert order.counts.duplicates == order.counts.late == 0
    assert order.counts.lost <= 3


def test_a_wild_number_does_not_stop_the_stream() -> None:
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    released = [pair for n in range(50) for pair in order.push(n, n)]
    released += order.push(4_000_000_000, -1)
    for number in range(50, 500):
        released += order.push(number, number)
    after = [number for _, number in released if number >= 50]
    assert after[-300:] == list(range(200, 500))


@st.composite
def disturbed(draw: Any, largest_gap: int = 60) -> Any:
    """Draw the numbers of a stream that lost, doubled and displaced some, and where it began."""
    count = draw(st.integers(1, 250))
    first = draw(st.integers(0, 1500))
    delays = draw(st.lists(st.sampled_from([0] * 6 + [1, 2, 5]), min_size=count, max_size=count))
    kept = draw(st.lists(st.sampled_from([1] * 12 + [0, 0, 2]), min_size=count, max_size=count))
    sent = [
        (index + delay, first + index)
        for index, (delay, copies) in enumerate(zip(delays, kept, strict=True))
        for _ in range(copies)
    ]
    return first, [number for _, number in sorted(sent, key=lambda pair: pair[0])]


@given(disturbed(), st.sampled_from([1025, 2000]))
def test_order_is_restored_and_nothing_comes_twice(stream: Any, modulus: Any) -> None:
    first, numbers = stream
    released, order = run(numbers, modulus, first=first)
    out = [number for _, number in released]
    assert out == sorted(set(out))
    assert set(out) <= set(numbers)
    counts = order.counts
    assert counts.duplicates + counts.late == len(numbers) - len(out)


@given(disturbed())
def test_what_was_within_the_window_is_not_lost_and_counts_add_up(stream: Any) -> None:
    first, numbers = stream
    if first == 0 and numbers:
        first = numbers[0]  # what comes before the first packet was never missed
        numbers = [n for n in numbers if n >= first]
    released, order = run(numbers, first=first)
    out = [number for _, number in released]
    assert out == sorted(set(numbers))  # no delay was longer than the window
    if out:
        everything = set(range(first, out[-1] + 1))
        assert order.counts.lost == len(everything - set(out))
        assert sum(missing for missing, _ in released) == order.counts.lost
    assert order.counts.late == 0


@given(st.lists(st.integers(0, 2**32 - 1)), st.integers(0, 20))
def test_any_numbers_are_taken(numbers: Any, window: Any) -> None:
    order: SequenceOrder[int] = SequenceOrder(window)
    released = []
    for index, number in enumerate(numbers):
        released += order.push(number, index)
        assert len(order.waiting) <= window
    released += order.flush()
    out = [index for _, index in released]
    assert len(out) == len(set(out))
    counts = order.counts
    assert len(out) + counts.duplicates + counts.late == len(numbers)
    assert all(missing >= 0 for missing, _ in released)


@given(disturbed(), st.integers(0, 30), st.integers(-1, 1), st.sampled_from([1025, 2000]))
def test_numbers_that_follow_together_are_those_that_follow_one_by_one(
    stream: Any, count: int, off: int, modulus: int
) -> None:
    first, numbers = stream
    order: SequenceOrder[int] = SequenceOrder(WINDOW)
    for number in [*range(first), *numbers]:
        order.push(number % modulus, number)
    begin = (max(numbers, default=0) + 1 + off) % modulus
    together, singly = copy.deepcopy(order), copy.deepcopy(order)
    is_taken = together.all_follow(begin, begin + count)
    assert is_taken == all(singly.follows(number) for number in range(begin, begin + count + 1))
    following = [begin + count + step for step in (1, 2, 0, 4, 3)]
    for number in range(begin, begin + count + 1) if not is_taken else ():
        together.push(number, number)
        order.push(number, number)
    expected = order if not is_taken else singly
    assert [together.push(n, n) for n in following] == [expected.push(n, n) for n in following]
    assert together.counts == expected.counts
