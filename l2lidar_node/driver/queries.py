"""Decides what a device is asked, and when."""

from __future__ import annotations

from typing import Final

from l2lidar_node.protocol import commands
from l2lidar_node.protocol.commands import Command
from l2lidar_node.types import HostNs

QUERY_NS: Final = 1_000_000_000  # interval of version, parameter and latency requests
_FIRST_ID: Final = 100


class Queries:
    """What is asked of a device without anybody's wish.

    Parameters
    ----------
    with_latency : bool
        Whether the round trip is measured, too.
    """

    def __init__(self, with_latency: bool) -> None:
        self._with_latency = with_latency
        self._next = HostNs(0)
        self._latency_id = _FIRST_ID

    def due(self, now: HostNs, *, version: bool, parameters: bool) -> list[Command]:
        """Return what is to be asked now; ``version``, ``parameters``: whether they are known."""
        if 0 <= self._next - now <= QUERY_NS:
            return []
        self._next = HostNs(now + QUERY_NS)
        due: list[Command] = []
        if not version:
            due.append(commands.request_version())
        if not parameters:
            due.append(commands.request_parameters())
        if self._with_latency:
            self._latency_id += 1
            due.append(commands.latency(self._latency_id))
        return due
