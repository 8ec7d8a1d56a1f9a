"""Puts the measurements of both streams into order and tells when none need be waited for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

from l2lidar_node.driver.device import SILENCE_NS
from l2lidar_node.driver.sequence import SequenceCounts, SequenceOrder
from l2lidar_node.protocol.packets import ImuPacket, PointPacket
from l2lidar_node.types import HostNs, Stream

REORDER_NS: Final = 60_000_000  # a packet waits at most this long for an earlier one
RESTART_NS: Final = 1_000_000_000  # device stamps that fall by more than this began anew

_FEW: Final = 8  # packets that may be late in a row


class Timed(NamedTuple):
    """A packet with its arrival."""

    packet: PointPacket | ImuPacket
    arrival: HostNs


Released = list[tuple[int, Timed]]
"""Packets in order, each with how many are missing just before it."""


@dataclass(slots=True)
class _Lane:
    """What is known of one stream."""

    order: SequenceOrder[Timed]
    newest: PointPacket | ImuPacket | None = None
    arrival: int = 0  # [ns] of the packet that came last
    fallen: int = 0  # packets in a row whose stamps fell


class Intake:
    """The packets of both streams on their way from arrival to use.

    Parameters
    ----------
    window : int
        How many packets of a stream may wait for a missing earlier one.
    """

    def __init__(self, window: int) -> None:
        self._points = _Lane(SequenceOrder(window))
        self._imu = _Lane(SequenceOrder(window))
        self._lanes = {Stream.POINTS: self._points, Stream.IMU: self._imu}

    @property
    def counts(self) -> dict[Stream, SequenceCounts]:
        """What the sequence numbers say, by stream; goes on counting."""
        return {stream: lane.order.counts for stream, lane in self._lanes.items()}

    def follows(self, stream: Stream, packet: PointPacket | ImuPacket, arrival: HostNs) -> bool:
        """Take a packet that comes just after the one before, as nearly all do.

        Returns whether it did. Others are for :meth:`begins_anew` and :meth:`push`, which would
        treat this one alike.
        """
        lane = self._lanes[stream]
        if (
            lane.newest is None
            or packet.stamp < lane.newest.stamp
            or arrival - lane.arrival > SILENCE_NS
            or not lane.order.follows(packet.seq)
        ):
            return False
        lane.newest = packet
        lane.arrival = arrival
        lane.fallen = 0
        return True

    def begins_anew(
        self, stream: Stream, packet: PointPacket | ImuPacket, arrival: HostNs
    ) -> bool:
        """Tell whether the device restarted before it measured this.

        Its stamps fall then. Those of packets that are late do so too where the device's clock was
        just set, but their numbers are earlier, they are few, and they come in company of later
        ones: after a pause nothing is late. An earlier number with a later stamp is not late
        either.
        """
        lane = self._lanes[stream]
        newest = lane.newest
        if newest is None:
            return False
        fall = newest.stamp - packet.stamp
        if fall > RESTART_NS:
            lane.fallen += 1
            is_alone = arrival - lane.arrival > REORDER_NS
            is_many = lane.fallen > _FEW
            return is_alone or is_many or not lane.order.is_earlier(packet.seq, newest.seq)
        lane.fallen = 0
        if fall >= 0 or packet.seq > newest.seq:
            return False
        is_fresh = arrival - lane.arrival <= SILENCE_NS
        return is_fresh and lane.order.is_earlier(packet.seq, newest.seq)

    def restart(self, stream: Stream) -> Released:
        """Return what waits; the next packet of the stream is in order, whatever its number."""
        lane = self._lanes[stream]
        lane.newest = None
        lane.fallen = 0
        return lane.order.restart()

    def push(self, stream: Stream, packet: PointPacket | ImuPacket, arrival: HostNs) -> Released:
        """Return what a packet releases."""
        lane = self._lanes[stream]
        order, newest, pause = lane.order, lane.newest, arrival - lane.arrival
        lane.arrival = arrival
        if newest is None or lane.fallen == 0:
            lane.newest = packet
        timed = Timed(packet, arrival)
        if newest is None:
            return order.restart() + order.push(packet.seq, timed)
        if pause > SILENCE_NS:
            return order.resume(packet.seq, timed)
        return order.push(packet.seq, timed)

    def is_flowing(self, until: HostNs) -> bool:
        """Tell whether points came a moment ago and nothing waits: so nothing can be overdue."""
        return (
            until - self._points.arrival <= REORDER_NS
            and not self._points.order.waiting
            and not self._imu.order.waiting
        )

    def is_overdue(self, until: HostNs) -> bool:
        """Tell whether :meth:`settle` would release anything."""
        return any(_overdue(lane.order, until) for lane in self._lanes.values())

    def settle(self, until: HostNs) -> Released:
        """Return what has waited for :data:`REORDER_NS`, nothing more having arrived by then."""
        released: Released = []
        for lane in self._lanes.values():
            while _overdue(lane.order, until):
                released += lane.order.give_up()
        return released

    def pause_ns(self, until: HostNs) -> int:
        """Return how long no points arrived; 0 before there were any."""
        return 0 if self._points.newest is None else until - self._points.arrival

    def flush(self) -> Released:
        """Return everything that waits."""
        return [item for lane in self._lanes.values() for item in lane.order.flush()]

    def forget(self) -> None:
        """Take the next packet of each stream for the first one."""
        for lane in self._lanes.values():
            lane.newest = None


def _overdue(order: SequenceOrder[Timed], until: HostNs) -> bool:
    oldest = order.oldest
    return oldest is not None and until - oldest.arrival > REORDER_NS
