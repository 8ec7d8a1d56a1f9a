"""The watch over the host's clock; nobody sets the real one here."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import pairwise

import pytest

from l2lidar_node.transport.host_clock import HostClock

UP, SHOWN = 10**12, 1_760_000_000 * 10**9


class Host:
    """All of its clocks; every look takes a while."""

    def __init__(self) -> None:
        self.true_ns = 0
        self.ahead_ns = SHOWN - UP
        self.slewed_ns = 0
        self.looks: Iterator[int] = iter(())  # how long the next ones take [ns]

    def look(self) -> int:
        self.true_ns += next(self.looks, 100)
        return self.true_ns

    def uptime(self, clock: int) -> int:
        assert clock in (time.CLOCK_BOOTTIME, time.CLOCK_MONOTONIC, time.CLOCK_MONOTONIC_RAW)
        is_raw = clock == time.CLOCK_MONOTONIC_RAW
        return UP + self.look() + (0 if is_raw else self.slewed_ns)

    def shown(self) -> int:
        return UP + self.look() + self.ahead_ns + self.slewed_ns


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> Host:
    made = Host()
    monkeypatch.setattr(time, "clock_gettime_ns", made.uptime)
    monkeypatch.setattr(time, "time_ns", made.shown)
    return made


@pytest.mark.parametrize("step_s", [0.001, 0.05, 1, 3600, -0.05, -1, -3600])
def test_a_step_is_told_once_and_to_the_microsecond(host: Host, step_s: float) -> None:
    clock = HostClock()
    host.true_ns += 10**10
    assert clock.step_ns() == 0
    host.ahead_ns += round(step_s * 1e9)
    assert clock.step_ns() == pytest.approx(step_s * 1e9, abs=1_000)
    assert clock.step_ns() == 0


def test_an_adjusted_rate_is_no_step(host: Host) -> None:
    clock = HostClock()
    for _ in range(1000):  # an hour at 500 ppm, as if only the one clock felt it
        host.true_ns += 3_600_000_000
        host.ahead_ns += 900_000
        assert clock.step_ns() == 0


def test_a_process_that_is_held_up_while_it_looks_sees_no_step(host: Host) -> None:
    clock = HostClock()
    host.looks = iter([100, 2_000_000_000, 100, 100, 100, 3_000_000_000, 100, 100, 100])
    assert clock.step_ns() == 0
    host.looks = iter([2_000_000_000] * 100)
    assert clock.step_ns() == 0
    host.ahead_ns += 10**9
    assert clock.step_ns() == 0  # not sure of anything
    host.looks = iter(())
    assert clock.step_ns() == pytest.approx(1e9, abs=1_000)


def test_a_host_too_busy_at_first_begins_when_it_can(host: Host) -> None:
    host.looks = iter([2_000_000_000] * 15)
    clock = HostClock()
    assert clock.step_ns() == 0
    host.ahead_ns -= 10**9
    assert clock.step_ns() == pytest.approx(-1e9, abs=1_000)


def test_the_real_clocks_agree() -> None:
    clock = HostClock()
    before = time.time_ns()
    assert before <= clock.now() <= time.time_ns()
    assert [clock.step_ns() for _ in range(100)] == [0] * 100
    first, second = clock.slewed_ns(), clock.slewed_ns()
    assert (first, second) == (None, None) or (isinstance(first, int) and second is None)


def watch(host: Host, clock: HostClock, seconds: float, ppm: float) -> list[tuple[int, int]]:
    """Look every 10 ms while the clock is slewed; return instants and errors of what was told."""
    told = []
    for _ in range(round(seconds * 100)):
        host.true_ns += 10_000_000
        host.slewed_ns += round(10_000 * ppm * 1e-3)
        found = clock.slewed_ns()
        if found is not None:
            told.append((host.true_ns, found - host.slewed_ns))
    return told


@pytest.mark.parametrize("ppm", [20.0, 500.0, -83_000.0])
def test_slewing_is_told_when_it_begins_and_ends_and_no_more_often(host: Host, ppm: float) -> None:
    clock = HostClock()
    assert clock.slewed_ns() == pytest.approx(0, abs=200)
    assert watch(host, clock, 5.0, 0.0) == []
    told = watch(host, clock, 20.0, ppm)
    assert 2 <= len(told) <= 10
    assert max(abs(error) for _, error in told) < 200
    first = told[0][0]
    assert ppm == 20.0 or all(at - first < 2 * 10**9 for at, _ in told)
    if abs(ppm) < 1000.0:  # a sudden one cannot wait
        assert all(b - a >= 100_000_000 for (a, _), (b, _) in pairwise(told))
    told = watch(host, clock, 20.0, 0.0)
    assert 2 <= len(told) <= 10
    assert max(abs(error) for _, error in told) < 200


def test_a_step_and_a_suspended_host_are_no_slewing(host: Host) -> None:
    clock = HostClock()
    clock.slewed_ns()
    host.ahead_ns -= 3_600 * 10**9
    assert watch(host, clock, 1.0, 0.0) == []


def test_a_process_that_is_held_up_reads_no_slewing(host: Host) -> None:
    clock = HostClock()
    host.looks = iter([30_000] * 15)
    assert clock.slewed_ns() is None
    host.looks = iter([50_000, 50_000, 100, 100, 100])
    assert clock.slewed_ns() == pytest.approx(0, abs=200)
