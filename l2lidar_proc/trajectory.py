"""Keeps poses with their instants and writes them as the lines that evo and others read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs
from l2lidar_proc import rotations

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class StampedPose:
    """A pose at an instant.

    Attributes
    ----------
    stamp : HostNs
    pose : ndarray, shape (4, 4)
        Coordinates of the moving frame to those of the fixed one.
    """

    stamp: HostNs
    pose: F64


def tum(poses: list[StampedPose]) -> str:
    """Return the lines of a TUM file: seconds, x, y, z, then the quaternion as x, y, z, w."""
    lines = []
    for item in poses:
        seconds, rest = divmod(item.stamp, 1_000_000_000)
        w, x, y, z = rotations.from_matrix(item.pose[:3, :3]).tolist()
        numbers = " ".join(f"{value:.9f}" for value in (*item.pose[:3, 3].tolist(), x, y, z, w))
        # not through a float: seconds since 1970 would lose the last hundreds of nanoseconds
        lines.append(f"{seconds}.{rest:09d} {numbers}\n")
    return "".join(lines)


def kitti(poses: list[StampedPose]) -> str:
    """Return the lines of a KITTI file: the upper three rows of each pose, without times."""
    return "".join(
        " ".join(f"{value:.9e}" for value in item.pose[:3].ravel().tolist()) + "\n"
        for item in poses
    )


def levelled_start(pose: F64) -> F64:
    """Return what takes a first pose (4, 4) to the origin with yaw 0; roll and pitch stay."""
    forward = pose[:3, 0]
    yaw = np.arctan2(forward[1], forward[0])
    if np.hypot(forward[0], forward[1]) < 1e-3:  # x points up or down: y tells the heading
        yaw = np.arctan2(pose[1, 1], pose[0, 1]) - np.pi / 2.0
    turn = rotations.matrices(rotations.exp((0.0, 0.0, -yaw)))
    out = np.eye(4)
    out[:3, :3] = turn
    out[:3, 3] = -turn @ pose[:3, 3]
    return out
