"""Where measurements come from: by index, on a time line that starts at the first power-on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.unit.pattern import PatternScanner
from l2lidar_node.protocol.wire import PacketType, WorkMode

VIEW: Final = WorkMode.WIDE_FOV | WorkMode.MODE_2D
"""Bits of the work mode on which it depends what points there are."""

_POINTS_BLOCK: Final = 50  # 232 ms
_FLAT_BLOCK: Final = 10  # 200 ms
_IMU_BLOCK: Final = 50  # 200 ms


class Source(Protocol):
    """Measurements by index; the same index always means the same measurement."""

    def __call__(self, first: int, count: int) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        """Return payloads and the true instants of their stamps.

        Parameters
        ----------
        first, count : int
            Which measurements.

        Returns
        -------
        payloads : ndarray, shape (count,)
            Dtype of the packet's payload; ``info`` is left for the unit to fill in.
        t_s : ndarray, shape (count,), float64
            True seconds since power-on, strictly ascending with the index.
        """
        ...


class PointSource(Protocol):
    """Makes point packets; ``packets`` is a :class:`Source`."""

    def packets(self, first: int, count: int) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        """Return payloads and the true instants [s] of their first slots."""
        ...


class InertialSource(Protocol):
    """Makes IMU packets; ``samples`` is a :class:`Source`."""

    def samples(self, first: int, count: int) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        """Return payloads and their true sample times [s]."""
        ...


class Feed(NamedTuple):
    """Where a stream's measurements come from.

    Attributes
    ----------
    packet_type : PacketType
    source : Source
    block : int
        Measurements asked for at a time; requests always start at a multiple of it.
    """

    packet_type: PacketType
    source: Source
    block: int


def imu_feed(inertial: InertialSource) -> Feed:
    """Return the feed of the IMU."""
    return Feed(PacketType.IMU, inertial.samples, _IMU_BLOCK)


def point_feeds(
    scanner: PointSource, others: Mapping[WorkMode, PointSource]
) -> dict[WorkMode, Feed]:
    """Return the feed of points for each combination of the :data:`VIEW` bits.

    Parameters
    ----------
    scanner : PointSource
        3D, 180 degrees.
    others : mapping from WorkMode to PointSource
        The other combinations; a plain pattern stands in for what is missing.
    """
    sources = {WorkMode(0): scanner, **others}
    feeds = {}
    for bits in range(int(VIEW) + 1):
        mode = WorkMode(bits)
        flat = bool(mode & WorkMode.MODE_2D)
        source = sources.get(mode) or PatternScanner(bool(mode & WorkMode.WIDE_FOV), flat)
        packet_type = PacketType.POINTS_2D if flat else PacketType.POINTS_3D
        feeds[mode] = Feed(packet_type, source.packets, _FLAT_BLOCK if flat else _POINTS_BLOCK)
    return feeds
