"""Packets of points that are put off: when they are handled changes nothing."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection
from typing import Any

import pytest
from hypothesis import example, given, settings, strategies as st

from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Counters, Driver, Event
from l2lidar_node.protocol import wire
from l2lidar_node.settings import build as configure
from l2lidar_node.types import HostNs, ImuSample, Sweep
from tests.support import build
from tests.support.build import Datagram

_DATAGRAMS = build.capture(1.6)
_LOCKED = 300  # by then the clock is
_POINTS_SIZE = 1044
_DISTURBANCES: dict[str, Callable[[list[Datagram], int], None]] = {
    "lost": lambda some, at: some.__delitem__(at),
    "doubled": lambda some, at: some.insert(at + 1, some[at]),
    "late": lambda some, at: some.insert(at + 7, some.pop(at)),
    "old": lambda some, at: some.insert(at, some[at - 200]),
    "damaged": lambda some, at: some.__setitem__(at, _damaged(some[at])),
    "cut": lambda some, at: some.__setitem__(at, some[at]._replace(data=some[at].data[:700])),
    "garbage": lambda some, at: some.insert(at, some[at]._replace(data=b"\x55\xaa\x05\x0a!")),
    "paused": lambda some, at: some.__delitem__(slice(at, at + 80)),
}


def _damaged(item: Datagram) -> Datagram:
    data = bytearray(item.data)
    data[len(data) // 2] ^= 0xFF
    return item._replace(data=bytes(data))


def _shifted(item: Datagram, by_ns: int) -> Datagram:
    """Return a datagram with another stamp."""
    kind, payload = wire.HEADER.unpack_from(item.data)[1], bytearray(item.data[12:-12])
    seconds, nanoseconds = struct.unpack_from("<II", payload, 8)
    stamp = seconds * build.NS + nanoseconds + by_ns
    struct.pack_into("<II", payload, 8, *divmod(stamp, build.NS))
    return item._replace(data=build.frame(kind, bytes(payload)))


def disturbed(what: list[tuple[int, str]], steps: list[tuple[int, float]]) -> list[Datagram]:
    """Return the capture with something done to it at some places, arrivals in order.

    ``steps`` are those by which another host sets the device's clock [ms].
    """
    some = list(_DATAGRAMS)
    for at, by_ms in steps:
        some[at:] = [_shifted(item, round(by_ms * 1e6)) for item in some[at:]]
    for at, kind in what:
        _DISTURBANCES[kind](some, min(at, len(some) - 100))
    arrivals = [item.arrival_ns for item in some]
    for number in range(1, len(arrivals)):
        arrivals[number] = max(arrivals[number], arrivals[number - 1])
    return [item._replace(arrival_ns=at) for item, at in zip(some, arrivals, strict=True)]


class Outcome:
    """What a driver makes of datagrams, somebody looking after those of some numbers."""

    def __init__(self, datagrams: list[Datagram], looks: Collection[int], **values: Any) -> None:
        driver = Driver(configure(DriverConfig, values))
        events: list[Event] = []
        self.put_off = 0
        for number, (arrival, data) in enumerate(datagrams):
            taken = driver.counters.frames.total()
            events += driver.receive(data, HostNs(arrival))
            self.put_off += driver.counters.frames.total() == taken
            if number in looks:
                events += driver.catch_up()
        events += driver.flush()
        self.samples = [event for event in events if isinstance(event, ImuSample)]
        self.sweeps = [_facts(event) for event in events if isinstance(event, Sweep)]
        self.others = [e for e in events if not isinstance(e, ImuSample | Sweep)]
        self.counters: Counters = driver.counters

    def same(self, other: Outcome) -> bool:
        """Tell whether both gave the same, to the bit."""
        mine, its = ((one.samples, one.sweeps, one.others, one.counters) for one in (self, other))
        return mine == its


def _facts(sweep: Sweep) -> tuple[Any, ...]:
    return sweep.start, sweep.end, sweep.packets, sweep.missing, sweep.points.tobytes()


numbers = st.integers(_LOCKED, len(_DATAGRAMS) - 1)
step_sizes = st.builds(
    lambda sign, power: float(sign * 10**power), st.sampled_from([-1, 1]), st.floats(-2.0, 4.0)
)
disturbances = st.lists(st.tuples(numbers, st.sampled_from(sorted(_DISTURBANCES))), max_size=4)


@settings(max_examples=12, deadline=None)
@given(
    what=disturbances,
    steps=st.lists(st.tuples(numbers, step_sizes), max_size=2),
    looks=st.sets(numbers, max_size=60),
    cut=st.sampled_from(["turn", "packets"]),
)
@example(what=[], steps=[(314, 7.5896)], looks=set(), cut="packets")
@example(what=[], steps=[(622, 0.534)], looks=set(), cut="packets")
@example(what=[], steps=[(631, -0.2675)], looks=set(), cut="turn")
def test_when_they_are_handled_changes_nothing(
    what: list[tuple[int, str]], steps: list[tuple[int, float]], looks: set[int], cut: str
) -> None:
    datagrams = disturbed(what, steps)
    outcome = Outcome(datagrams, looks, sweep_cut=cut)
    one_by_one = Outcome(datagrams, range(len(datagrams)), sweep_cut=cut)
    assert outcome.same(one_by_one)
    assert outcome.samples
    assert outcome.counters.sweeps


@pytest.mark.parametrize("with_imu", [False, True])
def test_most_packets_are_put_off(with_imu: bool) -> None:
    datagrams = [d for d in _DATAGRAMS if with_imu or len(d.data) == _POINTS_SIZE]
    points = sum(len(item.data) == _POINTS_SIZE for item in datagrams[_LOCKED:])
    outcome = Outcome(datagrams, [], enable_l2_host_sync=False)
    assert outcome.put_off > 0.7 * points


def test_the_packet_that_completes_a_sweep_is_not() -> None:
    driver = Driver(configure(DriverConfig, {"enable_l2_host_sync": False}))
    one_by_one = Driver(configure(DriverConfig, {"enable_l2_host_sync": False}))
    for arrival, data in _DATAGRAMS:
        both = driver.receive(data, HostNs(arrival)), one_by_one.receive(data, HostNs(arrival))
        late = one_by_one.catch_up()
        assert not any(isinstance(event, Sweep) for event in late)
        sweeps, expected = (
            [_facts(event) for event in events if isinstance(event, Sweep)] for events in both
        )
        assert sweeps == expected
