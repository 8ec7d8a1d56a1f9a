"""Groups point packets into sweeps: by count, head angle or duration, never without bound."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.config import SweepConfig
from l2lidar_node.driver.geometry import Projector, RangeCalibration, RangeLimits
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.packets import NS, PointPacket
from l2lidar_node.types import HostNs, Sweep

MAX_GAP_NS: Final = 200_000_000  # a stream that stalled this long starts a new sweep
MAX_PACKETS: Final = 4000
_BACKWARDS_RAD: Final = 1.9 * math.pi  # a head that stands still seems to advance by this or more

Level = Callable[[list[HostNs]], NDArray[np.float64]]


class _Placed(NamedTuple):
    """A packet and where it stands in its sweep."""

    packet: PointPacket
    given: HostNs  # its start as it was pushed
    start: HostNs  # not before the end of the packet before


class SweepAssembler:
    """Collects packets with host stamps and makes a sweep of them when it is complete.

    Parameters
    ----------
    config : SweepConfig
        How sweeps are cut; may be replaced while running through :meth:`configure`.
    level : callable, optional
        Returns a rotation for the start of every packet of a sweep, by which its points are turned
        into a levelled frame: shape (P, 3, 3), NaN for packets that cannot be.

    Attributes
    ----------
    unlevelled : int
        Points left out because their packet could not be levelled.
    """

    def __init__(self, config: SweepConfig, level: Level | None = None) -> None:
        self.unlevelled = 0
        self._config = config
        self._level = level
        self._packets: list[_Placed] = []
        self._missing = 0
        self._projectors = {
            int(kind): Projector(kind)
            for kind in (wire.PacketType.POINTS_3D, wire.PacketType.POINTS_2D)
        }

    def configure(self, config: SweepConfig, level: Level | None) -> None:
        """Use other settings from the next packet on."""
        self._config = config
        self._level = level

    @property
    def is_collecting(self) -> bool:
        """Whether packets wait for their sweep to be complete."""
        return bool(self._packets)

    def push(self, packet: PointPacket, start: HostNs, missing: int = 0) -> list[Sweep]:
        """Add a packet and return the sweeps this completes: none, one or two.

        Parameters
        ----------
        packet : PointPacket
        start : HostNs
            Instant of its first slot.
        missing : int
            Packets the sequence numbers say are missing just before it.
        """
        sweeps: list[Sweep] = []
        placed = start
        if self._packets and self._starts_anew(packet, start):
            sweeps.append(self._finish())
        elif self._packets:
            # A correction of the clock, or stamps of arrival in a burst, must not let a packet
            # begin before the previous one ended.
            last = self._packets[-1]
            placed = HostNs(max(start, last.start + last.packet.duration_ns))
            self._missing += missing
        self._packets.append(_Placed(packet, start, placed))
        if self._is_full():
            sweeps.append(self._finish())
        return sweeps

    def flush(self) -> Sweep | None:
        """Return what has been collected so far as a sweep; None if that is nothing."""
        return self._finish() if self._packets else None

    def _starts_anew(self, packet: PointPacket, start: HostNs) -> bool:
        first, last = self._packets[0], self._packets[-1]
        if packet.packet_type != last.packet.packet_type:
            return True
        if start - last.given > MAX_GAP_NS or start < last.given:
            return True
        if self._config.cut == "packets":
            return False
        if self._config.cut == "duration" or packet.packet_type == wire.PacketType.POINTS_2D:
            return start - first.given >= self._config.duration_ms * 1_000_000
        period = 2 * math.pi if self._config.cut == "turn" else math.pi
        return _passes(last.packet.head_angle, packet.head_angle, period)

    def _is_full(self) -> bool:
        count = len(self._packets)
        if self._config.cut == "packets":
            return count >= max(self._config.packets, 1)
        return count >= MAX_PACKETS

    def _finish(self) -> Sweep:
        packets, self._packets = self._packets, []
        missing, self._missing = self._missing, 0
        starts = [placed.start for placed in packets]
        epoch = starts[0]
        config = self._config
        batch = self._projectors[packets[0].packet.packet_type].points(
            [placed.packet.payload for placed in packets],
            np.array([start - epoch for start in starts]) / NS,
            RangeLimits(config.range_min, config.range_max),
            RangeCalibration(config.range_scale, config.range_bias)
            if config.override_range_calibration
            else None,
            None if self._level is None else self._level(starts),
        )
        self.unlevelled += batch.left_out
        batch.points.flags.writeable = False
        last = packets[-1]
        return Sweep(
            start=HostNs(epoch + round(batch.first_s * NS)),
            end=HostNs(last.start + last.packet.duration_ns),
            points=batch.points,
            packets=len(packets),
            missing=missing,
        )


def _passes(before: float, after: float, period: float) -> bool:
    """Tell whether the head, which turns forwards, passed a multiple of ``period`` [rad] since.

    However many packets were lost in between, up to most of a turn.
    """
    before, after = before % (2 * math.pi), after % (2 * math.pi)
    if (after - before) % (2 * math.pi) > _BACKWARDS_RAD:
        return False
    return after < before or after // period > before // period
