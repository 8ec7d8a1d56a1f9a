"""The envelope of the delays by itself: when its ratio is known, and when it begins anew."""

from __future__ import annotations

import random

import pytest

from l2lidar_node.clock.lower_envelope import BLOCK_NS, LowerEnvelope, supporting_line

MS = 1_000_000
RATIO = 1.25
BEGIN = 1_700_000_000_000 * MS
PERIOD = 4 * MS  # [ns host]


def arrivals(seconds: float, jitter_ms: float, begin_s: float = 0.0) -> list[tuple[int, int]]:
    """Return device times and arrivals of packets whose delays vary by so much."""
    draws = random.Random(4)
    first, last = round(begin_s * 1e9 / PERIOD), round((begin_s + seconds) * 1e9 / PERIOD)
    return [
        (
            round(n * PERIOD / RATIO),
            BEGIN + n * PERIOD + round(draws.uniform(0.0, jitter_ms * MS)),
        )
        for n in range(first, last)
    ]


def envelope(packets: list[tuple[int, int]], *, is_told: bool = True) -> LowerEnvelope:
    line = supporting_line(packets, RATIO)
    assert line is not None
    return LowerEnvelope(line, packets, guess=RATIO, is_told=is_told)


def blocks(packets: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the least delayed packet of each block."""
    found: dict[int, tuple[int, int]] = {}
    for u, host in packets:
        number = (host - BEGIN) // BLOCK_NS
        height = host - round(u * RATIO)
        if number not in found or height < found[number][1] - round(found[number][0] * RATIO):
            found[number] = u, host
    return list(found.values())


@pytest.mark.parametrize(("seconds", "known"), [(0.5, False), (1.0, True), (4.0, True)])
def test_the_ratio_is_known_to_what_the_minimum_repeats_by_over_the_span(
    seconds: float, known: bool
) -> None:
    """Three times 10 us, to which a quiet path repeats, over 0.5 s are 60 ppm, over 1 s 30 ppm."""
    found = envelope(arrivals(seconds, 0.02))
    assert found.is_known == known
    assert found.line.ratio == pytest.approx(RATIO, rel=1e-5)
    assert 10_000 <= found.uncertainty_ns < 40_000


def test_nothing_is_known_from_a_path_whose_minimum_does_not_repeat() -> None:
    found = envelope(arrivals(2.0, 20.0))
    assert not found.is_known
    assert 100_000 < found.uncertainty_ns < 20 * MS


def test_a_known_ratio_keeps_late_blocks_from_turning_the_line() -> None:
    found = envelope(arrivals(4.0, 0.2))
    for u, host in blocks(arrivals(6.0, 0.2, begin_s=4.0)):
        load = min((host - BEGIN - 4_000 * MS) // 100, 10 * MS)  # 1 % of the time
        found.close((u, host + load), u)
        assert found.line.at(u) == pytest.approx(host, abs=200_000)
    assert found.is_known
    assert found.line.ratio == pytest.approx(RATIO, rel=30e-6)


def test_quiet_blocks_after_a_load_are_a_new_line_as_soon_as_there_are_enough() -> None:
    found = envelope(arrivals(2.0, 20.0))
    begun = []
    for low in blocks(arrivals(2.0, 0.2, begin_s=2.0)):
        begun.append(found.begins_anew(low))
        if not begun[-1]:
            found.close(low, low[0])
    assert begun.index(True) == 7  # eight of them
    assert found.moves == sum(begun) <= 2
    assert found.line.ratio == pytest.approx(RATIO, rel=20e-6)
    u, host = blocks(arrivals(0.2, 0.2, begin_s=4.0))[-1]
    assert found.line.at(u) == pytest.approx(host, abs=20_000)


@pytest.mark.parametrize("jitter_ms", [0.2, 20.0])
def test_blocks_like_those_so_far_are_no_new_line(jitter_ms: float) -> None:
    found = envelope(arrivals(2.0, jitter_ms))
    for low in blocks(arrivals(4.0, jitter_ms, begin_s=2.0)):
        assert not found.begins_anew(low)
        found.close(low, low[0])
    assert found.moves == 0
