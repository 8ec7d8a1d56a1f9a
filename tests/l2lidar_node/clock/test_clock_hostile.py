"""The clock on input that makes no sense: it answers, keeps its promises and does not grow."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from l2lidar_node.clock import ClockEventKind, DeviceClock
from l2lidar_node.config import ClockConfig
from l2lidar_node.types import DeviceNs, HostNs, Stream

YEAR_NS = 365 * 24 * 3600 * 10**9
SECONDS = st.integers(0, 2**32 - 1)
STAMPS = st.one_of(
    st.builds(lambda sec, nsec: sec * 10**9 + nsec, SECONDS, st.integers(0, 2**32 - 1)),
    st.integers(0, 10**9),
)
PACKETS = st.lists(
    st.tuples(
        st.sampled_from(list(Stream)),
        st.one_of(st.integers(0, 2**32 - 1), st.integers(0, 1200)),
        STAMPS,
        st.integers(0, 2**63 - 1),
        st.integers(0, 10**8),
        st.sampled_from(["packet", "packet", "packet", "sync", "round trip"]),
    ),
    max_size=200,
)
CONFIGS = st.builds(
    ClockConfig,
    enable_l2_time_correction=st.booleans(),
    enable_l2_host_sync=st.booleans(),
    l2_sync_mode=st.sampled_from(["once", "periodic"]),
    publish_unlocked=st.booleans(),
    enable_latency_measure=st.booleans(),
)


class Promises:
    """Checks every answer of a clock."""

    def __init__(self, config: ClockConfig) -> None:
        self.clock = DeviceClock(config)
        self._begins_anew = not (config.enable_l2_time_correction or config.enable_l2_host_sync)
        self.last = dict.fromkeys(Stream, 0)

    def observe(self, stream: Stream, seq: int, stamp: int, arrival: int, duration: int) -> None:
        answer = self.clock.observe(stream, seq, DeviceNs(stamp), HostNs(arrival), duration)
        events = [event.kind for event in self.clock.events()]
        if self._begins_anew and ClockEventKind.REBOOT in events:
            self.last = dict.fromkeys(Stream, 0)
        if answer is not None:
            assert isinstance(answer, int)
            assert self.last[stream] < answer <= arrival - duration
            self.last[stream] = answer


@given(CONFIGS, PACKETS)
def test_any_input_is_answered_and_promises_are_kept(
    config: ClockConfig, packets: list[tuple[Stream, int, int, int, int, str]]
) -> None:
    checked = Promises(config)
    for stream, seq, stamp, arrival, duration, what in packets:
        if what == "sync":
            checked.clock.synced(HostNs(stamp), HostNs(arrival))
        elif what == "round trip":
            checked.clock.round_trip(duration)
        else:
            checked.observe(stream, seq, stamp, arrival, duration)
        checked.clock.sync_due(HostNs(arrival))
    checked.clock.status()
    checked.clock.events()


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.floats(0.3, 4.0), st.integers(1, 60))
def test_streams_that_are_cut_and_joined_anywhere_keep_the_promises(
    seed: int, ratio: float, length: int
) -> None:
    """Pieces of good streams, each with its own clock, numbers, and host time."""
    rng = np.random.default_rng(seed)
    checked = Promises(ClockConfig(l2_sync_mode="periodic"))
    for _ in range(12):
        stamp, seq = int(rng.integers(0, 2**62)), int(rng.integers(0, 1200))
        arrival = 10**18 + int(rng.integers(0, 10**11))
        checked.clock.synced(HostNs(arrival), HostNs(arrival))
        for number in range(length * 3):
            late = int(rng.exponential(10**6))
            stream = Stream.IMU if number % 2 else Stream.POINTS
            instant = number * 4_000_000
            checked.observe(
                stream, (seq + number // 2) % 1025, stamp + int(instant / ratio),
                arrival + instant + late, 0,
            )  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
def test_memory_is_bounded(seed: int) -> None:
    rng = np.random.default_rng(seed)
    checked = Promises(ClockConfig(l2_sync_mode="periodic"))
    sizes = []
    for _ in range(4):
        for number in range(4000):
            noise = int(rng.integers(0, 2**40)) if rng.random() < 0.05 else 0
            arrival = 10**18 + number * 4_000_000
            if rng.random() < 0.1:
                checked.clock.synced(HostNs(arrival), HostNs(arrival))
            checked.observe(Stream.IMU, number % 1025, number * 2_000_000 + noise, arrival, 0)
        sizes.append(len(pickle.dumps(checked.clock.__getstate__())))

    assert max(sizes) < 200_000


def test_a_host_clock_set_before_the_lock_takes_nothing_but_time() -> None:
    """As on a board that starts in the past: the socket still holds packets of the time before."""
    checked = Promises(ClockConfig(enable_l2_host_sync=False))
    checked.clock.host_stepped(0, HostNs(0))
    for number in range(1500):
        instant = number * 2_000_000
        if number == 20:
            checked.clock.host_stepped(10**18, HostNs(10**18 + instant))
        begun = 10**18 if number >= 60 else 0
        checked.observe(Stream.IMU, number, instant // 2, begun + instant, 0)
    assert checked.last[Stream.IMU] > 10**18


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(-60 * YEAR_NS, 60 * YEAR_NS), max_size=4), st.booleans())
def test_jumps_of_the_host_clock_by_decades_keep_the_promises(
    jumps: list[int], told: bool
) -> None:
    checked = Promises(ClockConfig())
    shown = 60 * YEAR_NS
    if told:
        checked.clock.host_stepped(0, HostNs(shown))
    for part, jump in enumerate([0, *jumps]):
        shown = max(shown + jump, 1)
        if told and jump:
            checked.clock.host_stepped(jump, HostNs(shown))
        for number in range(part * 300, (part + 1) * 300):
            shown += 4_000_000
            checked.observe(Stream.IMU, number % 1025, number * 2_000_000, shown, 0)
    assert len(pickle.dumps(checked.clock.__getstate__())) < 200_000
