"""Trajectories and maps as files for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.files import whole
from l2lidar_node.recording.tum import pose_array, render
from l2lidar_node.types import F64, HostNs

STAMPED_POSE: Final = np.dtype([("stamp", "<i8"), ("pose", "<f8", (4, 4))])
"""Instant [ns], and coordinates of the moving frame to those of the fixed one."""

StampedPoses = NDArray[np.void]
"""Array of dtype STAMPED_POSE, shape (N,)."""


MOST_POSES: Final = 1_000_000
"""Of a trajectory: 136 MB, and 64 hours of an L2."""


class Trajectory:
    """A growing array of stamped poses; once it is full, of every second one, and so on.

    The latest is always the last.

    Parameters
    ----------
    most : int
        Poses at most, even.
    """

    def __init__(self, most: int = MOST_POSES) -> None:
        self._rows = np.empty(min(256, most), STAMPED_POSE)
        self._most = most
        self._count = 0
        self._every = 1  # of the poses that came, one is kept
        self._came = 0

    @property
    def poses(self) -> StampedPoses:
        """All poses, shape (N,); a view."""
        return self._rows[: self._count]

    def append(self, stamp: HostNs, pose: F64) -> None:
        """Add a pose, shape (4, 4)."""
        if (self._came - 1) % self._every:
            self._count -= 1  # the one before was there only as the latest
        self._came += 1
        if self._count == self._most:
            self._every, self._count = 2 * self._every, self._most // 2
            self._rows[: self._count] = self._rows[::2].copy()
        elif self._count == len(self._rows):
            grown = np.empty(min(2 * self._count, self._most), STAMPED_POSE)
            grown[: self._count] = self._rows
            self._rows = grown
        self._rows[self._count] = stamp, pose
        self._count += 1


def tum(poses: StampedPoses) -> str:
    """Return the lines of a TUM file: seconds, x, y, z, then the quaternion as x, y, z, w."""
    pose = poses["pose"]
    quaternions = [rotations.from_matrix(one) for one in pose[:, :3, :3]]
    return render(pose_array(poses["stamp"], pose[:, :3, 3], np.reshape(quaternions, (-1, 4))))


def kitti(poses: StampedPoses) -> str:
    """Return the lines of a KITTI file: the upper three rows of each pose, without times."""
    return "".join(
        " ".join(f"{value:.9e}" for value in row) + "\n"
        for row in poses["pose"][:, :3].reshape(-1, 12).tolist()
    )


def leveled_start(pose: F64) -> F64:
    """Return the transform that moves a first pose (4, 4) to the origin with yaw 0."""
    forward = pose[:3, 0]
    yaw = np.arctan2(forward[1], forward[0])
    if np.hypot(forward[0], forward[1]) < 1e-3:  # x points up or down: y tells the heading
        yaw = np.arctan2(pose[1, 1], pose[0, 1]) - np.pi / 2.0
    turn = rotations.matrices(rotations.exp((0.0, 0.0, -yaw)))
    out = np.eye(4)
    out[:3, :3] = turn
    out[:3, 3] = -turn @ pose[:3, 3]
    return out


def save(path: Path, points: NDArray[np.float64]) -> int:
    """Write points (N, 3) [m] in the format that the suffix names; return how many.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points)))
    with whole(path) as part:
        if not o3d.io.write_point_cloud(part, cloud):
            raise OSError(f"{path} could not be written")
    return len(points)
