"""A fixed load beside which others are measured: what a packet's checksum and view cost.

The speed of a machine swings from day to day, and with what else runs on it, by half. A figure in
units of this load, both measured in alternation, hardly does.
"""

from __future__ import annotations

import statistics
import time
import zlib
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from l2lidar_node.protocol import wire

_PACKET: Final = (bytes(range(256)) * 5)[: wire.FRAME_SIZES[wire.PacketType.POINTS_3D]]
_LAYOUT: Final = np.dtype(np.uint8)
_ROUND: Final = 20_000


class Relative(NamedTuple):
    """A rate of packets, and the reference load's beside it.

    Attributes
    ----------
    rate : float
        Median [packets per CPU s].
    ratio : float
        Median of the ratios to the reference load's rate that was measured next to each.
    low, high : float
        The smallest and the largest of these.
    """

    rate: float
    ratio: float
    low: float
    high: float


def packets_per_cpu_s(packets: int = _ROUND) -> float:
    """Return how many packets per CPU second this load takes: their CRC-32 and a view."""
    begin = time.process_time()
    for _ in range(packets):
        zlib.crc32(_PACKET)
        np.frombuffer(_PACKET, _LAYOUT)
    return packets / (time.process_time() - begin)


def checksums_per_cpu_s(packets: int = 5 * _ROUND) -> float:
    """Return how many CRC-32 of a packet of points zlib makes in a CPU second."""
    begin = time.process_time()
    for _ in range(packets):
        zlib.crc32(_PACKET)
    return packets / (time.process_time() - begin)


def relative(
    measure: Callable[[], float],
    rounds: int,
    reference: Callable[[], float] = packets_per_cpu_s,
) -> Relative:
    """Measure a rate [packets per CPU s] some times, the reference load before and after each."""
    rates, ratios = [], []
    before = reference()
    for _ in range(rounds):
        rate = measure()
        after = reference()
        rates.append(rate)
        ratios.append(2.0 * rate / (before + after))
        before = after
    return Relative(statistics.median(rates), statistics.median(ratios), min(ratios), max(ratios))
