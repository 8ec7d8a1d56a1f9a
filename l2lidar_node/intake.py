"""Puts the measurements of both streams into order and tells when none need be waited for."""

from __future__ import annotations

from typing import Final, NamedTuple

from l2lidar_node.packets import ImuPacket, PointPacket
from l2lidar_node.sequence import SequenceCounts, SequenceOrder
from l2lidar_node.types import HostNs, Stream
from l2lidar_node.watchdog import SILENCE_NS

REORDER_NS: Final = 60_000_000  # a packet waits at most this long for an earlier one
RESTART_NS: Final = 1_000_000_000  # device stamps that fall by more than this began anew

_FEW: Final = 8  # packets that may be late in a row


class Timed(NamedTuple):
    """A packet with its arrival."""

    packet: PointPacket | ImuPacket
    arrival: HostNs


Released = list[tuple[int, Timed]]
"""Packets in order, each with how many are missing just before it."""


class Intake:
    """The packets of both streams on their way from arrival to use.

    Parameters
    ----------
    window : int
        How many packets of a stream may wait for a missing earlier one.
    """

    def __init__(self, window: int) -> None:
        self._orders = {stream: SequenceOrder[Timed](window) for stream in Stream}
        self._newest: dict[Stream, Timed] = {}
        self._fallen = dict.fromkeys(Stream, 0)

    @property
    def counts(self) -> dict[Stream, SequenceCounts]:
        """What the sequence numbers say, by stream; goes on counting."""
        return {stream: order.counts for stream, order in self._orders.items()}

    def begins_anew(
        self, stream: Stream, packet: PointPacket | ImuPacket, arrival: HostNs
    ) -> bool:
        """Tell whether the device restarted before it measured this.

        Its stamps fall then. Those of packets that are late do so too where the device's clock was
        just set, but their numbers are earlier, they are few, and they come in company of later
        ones: after a pause nothing is late. An earlier number with a later stamp is not late
        either.
        """
        newest = self._newest.get(stream)
        if newest is None:
            return False
        fall = newest.packet.stamp - packet.stamp
        if fall > RESTART_NS:
            self._fallen[stream] += 1
            is_alone = arrival - newest.arrival > REORDER_NS
            is_many = self._fallen[stream] > _FEW
            return is_alone or is_many or not self._is_earlier(stream, packet)
        self._fallen[stream] = 0
        if fall >= 0 or packet.seq > newest.packet.seq:
            return False
        return arrival - newest.arrival <= SILENCE_NS and self._is_earlier(stream, packet)

    def restart(self, stream: Stream) -> Released:
        """Return what waits; the next packet of the stream is in order, whatever its number."""
        self._newest.pop(stream, None)
        self._fallen[stream] = 0
        return self._orders[stream].restart()

    def push(self, stream: Stream, packet: PointPacket | ImuPacket, arrival: HostNs) -> Released:
        """Return what a packet releases."""
        order = self._orders[stream]
        newest = self._newest.get(stream)
        timed = Timed(packet, arrival)
        if newest is None or self._fallen[stream] == 0:
            self._newest[stream] = timed
        else:
            self._newest[stream] = newest._replace(arrival=arrival)
        if newest is None:
            return order.restart() + order.push(packet.seq, timed)
        if arrival - newest.arrival > SILENCE_NS:
            return order.resume(packet.seq, timed)
        return order.push(packet.seq, timed)

    def is_overdue(self, until: HostNs) -> bool:
        """Tell whether :meth:`settle` would release anything."""
        return any(_overdue(order, until) for order in self._orders.values())

    def settle(self, until: HostNs) -> Released:
        """Return what has waited for :data:`REORDER_NS`, nothing more having arrived by then."""
        released: Released = []
        for order in self._orders.values():
            while _overdue(order, until):
                released += order.give_up()
        return released

    def silence_ns(self, stream: Stream, until: HostNs) -> int:
        """Return how long nothing of a stream arrived; 0 before there was anything."""
        newest = self._newest.get(stream)
        return 0 if newest is None else until - newest.arrival

    def flush(self) -> Released:
        """Return everything that waits."""
        return [item for order in self._orders.values() for item in order.flush()]

    def _is_earlier(self, stream: Stream, packet: PointPacket | ImuPacket) -> bool:
        return self._orders[stream].is_earlier(packet.seq, self._newest[stream].packet.seq)

    def forget(self) -> None:
        """Take the next packet of each stream for the first one."""
        self._newest.clear()


def _overdue(order: SequenceOrder[Timed], until: HostNs) -> bool:
    oldest = order.oldest
    return oldest is not None and until - oldest.arrival > REORDER_NS
