"""Numbers, stamps and books the packets that leave a unit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.link.datagram import Datagram, Piece
from l2lidar_node.emulator.truth.packet_log import PACKET, Ledger
from l2lidar_node.emulator.unit.clock import UnitClock
from l2lidar_node.emulator.unit.stream import SEQ_MODULUS, Due, finish
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType

_Batch = tuple[NDArray[np.void], list[bytes]]  # rows of the ledger and their frames


class Reply(NamedTuple):
    """An answer that leaves the unit at a true instant."""

    leaves_ns: int
    packet_type: PacketType
    payload: bytes


class Outbox:
    """Makes datagrams of what is due, one packet each.

    Parameters
    ----------
    clock : UnitClock
        Makes the stamps.
    ledger : Ledger
        Learns of every packet.

    Attributes
    ----------
    sent : Counter
        Packets so far by type, over restarts.
    """

    def __init__(self, clock: UnitClock, ledger: Ledger) -> None:
        self._clock = clock
        self._ledger = ledger
        self._seq: Counter[PacketType] = Counter()
        self._boots = 0
        self.sent: Counter[PacketType] = Counter()

    def restart(self) -> None:
        """Begin with sequence number 0 again."""
        self._seq.clear()
        self._boots += 1

    def send(
        self, measured: Sequence[tuple[PacketType, Due]], replies: Sequence[Reply]
    ) -> list[Datagram]:
        """Return the datagrams of measurements and answers in the order of leaving."""
        batches = [self._measured(*item) for item in measured]
        batches += [self._replied(item) for item in replies]
        if not batches:
            return []
        packets, frames = batches[0] if len(batches) == 1 else _merged(batches)
        first = self._ledger.book(packets)
        times = packets["left_ns"].tolist()
        return [
            Datagram(time_ns, frame, (Piece(row, 0, len(frame), len(frame)),))
            for row, (time_ns, frame) in enumerate(zip(times, frames, strict=True), first)
        ]

    def _measured(self, packet_type: PacketType, due: Due) -> _Batch:
        packets = self._packets(packet_type, len(due.frames))
        packets["seq"] = (self._seq[packet_type] + np.arange(len(packets))) % SEQ_MODULUS
        self._seq[packet_type] += len(packets)
        packets["index"] = due.numbers
        packets["stamp_ns"] = self._clock.stamps(due.start_ns)
        packets["start_ns"] = due.start_ns
        packets["left_ns"] = due.left_ns
        return packets, finish(due, packet_type, packets["seq"], packets["stamp_ns"])

    def _replied(self, reply: Reply) -> _Batch:
        packets = self._packets(reply.packet_type, 1)
        packets["start_ns"] = packets["left_ns"] = reply.leaves_ns
        packets["index"] = -1
        return packets, [wire.encode_frame(reply.packet_type, reply.payload)]

    def _packets(self, packet_type: PacketType, count: int) -> NDArray[np.void]:
        packets = np.zeros(count, PACKET)
        packets["type"] = packet_type
        packets["boot"] = self._boots
        packets["ordinal"] = self.sent[packet_type] + np.arange(count)
        packets["arrived_ns"] = -1
        self.sent[packet_type] += count
        return packets


def _merged(batches: Sequence[_Batch]) -> _Batch:
    packets = np.concatenate([batch for batch, _ in batches])
    frames = [frame for _, batch in batches for frame in batch]
    order = np.argsort(packets["left_ns"], kind="stable")
    return packets[order], [frames[at] for at in order.tolist()]
