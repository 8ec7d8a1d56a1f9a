"""What travels from the unit to the host: bytes, when, and which packets they are part of."""

from __future__ import annotations

from typing import NamedTuple

from l2lidar_node.protocol import wire

JUNK = -1
"""``row`` of bytes that belong to no packet."""


class Piece(NamedTuple):
    """Consecutive bytes of one packet inside a datagram.

    Attributes
    ----------
    row : int
        Row of the packet in the packet log, or :data:`JUNK`.
    start, stop : int
        Which bytes of the packet these are.
    size : int
        Bytes of the whole packet as it was sent.
    intact : bool
        Whether these bytes are as the unit made them.
    """

    row: int
    start: int
    stop: int
    size: int
    intact: bool = True


class Datagram(NamedTuple):
    """Bytes that travel together.

    Attributes
    ----------
    time_ns : int
        True instant at which they leave the unit or, further down the path, reach the host.
    data : bytes
    pieces : tuple of Piece
        The packets in it, in the order of the bytes; their lengths add up to that of ``data``.
    """

    time_ns: int
    data: bytes
    pieces: tuple[Piece, ...]

    def cut(self, at: int) -> tuple[Datagram, Datagram]:
        """Return the first ``at`` bytes and the rest as two datagrams of the same time."""
        head: list[Piece] = []
        tail: list[Piece] = []
        offset = 0
        for piece in self.pieces:
            inside = min(max(at - offset, 0), piece.stop - piece.start)
            middle = piece.start + inside
            if inside > 0:
                head.append(piece._replace(stop=middle))
            if middle < piece.stop:
                tail.append(piece._replace(start=middle))
            offset += piece.stop - piece.start
        return (
            self._replace(data=self.data[:at], pieces=tuple(head)),
            self._replace(data=self.data[at:], pieces=tuple(tail)),
        )

    def join(self, later: Datagram) -> Datagram:
        """Return one datagram with the bytes of both at the time of the later one."""
        return Datagram(later.time_ns, self.data + later.data, self.pieces + later.pieces)

    def fragments(self) -> list[Datagram]:
        """Return datagrams of at most :data:`wire.MAX_DATAGRAM` bytes."""
        parts = []
        rest = self
        while len(rest.data) > wire.MAX_DATAGRAM:
            part, rest = rest.cut(wire.MAX_DATAGRAM)
            parts.append(part)
        return [*parts, rest]
