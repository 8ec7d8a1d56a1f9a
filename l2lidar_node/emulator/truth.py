"""The truth of a run: every packet from measurement to arrival, exact clouds, trajectories.

:class:`PacketLog` holds when each packet was measured, how it traveled and what became of it.
"""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from enum import IntFlag, auto
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.emulator.motion.motion import Motion
from l2lidar_node.emulator.unit.scanner import Scan
from l2lidar_node.files import write_whole
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import WorkMode
from l2lidar_node.recording import tum

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
    """Kinds of faults, named as the settings."""

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
    """Logs every packet when it leaves the unit and when it reaches the host.

    A packet has arrived when its bytes reached the host undamaged, in sequence and with
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
        """Record datagrams that reach the host, in their order of arrival."""
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


def undistorted(
    scan: Scan, motion: Motion, reference_s: float, *, measured: bool = False
) -> NDArray[np.float64]:
    """Return the points of a scan as a sensor standing still at one instant would see them.

    Parameters
    ----------
    scan : Scan
        Packets of the sweep, see ``Scanner.scan``.
    motion : Motion
        The scanner's.
    reference_s : float
        The instant [s] on the motion's time line.
    measured : bool
        True: the measured points (range noise and quantisation included) at their true places, so
        a deskewed cloud differs from them by the error of the deskewing alone. False: the
        noise-free surface points of the beams' center rays.

    Returns
    -------
    ndarray, shape (P, N, 3)
        [m], cloud frame at ``reference_s``, in the order of packets and slots; NaN without a
        return (``measured``) or where there is no surface. ``scan.returned`` says which slots a
        driver sees.
    """
    return into_cloud(scan.measured_points if measured else scan.hits, motion, reference_s)


def into_cloud(
    points: NDArray[np.float64], motion: Motion, reference_s: float
) -> NDArray[np.float64]:
    """Return world points (..., 3) [m] in the cloud frame of the instant ``reference_s`` [s]."""
    position, quaternion = motion.poses(np.array([reference_s]))
    moved: NDArray[np.float64] = (points - position[0]) @ rotations.matrices(quaternion)[0]
    return moved


def write_tum(
    path: str | Path, motion: Motion, t_s: NDArray[np.float64], origin_ns: int = 0
) -> None:
    """Write the cloud frame's poses in the world at instants (N,) [s] as a TUM file.

    Parameters
    ----------
    path : str or Path
    motion : Motion
    t_s : ndarray, shape (N,)
        Instants on the motion's time line.
    origin_ns : int
        Stamp of the motion's time 0 [ns].
    """
    write_whole(Path(path), tum.render(motion.trajectory(t_s, origin_ns)))


TRUE_POINT: Final = np.dtype([("hit", "<f4", (3,)), ("measured", "<f4", (3,))])
"""One slot, world frame [m], NaN for none: the surface on the beam's axis, and the range as it was
measured (noise and quantisation included) at its true place."""

_POSES_PER_S: Final = 200
_PACKETS: Final = "packets.npy"
_FAULTS: Final = "faults.csv"
_TRAJECTORY: Final = "trajectory.tum"
_RUN: Final = "run.json"


class Results:
    """The truth of a run, read from the folder that the emulator wrote.

    Attributes
    ----------
    packets : ndarray, shape (N,), dtype PACKET
        Every packet in the order of leaving.
    faults : list of FaultEvent
        In order.
    run : dict
        ``settings``, ``power_on_ns``, and ``latency_ms``: how late packets left, as ``p50``,
        ``p99`` and ``max``.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.packets: NDArray[np.void] = np.load(folder / _PACKETS)
        self.run = json.loads((folder / _RUN).read_text(encoding="utf-8"))
        with (folder / _FAULTS).open(encoding="utf-8", newline="") as file:
            self.faults = [
                FaultEvent(
                    int(row["time_ns"]), Fault[row["fault"]], int(row["type"]), int(row["ordinal"])
                )
                for row in csv.DictReader(file)
            ]
        self._blocks: dict[tuple[WorkMode, int], NDArray[np.void]] = {}

    def trajectory(self) -> NDArray[np.void]:
        """Return the poses of the cloud frame in the world, dtype tum.POSE, host time."""
        return tum.load(self._folder / _TRAJECTORY)

    def points(self, index: NDArray[np.int64], mode: WorkMode) -> NDArray[np.void]:
        """Return the exact points of packets.

        Parameters
        ----------
        index : ndarray, shape (K,)
            As in ``packets["index"]``.
        mode : WorkMode
            Field of view and 2D bits that were in force.

        Returns
        -------
        ndarray, shape (K, N), dtype TRUE_POINT
            In the order of the slots.

        Raises
        ------
        KeyError
            If a packet was never measured in this run.
        """
        starts = sorted(
            int(path.stem.split("_")[1]) for path in self._folder.glob(f"points/{int(mode)}_*.npy")
        )
        block = np.searchsorted(starts, index, side="right") - 1
        return np.stack(
            [self._point(mode, starts, int(b), int(i)) for b, i in zip(block, index, strict=True)]
        )

    def _point(
        self, mode: WorkMode, starts: Sequence[int], block: int, index: int
    ) -> NDArray[np.void]:
        if block < 0:
            raise KeyError(f"no points of packet {index}")
        key = mode, starts[block]
        if key not in self._blocks:
            self._blocks[key] = np.load(self._folder / _points_name(*key))
        if index - starts[block] >= len(self._blocks[key]):
            raise KeyError(f"no points of packet {index}")
        return np.asarray(self._blocks[key][index - starts[block]])


def write_packet_log(folder: Path, packet_log: PacketLog, run: Mapping[str, object]) -> None:
    """Write packets, faults and the facts of the run; each file is complete or absent."""
    folder.mkdir(parents=True, exist_ok=True)
    _write_array(folder / _PACKETS, packet_log.packets)
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("time_ns", "fault", "type", "ordinal"))
    table.writerows((e.time_ns, e.fault.name, e.packet_type, e.ordinal) for e in packet_log.events)
    write_whole(folder / _FAULTS, text.getvalue().encode())
    write_whole(folder / _RUN, (json.dumps(run, indent=2) + "\n").encode())


def write_trajectory(folder: Path, motion: Motion, duration_s: float, origin_ns: int) -> None:
    """Write the poses from power-on on as a TUM file in host time, 200 a second."""
    t_s = np.arange(0.0, duration_s + 1.0 / _POSES_PER_S, 1.0 / _POSES_PER_S)
    write_whole(folder / _TRAJECTORY, tum.render(motion.trajectory(t_s, origin_ns)).encode())


def write_points(folder: Path, mode: WorkMode, scan: Scan) -> None:
    """Write the exact points of consecutive packets."""
    points = np.empty(scan.rays.shape, TRUE_POINT)
    points["hit"] = scan.hits
    points["measured"] = scan.measured_points
    path = folder / _points_name(mode, scan.first)
    path.parent.mkdir(parents=True, exist_ok=True)
    _write_array(path, points)


def _write_array(path: Path, array: NDArray[np.void]) -> None:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    write_whole(path, buffer.getvalue())


def _points_name(mode: WorkMode, first: int) -> str:
    return f"points/{int(mode)}_{first:09d}.npy"
