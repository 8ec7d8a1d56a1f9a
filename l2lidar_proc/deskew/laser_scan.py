"""Laser scan: the nearest point in each direction of a level slice of deskewed clouds.

One sweep of the L2 crosses a level plane about a hundred times, 3.6 degrees apart. The head does
not come back to the same azimuths, so a few sweeps, moved along with the sensor, fill the rest.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F32, F64
from l2lidar_proc.cloud import positions
from l2lidar_proc.deskew.config import ScanConfig

_STEEP: Final = 0.9  # cosine between x and the vertical from which on z gives the heading
_MARGIN_M: Final = 0.5  # around the slice: what may move into it while the sensor tilts


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan:
    """Ranges in equal steps all around, counter-clockwise seen from above.

    Attributes
    ----------
    angle_min, angle_increment : float
        Direction of the first range, and the step from one to the next [rad].
    ranges : ndarray, shape (N,), float32
        Of the nearest point [m]; infinite where nothing was seen.
    intensities : ndarray, shape (N,), float32
        Of that point; 0 where nothing was seen. Empty if the points have none.
    """

    angle_min: float
    angle_increment: float
    ranges: F32
    intensities: F32


def level_rotation(up: F64) -> F64:
    """Return the rotation (3, 3) from a sensor's axes to level ones, z up.

    Parameters
    ----------
    up : ndarray, shape (3,)
        Unit, the vertical in the sensor's axes.

    Notes
    -----
    The heading is that of the sensor's x axis. Where that is nearly vertical, as with a sensor
    that looks ahead, it is that of its z axis.
    """
    ahead = np.array([1.0, 0.0, 0.0] if abs(up[0]) < _STEEP else [0.0, 0.0, 1.0])
    x = ahead - (ahead @ up) * up
    x /= np.linalg.norm(x)
    return np.stack((x, np.cross(up, x), up))


def slice_of(xyz: F64, intensities: F32, config: ScanConfig) -> LaserScan:
    """Return the scan of points in level axes.

    Parameters
    ----------
    xyz : ndarray, shape (N, 3)
        From the origin of the scan [m].
    intensities : ndarray, shape (N,) or (0,), float32
    config : ScanConfig
        Heights, ranges and the angle between them; the angle is made to divide a full turn.
    """
    count = max(round(2.0 * np.pi / config.angle_increment), 1)
    step = 2.0 * np.pi / count
    x, y, z = xyz.T
    distance = np.hypot(x, y)
    with np.errstate(invalid="ignore"):
        kept = (z >= config.height_min) & (z <= config.height_max)
        kept &= (distance >= config.range_min) & (distance <= config.range_max)
    at = np.round((np.arctan2(y[kept], x[kept]) + np.pi) / step).astype(np.intp) % count
    near = distance[kept]
    farthest_first = np.argsort(-near, kind="stable")
    at = at[farthest_first]
    ranges = np.full(count, np.inf, np.float32)
    ranges[at] = near[farthest_first]  # of several, the last one stays: the nearest
    found = np.zeros(count if len(intensities) else 0, np.float32)
    if len(intensities):
        found[at] = intensities[kept][farthest_first]
    return LaserScan(-np.pi, step, ranges, found)


@dataclass(slots=True, eq=False)
class _Slice:
    """Points of a sweep around the scan's heights, in the cloud frame of the newest sweep."""

    xyz: F64
    intensities: F32


class ScanBuilder:
    """Makes a scan of the newest sweep and some before it.

    Parameters
    ----------
    config : ScanConfig
    """

    def __init__(self, config: ScanConfig) -> None:
        self.config = config
        self._slices: deque[_Slice] = deque()

    def clear(self) -> None:
        """Forget the sweeps before."""
        self._slices.clear()

    def add(
        self, points: NDArray[np.void], T_scan_cloud: F64, T_now_before: F64 | None
    ) -> LaserScan:
        """Take a sweep and return the scan.

        Parameters
        ----------
        points : ndarray
            Structured with ``x``, ``y``, ``z`` [m]; of any shape. Those that are not finite are
            left out.
        T_scan_cloud : ndarray, shape (4, 4)
            Cloud coordinates to those of the scan, z up.
        T_now_before : ndarray, shape (4, 4), or None
            Cloud coordinates of the sweep before to those of this one; None where the motion
            between them is not known, which drops the sweeps before.
        """
        if T_now_before is None:
            self._slices.clear()
        else:
            for item in self._slices:
                item.xyz = _moved(item.xyz, T_now_before)
        while len(self._slices) >= self.config.sweeps:
            self._slices.popleft()
        self._slices.append(self._around_the_slice(points, T_scan_cloud))
        xyz = np.concatenate([item.xyz for item in self._slices])
        sizes = {len(item.intensities) == len(item.xyz) for item in self._slices}
        intensities = (
            np.concatenate([item.intensities for item in self._slices])
            if sizes == {True}
            else np.zeros(0, np.float32)
        )
        return slice_of(_moved(xyz, T_scan_cloud), intensities, self.config)

    def _around_the_slice(self, points: NDArray[np.void], T_scan_cloud: F64) -> _Slice:
        flat = points.reshape(-1)
        xyz = positions(flat)
        height = xyz @ T_scan_cloud[2, :3] + T_scan_cloud[2, 3]
        with np.errstate(invalid="ignore"):
            kept = (height >= self.config.height_min - _MARGIN_M) & (
                height <= self.config.height_max + _MARGIN_M
            )
        has_intensity = "intensity" in (flat.dtype.names or ())
        bright = flat["intensity"][kept] if has_intensity else np.zeros(0)
        return _Slice(xyz[kept], np.asarray(bright, np.float32))


def _moved(xyz: F64, transform: F64) -> F64:
    return np.asarray(xyz @ transform[:3, :3].T + transform[:3, 3])
