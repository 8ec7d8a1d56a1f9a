"""Defers point packets that nothing depends on yet, to handle many of them together.

After a pause of some milliseconds the caches are cold: the first packet takes five times as long
as the tenth. An IMU sample is needed at once; a point packet has no effect before its sweep is
complete.
"""

from __future__ import annotations

import struct
from typing import Final

from l2lidar_node.clock.cadence import Cadence
from l2lidar_node.driver.reorder import REORDER_NS, Timed
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.packets import NS, PointPacket
from l2lidar_node.types import Datagram, DeviceNs, HostNs, new_tuple

MOST: Final = 64
"""Largest number of deferred packets."""

_NUMBERS: Final = struct.Struct("<I4xII")  # sequence number, seconds and nanoseconds of the stamp
_HEADERS: Final = {
    int(kind): wire.HEADER.pack(wire.MAGIC, kind, wire.FRAME_SIZES[kind])
    for kind in (wire.PacketType.POINTS_3D, wire.PacketType.POINTS_2D)
}


class DeferredPoints:
    """Datagrams, each with the packet of points that is the next one by number.

    Attributes
    ----------
    waiting : list of Datagram
        In arrival order; read only.
    newest : HostNs
        Arrival of the last one.
    until : int
        Stamp from which on an IMU sample must wait for the deferred packets [ns].
    due : HostNs
        When the packet that must not be deferred is expected; 0 if none may be deferred.
    """

    __slots__ = (
        "_cadence",
        "_header",
        "_left",
        "_next",
        "_stamp",
        "due",
        "newest",
        "until",
        "waiting",
    )

    def __init__(self) -> None:
        self.waiting: list[Datagram] = []
        self.newest = self.due = HostNs(0)
        self.until = 0
        self._header = b""
        self._next = self._left = self._stamp = 0
        self._cadence = Cadence(0.0)

    def begin(
        self, last: Timed, left: int, due: HostNs, until: DeviceNs, cadence: Cadence
    ) -> None:
        """Put off what follows a packet from now on.

        Parameters
        ----------
        last : Timed
            The last packet of points that was handled.
        left : int
            Packets after it of which the last one may not be put off.
        due : HostNs
            When that one is expected.
        until : DeviceNs
            Stamp up to which it does not matter which stream comes first.
        cadence : Cadence
            That of the points at the last packet: where it does not predict one, order matters.
        """
        packet, arrival = last
        assert isinstance(packet, PointPacket)
        self._header = _HEADERS[packet.packet_type]
        self._next = packet.seq + 1
        self._stamp = packet.stamp
        self._cadence = cadence
        self._left = min(left - 1, MOST)
        self.newest, self.due, self.until = arrival, due, until

    def takes(self, data: bytes, arrival: HostNs) -> bool:
        """Put off a datagram of the size of a packet of points, if it can be; return whether.

        It is still to be found out whether it is damaged.
        """
        if not self._left:
            return False
        seq, seconds, nanoseconds = _NUMBERS.unpack_from(data, wire.HEADER.size)
        stamp = seconds * NS + nanoseconds
        if (
            seq != self._next
            or stamp <= self._stamp
            or arrival - self.newest > REORDER_NS
            or not data.startswith(self._header)
        ):
            return False
        if stamp >= self.until or not self._cadence.follows(seq, stamp - self._stamp):
            self.until = 0
        self.waiting.append(new_tuple(Datagram, (data, arrival)))
        self._next = seq + 1
        self._stamp = stamp
        self._left -= 1
        self.newest = arrival
        return True

    def taken(self) -> list[Datagram]:
        """Return the deferred packets; defer no more until :meth:`begin`."""
        self._left = 0
        self.due = HostNs(0)
        waiting, self.waiting = self.waiting, []
        return waiting
