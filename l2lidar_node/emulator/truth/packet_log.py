"""The truth about every packet: when it was measured, how it traveled, what became of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from enum import IntFlag, auto
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

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


PACKET: Final = np.dtype(
    [
        ("type", "<u2"),  # wire.PacketType
        ("boot", "<u2"),  # restarts before this packet
        ("copies", "<u2"),  # how often it reached the host whole and undamaged
        ("faults", "<u4"),  # bits of Fault that touched it
        ("seq", "<u4"),  # as on the wire; 0 for answers
        ("ordinal", "<i8"),  # counts the packets of its type, over restarts
        ("index", "<i8"),  # index in the source of measurements; -1 for answers
        ("stamp_ns", "<i8"),  # [ns] unit's clock; 0 for answers
        ("start_ns", "<i8"),  # [ns] true instant that the stamp marks
        ("left_ns", "<i8"),  # [ns] true instant at which it left the unit
        (
            "arrived_ns",
            "<i8",
        ),  # [ns] true instant at which its last byte reached the host first; -1
    ]
)
"""One packet the unit sent; with ``copies == 0`` it was destroyed or is still on its way."""


class Fault(IntFlag):
    """What can go wrong; names are those of the settings."""

    BAD_CRC = auto()
    TRUNCATE = auto()
    HOSTILE_SIZE = auto()
    HOSTILE_COUNT = auto()
    NAN = auto()
    GARBAGE = auto()
    COALESCE = auto()
    SPLIT = auto()
    LOSS = auto()
    COMMAND_LOSS = auto()
    DUPLICATE = auto()
    SILENCE = auto()
    JITTER = auto()
    BURST = auto()
    REORDER = auto()
    REBOOT = auto()
    CLOCK_STEP = auto()
    FOREIGN_SYNC = auto()


class FaultEvent(NamedTuple):
    """One fault that happened; type 0 and ordinal -1 when it hit no packet in particular."""

    time_ns: int
    fault: Fault
    packet_type: int
    ordinal: int


class PacketLog:
    """Books every packet when it leaves the unit and again when it reaches the host.

    A packet has arrived when its bytes reached the host undamaged, one after the other and with
    nothing in between: a reader of a byte stream needs that and no more. One that also uses the
    boundaries of datagrams may recover a few others.

    Parameters
    ----------
    keep : int or None
        How many of the latest packets and events to remember; None for all (105 MB an hour).

    Attributes
    ----------
    counts : Counter
        How often each fault happened.
    """

    def __init__(self, keep: int | None = None) -> None:
        self._keep = keep
        self._rows = np.zeros(1024, PACKET)
        self._count = 0
        self._dropped = 0
        self._events: list[FaultEvent] = []
        self._cursor = (JUNK, 0)
        self.counts: Counter[Fault] = Counter()

    @property
    def packets(self) -> NDArray[np.void]:
        """The packets booked so far, shape (N,), dtype PACKET, in the order in which they left."""
        view = self._rows[: self._count].view()
        view.flags.writeable = False
        return view

    @property
    def events(self) -> Sequence[FaultEvent]:
        """The faults that happened so far, in order."""
        return tuple(self._events)

    def of_type(self, packet_type: int) -> NDArray[np.void]:
        """Return the packets of one type in the order of their ordinals."""
        return np.asarray(self.packets[self.packets["type"] == packet_type])

    def book(self, packets: NDArray[np.void]) -> int:
        """Add packets that leave the unit and return the row of the first."""
        if self._keep is not None and self._count > 2 * self._keep:
            self._forget(self._count - self._keep)
        needed = self._count + len(packets)
        if needed > len(self._rows):
            self._rows = np.concatenate(
                [self._rows, np.zeros(max(needed, len(self._rows)), PACKET)]
            )
        self._rows[self._count : needed] = packets
        first = self._count + self._dropped
        self._count = needed
        return first

    def note(self, time_ns: int, fault: Fault, datagram: Datagram | None = None) -> None:
        """Log a fault and mark the packets that it touched."""
        self.counts[fault] += 1
        rows = {piece.row for piece in datagram.pieces if piece.row != JUNK} if datagram else set()
        for row in sorted(rows):
            at = row - self._dropped
            if at >= 0:
                self._rows["faults"][at] |= fault
                packet = self._rows[at]
                self._events.append(
                    FaultEvent(time_ns, fault, int(packet["type"]), int(packet["ordinal"]))
                )
        if not rows:
            self._events.append(FaultEvent(time_ns, fault, 0, -1))

    def arrived(self, datagrams: Iterable[Datagram]) -> None:
        """Take note of datagrams that reach the host, in the order in which they do."""
        for datagram in datagrams:
            for row, start, stop, size, intact in datagram.pieces:
                follows = start == 0 or self._cursor == (row, start)
                self._cursor = (row, stop) if follows and intact else (JUNK, 0)
                if follows and intact and stop == size and row >= self._dropped:
                    self._whole(row - self._dropped, datagram.time_ns)

    def _whole(self, at: int, time_ns: int) -> None:
        if self._rows["copies"][at] == 0:
            self._rows["arrived_ns"][at] = time_ns
        self._rows["copies"][at] += 1

    def _forget(self, count: int) -> None:
        self._rows[: self._count - count] = self._rows[count : self._count].copy()
        self._count -= count
        self._dropped += count
        if self._keep is not None:
            del self._events[: -self._keep]
