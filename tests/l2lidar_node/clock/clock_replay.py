"""Feeds simulated packets to a clock, through the reorder buffer as the driver does."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.clock import ClockEvent, ClockEventKind, DeviceClock
from l2lidar_node.config import ClockConfig
from l2lidar_node.driver.reorder import SequenceOrder
from l2lidar_node.types import DeviceNs, HostNs, Stream
from tests.support.clock_truth import (
    EVENT,
    IMU,
    POINTS,
    SLEW,
    STEP,
    STREAMS,
    SYNC,
    Scenario,
    simulate,
)  # fmt: skip

STAMPED = np.dtype([*EVENT.descr, ("published", "<i8"), ("uncertainty", "<i8")])
Packet = tuple[int, int, int, int, int, int]


class Replay:
    """What a clock made of a scenario.

    Attributes
    ----------
    packets : ndarray, shape (N,), dtype STAMPED
        Every packet given to the clock; ``published`` is 0 where it gave no stamp, ``uncertainty``
        is what the status says after it [ns].
    stamped : ndarray, shape (M,), dtype STAMPED
        Those with a stamp.
    """

    def __init__(
        self, scenario: Scenario, seed: int, config: ClockConfig | None = None, window: int = 8
    ) -> None:
        self.clock = DeviceClock(config or ClockConfig())
        self.events: list[ClockEvent] = []
        rows = [
            (*packet, self._observe(packet), round(self.clock._host.uncertainty_ns))
            for packet in self._ordered(simulate(scenario, seed), window)
        ]
        self.packets: NDArray[np.void] = np.array(rows, STAMPED)
        self.stamped = self.packets[self.packets["published"] != 0]

    @property
    def kinds(self) -> list[ClockEventKind]:
        """What was reported, in order."""
        return [event.kind for event in self.events]

    @property
    def errors_ms(self) -> NDArray[np.float64]:
        """Published minus true instant of every stamp, shape (M,)."""
        return np.asarray((self.stamped["published"] - self.stamped["truth"]) * 1e-6)

    @property
    def spread_ms(self) -> NDArray[np.float64]:
        """Absolute errors with the constant path delay set aside, shape (M,)."""
        return np.asarray(np.abs(self.errors_ms - np.median(self.errors_ms)))

    @property
    def lock_s(self) -> float:
        """Data until the first stamp."""
        return float(self.stamped["arrival"][0] - self.packets["arrival"][0]) * 1e-9

    def of(self, kind: int) -> NDArray[np.void]:
        """Return the stamped packets of one stream."""
        return self.stamped[self.stamped["kind"] == kind]

    def check_promises(self) -> None:
        """Assert what holds whatever happens: never backwards, never after what was measured."""
        for kind in STREAMS:
            assert np.all(np.diff(self.of(kind)["published"]) > 0)
        latest = self.stamped["arrival"] - self.stamped["duration"]
        assert np.all(self.stamped["published"] <= latest)

    def _observe(self, packet: Packet) -> int:
        kind, seq, stamp, arrival, duration, _ = packet
        answer = self.clock.observe(STREAMS[kind], seq, DeviceNs(stamp), HostNs(arrival), duration)
        self.events += self.clock.events()
        return answer or 0

    def _ordered(self, events: NDArray[np.void], window: int) -> Iterator[Packet]:
        orders = {kind: SequenceOrder[Packet](window) for kind in (IMU, POINTS)}
        boots = dict.fromkeys(orders, 0)
        for event in events.tolist():
            kind, seq, stamp, arrival, _, _ = event
            if kind == SYNC:
                self.clock.synced(HostNs(stamp), HostNs(arrival))
                continue
            if kind == STEP:
                self.clock.host_stepped(stamp, HostNs(arrival))
                continue
            if kind == SLEW:
                self.clock.host_slewed(stamp, HostNs(arrival))
                continue
            if seq < 40 and arrival - boots[kind] > 400_000_000:
                yield from (item for _, item in orders[kind].restart())
            boots[kind] = arrival
            yield from (item for _, item in orders[kind].push(seq, event))


def observe_imu(clock: DeviceClock, seq: int, stamp: int, arrival: int) -> int | None:
    """Give a clock one IMU packet."""
    return clock.observe(Stream.IMU, seq, DeviceNs(stamp), HostNs(arrival))
