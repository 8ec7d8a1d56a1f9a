"""The truth of a run: exact clouds and trajectories, packet log, and their files."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.emulator.motion import tum
from l2lidar_node.emulator.motion.motion import Motion
from l2lidar_node.emulator.truth.packet_log import Fault, FaultEvent, PacketLog
from l2lidar_node.emulator.unit.scanner import Scan
from l2lidar_node.files import write_whole
from l2lidar_node.protocol.wire import WorkMode


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
        noise-free surface points of the beams' centre rays.

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
