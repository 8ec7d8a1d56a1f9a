"""The way to the host: passes datagrams through the faults and delivers them in time."""

from __future__ import annotations

import heapq
from collections.abc import Sequence

from l2lidar_node.emulator.link.datagram import Datagram
from l2lidar_node.emulator.link.faults import Stage
from l2lidar_node.emulator.truth.packet_log import Ledger


class Path:
    """Carries datagrams through stages and keeps those whose time has not come.

    Parameters
    ----------
    stages : sequence of Stage
        Passed in this order.
    ledger : Ledger
        Learns what reaches the host.
    """

    def __init__(self, stages: Sequence[Stage], ledger: Ledger) -> None:
        self._stages = stages
        self._ledger = ledger
        self._waiting: list[tuple[int, int, Datagram]] = []
        self._count = 0

    @property
    def next_ns(self) -> int | None:
        """True instant at which the next datagram arrives; None when none is on its way."""
        return self._waiting[0][0] if self._waiting else None

    def send(self, datagrams: Sequence[Datagram], now_ns: int) -> None:
        """Put datagrams on their way, one whole packet each, in order of time.

        Call it also with none as time goes by: a stage may hold something back.
        """
        for stage in self._stages:
            datagrams = stage(datagrams, now_ns)
        for datagram in datagrams:
            heapq.heappush(self._waiting, (datagram.time_ns, self._count, datagram))
            self._count += 1

    def arrivals(self, now_ns: int) -> list[Datagram]:
        """Return what arrives until a true instant and was not returned yet, in order of time."""
        out: list[Datagram] = []
        while self._waiting and self._waiting[0][0] <= now_ns:
            out.append(heapq.heappop(self._waiting)[2])
        self._ledger.arrived(out)
        return out
