"""Finds points that stand alone: dust on the scan line, and sparse ones in space.

The L2 measures along a line: 300 slots of one packet follow each other 8 us and 0.6 degrees apart,
then comes the dark half of the mirror's turn. The next line is 7 degrees away, so in space even
good points are lonely, and neighbours have to be looked for on the line: in time.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc.config import FilterConfig

Points = NDArray[np.void]
Mask = NDArray[np.bool_]


class FilterError(ValueError):
    """A filter that cannot work on these points; the message says which and why."""


_LONGEST_SLOT_S: Final = 1e-4
_USUAL_SLOT_S: Final = 7.73e-6


def slot_time(times: NDArray[np.float32]) -> float:
    """Return the time from slot to slot [s]: the usual step between points that follow closely."""
    steps = np.diff(times.astype(np.float64))
    steps = steps[(steps > 1e-6) & (steps < _LONGEST_SLOT_S)]
    if not len(steps):
        return _USUAL_SLOT_S
    # gaps are whole multiples of a slot, so the low quantile is one slot wherever returns are not
    # rare
    usual = float(np.quantile(steps, 0.2))
    return float(steps[np.abs(steps - usual) < 0.4 * usual].mean())


def on_a_line(points: Points, config: FilterConfig) -> Mask:
    """Keep points with enough neighbours on their own scan line.

    Parameters
    ----------
    points : ndarray, shape (N,)
        With ``x``, ``y``, ``z`` [m] and ``time`` [s], ascending.
    config : FilterConfig
        The settings ``isolated_*``. Bright points stay: dust and fog are dim.
    """
    xyz = _xyz(points)
    times = points["time"].astype(np.float64)
    reach = (config.isolated_slots + 0.5) * slot_time(points["time"])
    distance = np.linalg.norm(xyz, axis=1)
    allowed = config.isolated_distance + config.isolated_ratio * distance
    neighbours = np.zeros(len(points), dtype=np.int64)
    for step in range(1, min(config.isolated_slots, len(points) - 1) + 1):
        near = times[step:] - times[:-step] <= reach
        apart = np.linalg.norm(xyz[step:] - xyz[:-step], axis=1)
        near &= apart <= np.minimum(allowed[step:], allowed[:-step])
        neighbours[step:] += near
        neighbours[:-step] += near
    keep = neighbours >= config.isolated_neighbours
    if "intensity" in (points.dtype.names or ()):
        keep |= points["intensity"] > config.isolated_intensity
    return np.asarray(keep)


def statistical(points: Points, config: FilterConfig) -> Mask:
    """Keep points whose distance to their neighbours is not far above average (open3d)."""
    cloud = _open3d(points)
    _, kept = cloud.remove_statistical_outlier(
        nb_neighbors=config.statistical_neighbours, std_ratio=config.statistical_ratio
    )
    return _mask(kept, len(points))


def in_company(points: Points, config: FilterConfig) -> Mask:
    """Keep points with enough others within a radius (open3d)."""
    # open3d counts the point itself and asks for more than the number it is given
    _, kept = _open3d(points).remove_radius_outlier(
        nb_points=config.radius_neighbours, radius=config.radius
    )
    return _mask(kept, len(points))


def _open3d(points: Points):  # type: ignore[no-untyped-def]  # open3d has no types
    try:
        import open3d  # heavy, and only these two filters need it
    except ImportError:
        raise FilterError("filters 'statistical' and 'radius': open3d is not installed") from None
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(_xyz(points)))


def _mask(kept: list[int], count: int) -> Mask:
    mask = np.zeros(count, dtype=np.bool_)
    mask[np.asarray(kept, dtype=np.intp)] = True
    return mask


def _xyz(points: Points) -> NDArray[np.float64]:
    return np.stack([points[name].astype(np.float64) for name in "xyz"], axis=-1)
