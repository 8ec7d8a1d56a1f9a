"""Point filters, and organized clouds.

The L2 measures along a line: 300 slots of one packet follow each other 8 us and 0.6 degrees apart,
then comes the dark half of the mirror's turn. The next line is 7 degrees away, so in space even
good points are lonely, and neighbors have to be looked for on the line: in time.

A filter takes points, shape (N,), and settings, and returns a mask, shape (N,). It moves and
changes nothing. Points need ``x``, ``y`` and ``z`` [m]; a filter that needs more says so when it
is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_proc.cloud import positions
from l2lidar_proc.deskew.config import FilterConfig

Points = NDArray[np.void]
Mask = NDArray[np.bool_]


class FilterError(ValueError):
    """A filter cannot work on these points; the message says which and why."""


_LONGEST_SLOT_S: Final = 1e-4
_USUAL_SLOT_S: Final = 7.73e-6


def slot_time(times: NDArray[np.float32]) -> float:
    """Return the time from slot to slot [s]: the usual step between points that follow closely."""
    steps = np.diff(times.astype(np.float64))
    steps = steps[(steps > 1e-6) & (steps < _LONGEST_SLOT_S)]
    if not len(steps):
        return _USUAL_SLOT_S
    # gaps are whole multiples of a slot, so the low quantile is one slot wherever returns are not
    # rare; a step that is there, as between two of them there may be none to average
    usual = float(np.quantile(steps, 0.2, method="lower"))
    return float(steps[np.abs(steps - usual) < 0.4 * usual].mean())


def on_a_line(points: Points, config: FilterConfig) -> Mask:
    """Keep points with enough neighbors on their own scan line.

    Parameters
    ----------
    points : ndarray, shape (N,)
        With ``x``, ``y``, ``z`` [m] and ``time`` [s], ascending.
    config : FilterConfig
        The settings ``isolated_*``. Bright points stay: dust and fog are dim.
    """
    xyz = positions(points)
    times = points["time"].astype(np.float64)
    reach = (config.isolated_slots + 0.5) * slot_time(points["time"])
    distance = np.linalg.norm(xyz, axis=1)
    allowed = config.isolated_distance + config.isolated_ratio * distance
    neighbors = np.zeros(len(points), dtype=np.int64)
    for step in range(1, min(config.isolated_slots, len(points) - 1) + 1):
        near = times[step:] - times[:-step] <= reach
        apart = np.linalg.norm(xyz[step:] - xyz[:-step], axis=1)
        near &= apart <= np.minimum(allowed[step:], allowed[:-step])
        neighbors[step:] += near
        neighbors[:-step] += near
    keep = neighbors >= config.isolated_neighbours
    if "intensity" in (points.dtype.names or ()):
        keep |= points["intensity"] > config.isolated_intensity
    return np.asarray(keep)


def statistical(points: Points, config: FilterConfig) -> Mask:
    """Keep points whose distance to their neighbors is not far above average (open3d)."""
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
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(positions(points)))


def _mask(kept: list[int], count: int) -> Mask:
    mask = np.zeros(count, dtype=np.bool_)
    mask[np.asarray(kept, dtype=np.intp)] = True
    return mask


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
        left = points if len(kept) == len(points) else records.selected(points, kept)
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
    """Keep points in any of the boxes keep_boxes; all points if there is none."""
    if not config.keep_boxes:
        return np.ones(len(points), dtype=np.bool_)
    return _inside(points, config.keep_boxes)


def outside_boxes(points: Points, config: FilterConfig) -> Mask:
    """Keep points outside all boxes remove_boxes."""
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


SLOTS: Final = 300  # of a packet


def organise(points: NDArray[np.void], times: NDArray[np.float32]) -> NDArray[np.void]:
    """Return points in rows and columns.

    Parameters
    ----------
    points : ndarray, shape (N,)
        Structured, in order of time.
    times : ndarray, shape (N,), float32
        Of the points [s].

    Returns
    -------
    ndarray, shape (P, 300)
        Same dtype. P counts packets from the first to the last that has a point, lost ones
        included. Floating-point fields of empty places are NaN, others 0.

    Notes
    -----
    Points do not say which slot they are from; their times do. A packet is one half of the
    mirror's turn, the other half is dark, and slots are equally long: modulo the period, times
    fill one half only, and within a packet and from packet to packet they differ by whole slots.
    The earliest point within any period is taken for slot 0.
    """
    empty = np.zeros(1, dtype=points.dtype)
    for name in points.dtype.names or ():
        if points.dtype[name].kind == "f":
            empty[name] = np.nan
    if not len(points):
        return np.repeat(empty, 0).reshape(0, SLOTS)
    rows, columns = places(times)
    image = np.repeat(empty, (int(rows[-1]) + 1) * SLOTS).reshape(-1, SLOTS)
    image[rows, columns] = points
    return image


def places(times: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the row and the column of each point by its time [s], shape (N,) each; N >= 1."""
    seconds = times.astype(np.float64)
    slot = slot_time(times)
    period = 2 * SLOTS * slot
    turn = np.floor((seconds - _dark(seconds, period)) / period).astype(np.intp)
    firsts = np.flatnonzero(np.diff(turn, prepend=turn[0] - 1))
    begins, turns = seconds[firsts], turn[firsts] - turn[0]
    late = begins - turns * _period(begins, turns, slot)
    shift = np.round((late - late.min()) / slot).astype(np.intp)
    index = np.repeat(np.arange(len(firsts)), np.diff(firsts, append=len(seconds)))
    column = shift[index] + np.round((seconds - begins[index]) / slot).astype(np.intp)
    return turns[index], np.clip(column, 0, SLOTS - 1)


def _dark(seconds: NDArray[np.float64], period: float) -> float:
    """Return an instant in the middle of the mirror's dark half [s], which no point is in."""
    phase = np.sort(seconds % period)
    gaps = np.diff(phase, append=phase[0] + period)
    widest = int(np.argmax(gaps))
    return float(phase[widest] + 0.5 * gaps[widest])


def _period(begins: NDArray[np.float64], turns: NDArray[np.intp], slot: float) -> float:
    """Return the time from packet to packet [s] from the packets' first points.

    Those are from different slots, so the steps between them differ by whole slots: the usual
    whole number is the median, and what is left over is averaged.
    """
    usual = 2 * SLOTS * slot
    if len(begins) < 2:
        return usual
    whole = np.diff(turns)
    steps = np.diff(begins)[whole == 1] if (whole == 1).any() else np.diff(begins) / whole
    slots = (steps - usual) / slot
    middle = float(np.median(slots))
    left = slots - middle - np.round(slots - middle)
    return usual + slot * (middle + float(left.mean()))
