"""Writes points as PLY or PCD; the file is complete or as it was before."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.files import whole


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
