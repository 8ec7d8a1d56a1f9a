"""Filters: which points to keep, and chains of such filters.

The L2 measures along a line: 300 slots of one packet follow each other 8 us and 0.6 degrees apart,
then comes the dark half of the mirror's turn. The next line is 7 degrees away, so in space even
good points are lonely, and neighbours have to be looked for on the line: in time.

A filter takes points, shape (N,), and settings, and returns a mask, shape (N,). It moves and
changes nothing. Points need ``x``, ``y`` and ``z`` [m]; a filter that needs more says so when it
is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc.deskew.config import FilterConfig

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


Filter = Callable[[Points, FilterConfig], Mask]


def apply(points: Points, names: Sequence[str], config: FilterConfig) -> NDArray[np.intp]:
    """Return the indices of the points that a chain of filters leaves, ascending.

    Parameters
    ----------
    points : ndarray, shape (N,)
    names : sequence of str
        Filters in order, each of which sees what those before it left.
    config : FilterConfig

    Raises
    ------
    FilterError
        If a filter needs a field that the points do not have.
    """
    kept = np.arange(len(points))
    for name in names:
        if not len(kept):
            break
        left = points if len(kept) == len(points) else points[kept]
        kept = kept[FILTERS[name](left, config)]
    return kept


def by_range(points: Points, config: FilterConfig) -> Mask:
    """Keep distances from the origin within range_min and range_max."""
    square = sum(axis * axis for axis in _xyz_filters(points))
    return np.asarray(
        (square >= config.range_min**2) & (square <= config.range_max**2), dtype=np.bool_
    )


def by_elevation(points: Points, config: FilterConfig) -> Mask:
    """Keep angles above the x-y plane within vertical_min and vertical_max."""
    x, y, z = _xyz_filters(points)
    angle = np.degrees(np.arctan2(z, np.hypot(x, y)))
    return np.asarray((angle >= config.vertical_min) & (angle <= config.vertical_max))


def by_azimuth(points: Points, config: FilterConfig) -> Mask:
    """Keep directions from azimuth_min counter-clockwise to azimuth_max."""
    x, y, _ = _xyz_filters(points)
    width = config.azimuth_max - config.azimuth_min
    if width >= 360.0:
        return np.ones(len(points), dtype=np.bool_)
    after = (np.degrees(np.arctan2(y, x)) - config.azimuth_min) % 360.0
    return np.asarray(after <= width % 360.0)


def in_boxes(points: Points, config: FilterConfig) -> Mask:
    """Keep what lies in any of the boxes keep_boxes; everything if there is none."""
    if not config.keep_boxes:
        return np.ones(len(points), dtype=np.bool_)
    return _inside(points, config.keep_boxes)


def outside_boxes(points: Points, config: FilterConfig) -> Mask:
    """Keep what lies in none of the boxes remove_boxes."""
    return ~_inside(points, config.remove_boxes)


def by_intensity(points: Points, config: FilterConfig) -> Mask:
    """Keep intensities within intensity_min and intensity_max."""
    if "intensity" not in (points.dtype.names or ()):
        raise FilterError("filter 'intensity': the points have no field 'intensity'")
    value = points["intensity"]
    return np.asarray((value >= config.intensity_min) & (value <= config.intensity_max))


def one_per_voxel(points: Points, config: FilterConfig) -> Mask:
    """Keep the first point in each cube of edge voxel_size; the grid hangs on the origin."""
    cell = [np.floor(axis / config.voxel_size).astype(np.int64) for axis in _xyz_filters(points)]
    low = [axis.min() for axis in cell]
    size = [int(axis.max() - least) + 1 for axis, least in zip(cell, low, strict=True)]
    key = ((cell[0] - low[0]) * size[1] + (cell[1] - low[1])) * size[2] + (cell[2] - low[2])
    mask = np.zeros(len(points), dtype=np.bool_)
    mask[np.unique(key, return_index=True)[1]] = True
    return mask


def isolated(points: Points, config: FilterConfig) -> Mask:
    """Keep points with neighbors on their own scan line."""
    if "time" not in (points.dtype.names or ()):
        raise FilterError("filter 'isolated': the points have no field 'time'")
    return on_a_line(points, config)


FILTERS: Final[dict[str, Filter]] = {
    "range": by_range,
    "vertical": by_elevation,
    "azimuth": by_azimuth,
    "keep_boxes": in_boxes,
    "remove_boxes": outside_boxes,
    "intensity": by_intensity,
    "isolated": isolated,
    "voxel": one_per_voxel,
    "statistical": statistical,
    "radius": in_company,
}
"""Filter by name."""


def _xyz_filters(points: Points) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    x, y, z = (np.asarray(points[name], dtype=np.float64) for name in "xyz")
    return x, y, z


def _inside(points: Points, corners: Sequence[float]) -> Mask:
    boxes = np.asarray(corners, dtype=np.float64).reshape(-1, 2, 3)
    low, high = boxes.min(axis=1), boxes.max(axis=1)
    inside = np.zeros(len(points), dtype=np.bool_)
    for a, b in zip(low, high, strict=True):
        within = np.ones(len(points), dtype=np.bool_)
        for axis, least, most in zip(_xyz_filters(points), a, b, strict=True):
            within &= (axis >= least) & (axis <= most)
        inside |= within
    return inside
