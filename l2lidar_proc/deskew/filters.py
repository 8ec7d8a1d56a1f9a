"""Says which points to keep: windows, boxes, intensity, one per voxel; and chains of such filters.

A filter takes points, shape (N,), and settings, and returns a mask, shape (N,). It moves and
changes nothing. Points need ``x``, ``y`` and ``z`` [m]; a filter that needs more says so when it
is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc.config import FilterConfig
from l2lidar_proc.deskew import outliers
from l2lidar_proc.deskew.outliers import FilterError

Points = NDArray[np.void]
Mask = NDArray[np.bool_]
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
    square = sum(axis * axis for axis in _xyz(points))
    return np.asarray(
        (square >= config.range_min**2) & (square <= config.range_max**2), dtype=np.bool_
    )


def by_elevation(points: Points, config: FilterConfig) -> Mask:
    """Keep angles above the x-y plane within vertical_min and vertical_max."""
    x, y, z = _xyz(points)
    angle = np.degrees(np.arctan2(z, np.hypot(x, y)))
    return np.asarray((angle >= config.vertical_min) & (angle <= config.vertical_max))


def by_azimuth(points: Points, config: FilterConfig) -> Mask:
    """Keep directions from azimuth_min counter-clockwise to azimuth_max."""
    x, y, _ = _xyz(points)
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
    cell = [np.floor(axis / config.voxel_size).astype(np.int64) for axis in _xyz(points)]
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
    return outliers.on_a_line(points, config)


FILTERS: Final[dict[str, Filter]] = {
    "range": by_range,
    "vertical": by_elevation,
    "azimuth": by_azimuth,
    "keep_boxes": in_boxes,
    "remove_boxes": outside_boxes,
    "intensity": by_intensity,
    "isolated": isolated,
    "voxel": one_per_voxel,
    "statistical": outliers.statistical,
    "radius": outliers.in_company,
}
"""Filter by name."""


def _xyz(points: Points) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    x, y, z = (np.asarray(points[name], dtype=np.float64) for name in "xyz")
    return x, y, z


def _inside(points: Points, corners: Sequence[float]) -> Mask:
    boxes = np.asarray(corners, dtype=np.float64).reshape(-1, 2, 3)
    low, high = boxes.min(axis=1), boxes.max(axis=1)
    inside = np.zeros(len(points), dtype=np.bool_)
    for a, b in zip(low, high, strict=True):
        within = np.ones(len(points), dtype=np.bool_)
        for axis, least, most in zip(_xyz(points), a, b, strict=True):
            within &= (axis >= least) & (axis <= most)
        inside |= within
    return inside
