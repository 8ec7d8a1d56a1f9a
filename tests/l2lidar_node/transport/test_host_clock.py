"""The watch over the host's clock; nobody sets the real one here."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from l2lidar_node.transport.host_clock import HostClock

UP, SHOWN = 10**12, 1_760_000_000 * 10**9


class Host:
    """Both of its clocks; every look takes a while."""

    def __init__(self) -> None:
        self.true_ns = 0
        self.ahead_ns = SHOWN - UP
        self.looks: Iterator[int] = iter(())  # how long the next ones take [ns]

    def look(self) -> int:
        self.true_ns += next(self.looks, 100)
        return self.true_ns

    def uptime(self, clock: int) -> int:
        assert clock == time.CLOCK_BOOTTIME
        return UP + self.look()

    def shown(self) -> int:
        return UP + self.look() + self.ahead_ns


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
