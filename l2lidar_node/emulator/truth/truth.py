"""States what an ideal sensor would have measured: exact clouds and exact trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.motion import tum
from l2lidar_node.emulator.motion.motion import Motion
from l2lidar_node.emulator.motion.spline import rotation_matrices
from l2lidar_node.emulator.unit.scanner import Scan
from l2lidar_node.files import write_whole


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
    moved: NDArray[np.float64] = (points - position[0]) @ rotation_matrices(quaternion)[0]
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
