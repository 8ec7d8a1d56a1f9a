"""What the device is doing, and when its silence is too long."""

from __future__ import annotations

from typing import Any

import pytest

from l2lidar_node.config import WatchdogConfig
from l2lidar_node.driver.device import (
    MAX_STEP_NS,
    RUN_OUT_NS,
    SILENCE_NS,
    SPIN_UP_NS,
    DeviceState,
    Watchdog,
)
from l2lidar_node.types import HostNs, Stream
from tests.support import build

START = build.EPOCH_NS
S = 1_000_000_000


def at(seconds: float) -> HostNs:
    return HostNs(START + round(seconds * S))


class Watched:
    """A watchdog that is asked ten times a second, as a node does."""

    def __init__(self, **config: Any) -> None:
        self.watchdog = Watchdog(WatchdogConfig(**config))
        self.now = START
        self.expiries: list[float] = []

    def run(self, seconds: float, *streams: Stream) -> None:
        """Let time pass while these streams are heard."""
        for _ in range(round(seconds * 10)):
            self.now += S // 10
            for stream in streams:
                self.watchdog.heard(stream, HostNs(self.now))
            if self.watchdog.expired(HostNs(self.now)):
                self.expiries.append((self.now - START) / S)

    @property
    def state(self) -> DeviceState:
        return self.watchdog.state(HostNs(self.now))


IMU, POINTS = Stream.IMU, Stream.POINTS


def test_from_power_on_to_streaming() -> None:
    watched = Watched()
    assert watched.state is DeviceState.WAITING
    watched.run(4)
    assert watched.state is DeviceState.WAITING
    watched.run(21, IMU)
    assert watched.state is DeviceState.SPINNING_UP
    watched.run(1, IMU, POINTS)
    assert watched.state is DeviceState.STREAMING
    assert watched.expiries == []


def test_points_alone_are_streaming() -> None:
    watched = Watched()
    watched.run(0.1, POINTS)
    assert watched.state is DeviceState.STREAMING


@pytest.mark.parametrize("streams", [(), (IMU,)])
def test_points_that_stop_are_a_stall(streams: Any) -> None:
    watched = Watched()
    watched.run(5, IMU, POINTS)
    watched.run(SILENCE_NS / S, *streams)
    assert watched.state is DeviceState.STREAMING
    watched.run(0.1, *streams)
    assert watched.state is DeviceState.STALLED


def test_spin_up_that_breaks_off_is_a_stall() -> None:
    watched = Watched()
    watched.run(5, IMU)
    watched.run(1.2)
    assert watched.state is DeviceState.STALLED


def test_a_silence_expires_once() -> None:
    watched = Watched(timeout_ms=5000)
    watched.run(3, IMU, POINTS)
    watched.run(20)
    assert watched.expiries == [pytest.approx(8.1)]
    watched.run(1, IMU)
    watched.run(6)
    assert len(watched.expiries) == 2


def test_a_device_that_never_speaks_expires() -> None:
    watched = Watched(timeout_ms=35_000)
    watched.run(40)
    assert watched.expiries == [pytest.approx(35.2, abs=0.11)]
    assert watched.state is DeviceState.WAITING


@pytest.mark.parametrize("stream", [IMU, POINTS])
def test_either_stream_keeps_it_alive(stream: Any) -> None:
    watched = Watched(timeout_ms=1000)
    watched.run(5, stream)
    assert watched.expiries == []


def test_standby_pauses_it_and_start_gives_the_whole_time_again() -> None:
    watched = Watched(timeout_ms=5000)
    watched.run(3, IMU, POINTS)
    watched.watchdog.stopped(HostNs(watched.now))
    watched.run(2, IMU, POINTS)  # what was in flight
    watched.run(60)
    assert watched.state is DeviceState.STANDBY
    assert watched.watchdog.silence_ns(HostNs(watched.now)) == 0
    assert watched.expiries == []
    watched.watchdog.started(HostNs(watched.now))
    assert watched.state is DeviceState.WAITING
    watched.run(4.9)
    assert watched.expiries == []
    watched.run(0.3)
    assert len(watched.expiries) == 1


def test_a_device_that_does_not_stop_is_watched_again() -> None:
    watched = Watched(timeout_ms=3000)
    watched.run(3, IMU, POINTS)
    watched.watchdog.stopped(HostNs(watched.now))
    watched.run(RUN_OUT_NS / S + 1, IMU, POINTS)
    assert watched.state is DeviceState.STREAMING
    watched.run(4)
    assert watched.state is DeviceState.STALLED
    assert len(watched.expiries) == 1


def test_waking_from_standby_spins_up_again() -> None:
    watched = Watched()
    watched.run(3, IMU, POINTS)
    watched.watchdog.stopped(HostNs(watched.now))
    watched.run(10)
    watched.watchdog.started(HostNs(watched.now))
    watched.run(5, IMU)
    assert watched.state is DeviceState.SPINNING_UP
    assert watched.watchdog.spin_up_left_s(HostNs(watched.now)) == pytest.approx(16.1)
    watched.run(1, IMU, POINTS)
    assert watched.state is DeviceState.STREAMING


def test_a_start_in_standby_is_not_watched_until_the_device_speaks() -> None:
    watched = Watched(timeout_ms=2000, standby_on_powerup_enabled=True)
    watched.run(100)
    assert watched.expiries == []
    watched.run(1, IMU)
    watched.run(3)
    assert len(watched.expiries) == 1


def test_spin_up_time() -> None:
    watchdog = Watchdog(WatchdogConfig())
    assert watchdog.spin_up_left_s(at(0)) == SPIN_UP_NS / S
    for tenth in range(100):
        watchdog.heard(IMU, at(tenth / 10))
    assert watchdog.spin_up_left_s(at(10)) == pytest.approx(11)
    assert watchdog.spin_up_left_s(at(30)) == 0


def test_an_imu_that_paused_begins_to_spin_up_anew() -> None:
    watchdog = Watchdog(WatchdogConfig())
    watchdog.heard(IMU, at(0))
    watchdog.heard(IMU, at(10))
    assert watchdog.spin_up_left_s(at(10)) == 21


@pytest.mark.parametrize("hours", [24 * 365, 1, -1])
@pytest.mark.parametrize("heard_first", [True, False])
def test_a_host_clock_that_is_set_is_no_silence(hours: Any, heard_first: bool) -> None:
    watched = Watched(timeout_ms=6000)
    watched.run(3, IMU, POINTS)
    watched.now += hours * 3600 * S
    if heard_first:
        watched.watchdog.heard(IMU, HostNs(watched.now))
    watched.run(3, *([IMU] if heard_first else []))
    assert watched.expiries == []
    assert 0 <= watched.watchdog.silence_ns(HostNs(watched.now)) <= 3 * S
    watched.run(6.2)
    assert len(watched.expiries) == 1


def test_a_step_as_long_as_a_busy_host_may_sleep_is_a_silence() -> None:
    watchdog = Watchdog(WatchdogConfig(timeout_ms=4000))
    watchdog.heard(IMU, at(0))
    assert not watchdog.expired(at(0))
    assert watchdog.expired(HostNs(START + MAX_STEP_NS))
