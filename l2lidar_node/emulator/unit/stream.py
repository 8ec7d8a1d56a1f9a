"""Measurement streams: sources, schedule and transmission.

Without a world, for tests of load and clock, they come from a shell seen standing still.
"""

from __future__ import annotations

import math
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.truth import PACKET, Datagram, PacketLog, Piece
from l2lidar_node.emulator.unit.firmware import CALIBRATION, RANGE_MAX_M, RANGE_MIN_M, UnitClock
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType, WorkMode

_HEAD_PERIOD_S: Final = 0.229769
_WIDE_START_RAD: Final = -0.105  # of the mirror; 192 degrees instead of 180
_STATE: Final = (4639, 229769, 0.0, 0.0, 0.0, 43.7, 154.16, 51.38, 60.8)
"""Inside state of a published unit, in the order of :data:`wire.INSIDE_STATE`."""


class PatternScanner:
    """Points on a shell of 3 m radius with bars every 15 degrees, 4 % without return.

    Parameters
    ----------
    wide : bool
        Field of view of 192 instead of 180 degrees.
    flat : bool
        2D packets instead of 3D ones: one plane, no head angle.
    empty : bool
        No slot returns anything.
    """

    def __init__(self, wide: bool = False, flat: bool = False, empty: bool = False) -> None:
        self._flat = flat
        dtype = wire.POINTS_2D_PAYLOAD if flat else wire.POINTS_3D_PAYLOAD
        slots = wire.POINTS_PER_2D_PACKET if flat else wire.POINTS_PER_3D_PACKET
        self._period_s = wire.PERIOD_2D_S if flat else wire.MIRROR_PERIOD_S
        start = _WIDE_START_RAD if wide else 0.0
        row = np.zeros(1, dtype)
        row["state"] = _STATE
        row["calibration"] = CALIBRATION
        row["scan_period"] = self._period_s
        row["range_min"], row["range_max"] = RANGE_MIN_M, RANGE_MAX_M
        row["angle_min"] = start
        row["angle_increment"] = (math.pi - 2.0 * start) / slots
        row["time_increment"] = self._period_s / (2 * slots)
        row["point_num"] = slots
        slot = np.arange(slots)
        raw = 365.625 + (3.0 + 0.05 * ((slot * 12 // slots) % 2)) / 0.000978
        row["ranges"] = 0 if empty else np.where(slot % 25 == 24, 0, np.rint(raw))
        row["intensities"] = 60 + 120 * slot // slots
        if not flat:
            row["com_horizontal_angle_step"] = (
                2.0 * math.pi * row["time_increment"] / _HEAD_PERIOD_S
            )
        self._row = row

    def packets(self, first: int, count: int) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        """Return packets and their start times; see :class:`sources.Source`."""
        t_s = np.arange(first, first + count, dtype=np.float64) * self._period_s
        payloads = np.repeat(self._row, count)
        if not self._flat:
            angle = 2.0 * math.pi * t_s / _HEAD_PERIOD_S
            payloads["com_horizontal_angle_start"] = np.mod(angle, 2.0 * math.pi)
        return payloads, np.asarray(t_s)


class StillInertial:
    """Samples of an IMU that lies level and still, without noise."""

    def samples(self, first: int, count: int) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        """Return samples and their times; see :class:`sources.Source`."""
        payloads = np.zeros(count, wire.IMU_PAYLOAD)
        payloads["quaternion_wxyz"] = (wire.QUATERNION_NORM, 0.0, 0.0, 0.0)
        payloads["linear_acceleration"] = (0.0, 0.0, 9.81)
        return payloads, np.asarray(np.arange(first, first + count) / wire.IMU_RATE_HZ)


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
    """Source and schedule of a stream.

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


class Due(NamedTuple):
    """Consecutive packets that are due, arrays of the same length.

    Attributes
    ----------
    frames : ndarray, shape (N,)
        Whole frames; sequence number, stamp and CRC are still missing.
    numbers : ndarray, shape (N,), int64
        Index in the source.
    start_ns, left_ns : ndarray, shape (N,), int64
        True instants of the stamp and of leaving the unit.
    """

    frames: NDArray[np.void]
    numbers: NDArray[np.int64]
    start_ns: NDArray[np.int64]
    left_ns: NDArray[np.int64]

    def part(self, first: int, stop: int) -> Due:
        """Return the packets ``first`` to ``stop - 1``."""
        cut = slice(first, stop)
        return Due(self.frames[cut], self.numbers[cut], self.start_ns[cut], self.left_ns[cut])


class MeasurementStream:
    """Yields the packets of one feed at the times at which they leave the unit.

    Parameters
    ----------
    feed : Feed
    origin_ns : int
        True instant that is zero on the source's time line.
    delay_ns : int
        From the last measurement in a packet to its leaving.
    from_ns : int
        The first packet is the first one whose stamp is not before this true instant.
    """

    def __init__(self, feed: Feed, origin_ns: int, delay_ns: int, from_ns: int) -> None:
        self._feed = feed
        self._origin_ns = origin_ns
        self._delay_ns = delay_ns
        self._at = 0
        self._load(0)
        self._seek(from_ns)

    @property
    def packet_type(self) -> PacketType:
        """Packet type of the frames."""
        return self._feed.packet_type

    @property
    def next_ns(self) -> int:
        """True instant at which the next packet leaves the unit."""
        return int(self._block.left_ns[self._at])

    def take(self, until_ns: int) -> Due:
        """Return the packets that leave the unit until a true instant and are not taken yet."""
        parts: list[Due] = []
        while self.next_ns <= until_ns:
            stop = int(np.searchsorted(self._block.left_ns, until_ns, side="right"))
            parts.append(self._block.part(self._at, stop))
            self._at = stop
            if stop == self._feed.block:
                self._load(self._number + 1)
                self._at = 0
        if len(parts) == 1:
            return parts[0]
        parts = parts or [self._block.part(0, 0)]
        return Due(
            np.concatenate([part.frames for part in parts]),
            np.concatenate([part.numbers for part in parts]),
            np.concatenate([part.start_ns for part in parts]),
            np.concatenate([part.left_ns for part in parts]),
        )

    def _seek(self, from_ns: int) -> None:
        """Find the first packet not before an instant; the blocks themselves tell the period."""
        while True:
            start = self._block.start_ns
            period = max((int(start[-1]) - int(start[0])) // max(len(start) - 1, 1), 1)
            jump = (from_ns - int(start[0])) // (period * self._feed.block)
            if abs(jump) <= 1 or self._number + jump < 0:
                break
            self._load(self._number + jump)
        while from_ns < self._block.start_ns[0] and self._number > 0:
            self._load(self._number - 1)
        while from_ns > self._block.start_ns[-1]:
            self._load(self._number + 1)
        self._at = int(np.searchsorted(self._block.start_ns, from_ns, side="left"))

    def _load(self, number: int) -> None:
        feed = self._feed
        payloads, t_s = feed.source(number * feed.block, feed.block)
        start_ns = self._origin_ns + np.rint(np.asarray(t_s) * 1e9).astype(np.int64)
        lasts_ns = _duration_ns(payloads)
        numbers = np.arange(number * feed.block, (number + 1) * feed.block, dtype=np.int64)
        left_ns = start_ns + lasts_ns + self._delay_ns
        self._number = number
        self._block = Due(_frames(feed.packet_type, payloads), numbers, start_ns, left_ns)


def finish(
    due: Due, packet_type: PacketType, seq: NDArray[np.int64], stamp_ns: NDArray[np.int64]
) -> list[bytes]:
    """Fill in sequence numbers, stamps and CRCs and return the frames as bytes."""
    info = due.frames["payload"]["info"]
    info["seq"] = seq
    info["sec"], info["nsec"] = np.divmod(stamp_ns, 1_000_000_000)
    size = wire.FRAME_SIZES[packet_type]
    raw = due.frames.view(np.uint8).reshape(-1, size)
    due.frames["crc"] = [zlib.crc32(row[wire.HEADER.size : -wire.TAIL.size].data) for row in raw]
    return [row.tobytes() for row in raw]


def _duration_ns(payloads: NDArray[np.void]) -> NDArray[np.int64]:
    """Return the true time from a packet's first to its last measurement, shape (N,)."""
    names = payloads.dtype.names or ()
    if "time_increment" not in names:
        return np.zeros(len(payloads), np.int64)
    slots = payloads["point_num"].astype(np.float64) - 1.0
    return np.asarray(np.rint(slots * payloads["time_increment"] * 1e9), dtype=np.int64)


def _frames(packet_type: PacketType, payloads: NDArray[np.void]) -> NDArray[np.void]:
    layout = np.dtype(
        [
            ("magic", "u1", (4,)),
            ("type", "<u4"),
            ("size", "<u4"),
            ("payload", payloads.dtype),
            ("crc", "<u4"),
            ("unused", "u1", (6,)),
            ("end", "u1", (2,)),
        ]
    )
    frames = np.zeros(len(payloads), layout)
    frames["magic"] = np.frombuffer(wire.MAGIC, np.uint8)
    frames["type"] = packet_type
    frames["size"] = layout.itemsize
    frames["payload"] = payloads
    frames["payload"]["info"]["payload_size"] = payloads.dtype.itemsize
    frames["end"] = np.frombuffer(wire.TAIL_END, np.uint8)
    return frames


_Batch = tuple[NDArray[np.void], list[bytes]]  # rows of the packet log and their frames


class Reply(NamedTuple):
    """An answer that leaves the unit at a true instant."""

    leaves_ns: int
    packet_type: PacketType
    payload: bytes


class Outbox:
    """Makes datagrams from due packets, one each.

    Parameters
    ----------
    clock : UnitClock
        Makes the stamps.
    packet_log : PacketLog
        Learns of every packet.

    Attributes
    ----------
    sent : Counter
        Packets so far by type, over restarts.
    """

    def __init__(self, clock: UnitClock, packet_log: PacketLog) -> None:
        self._clock = clock
        self._packet_log = packet_log
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
        first = self._packet_log.book(packets)
        times = packets["left_ns"].tolist()
        return [
            Datagram(time_ns, frame, (Piece(row, 0, len(frame), len(frame)),))
            for row, (time_ns, frame) in enumerate(zip(times, frames, strict=True), first)
        ]

    def _measured(self, packet_type: PacketType, due: Due) -> _Batch:
        packets = self._packets(packet_type, len(due.frames))
        packets["seq"] = (self._seq[packet_type] + np.arange(len(packets))) % wire.SEQ_MODULUS
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
