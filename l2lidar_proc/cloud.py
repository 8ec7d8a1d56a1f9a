"""Sweeps: made of any structured cloud with one time per point, cropped, and joined."""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import POINT, HostNs, Sweep, is_ros_time

TIME_FIELDS: Final = ("time", "t", "timestamp", "offset_time", "time_stamp", "stamps")
"""Names of drivers and of odometries: Velodyne, Ouster, Hesai, Livox, Autoware, KISS-ICP."""

_UNITS: Final = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1000, "ns": 1}
_NEAR_NS: Final = 2_000_000_000  # how far times may be from the stamp

MAX_DURATION_NS: Final = 25_000_000_000
"""Longest sweep: the driver's longest cloud has 20 s, 4000 packets take 18.5 s."""

MAX_POINTS: Final = 2_000_000
"""Largest sweep: the driver's largest cloud has 1.3 million points."""


class CloudError(ValueError):
    """A cloud whose point times cannot be determined; the message says why."""


def to_sweep(
    cloud: NDArray[np.void], stamp: HostNs, unit: str = "auto", *, snapshots: bool = False
) -> Sweep:
    """Return a cloud's points with times in seconds after the sweep's start, ascending.

    Parameters
    ----------
    cloud : ndarray, shape (N,) or (H, W)
        Structured, with ``x``, ``y``, ``z`` and exactly one of :data:`TIME_FIELDS`.
    stamp : HostNs
        The cloud's stamp. Times may count from it or be absolute.
    unit : str
        Of the times: s, ms, us, ns; or auto, which takes floating-point numbers that span up to 1
        for seconds, 1e3 to 1e6 for microseconds, more for nanoseconds, and integers that span
        1e6 or more for nanoseconds. Anything else could be two things and is refused.
    snapshots : bool
        Take a cloud without a time field, or whose times are all equal, as measured at the
        instant of its stamp, as a depth camera does: ``start`` and ``end`` are the same then.

    Returns
    -------
    Sweep
        ``start`` is the stamp, or the first point where that is earlier; ``end`` the last point.
        The points keep their fields; the time field becomes ``time``, float32. Points that are not
        finite are left out, and so are points at the origin with the time 0 if that is far outside
        the sweep. The driver's own layouts are in seconds.

    Raises
    ------
    CloudError
        If there is no time field, or several; if all times are equal; if unit or origin are not
        plain; if a time is none that a ROS stamp can hold; or if there are more points or seconds
        than :data:`MAX_POINTS` and :data:`MAX_DURATION_NS`.
    """
    cloud = cloud.reshape(-1)
    if len(cloud) > MAX_POINTS:
        raise CloudError(f"{len(cloud)} points are too many; a sweep has up to {MAX_POINTS}")
    name = _time_field(cloud.dtype, snapshots)
    finite = np.isfinite(cloud[name]) if name else np.ones(len(cloud), np.bool_)
    for axis in "xyz":
        finite &= np.isfinite(cloud[axis])
    if not finite.all():
        cloud = cloud[finite]
    if not len(cloud):
        raise CloudError("no point is finite")
    if not is_ros_time(stamp):
        raise CloudError("its time is out of range: ROS 2 stamps cover 1901 to 2038")
    if snapshots and (not name or cloud[name].min() == cloud[name].max()):
        points = _with_time(cloud, name, np.zeros(len(cloud)))
        points.flags.writeable = False
        return Sweep(stamp, stamp, points, 0, 0)
    cloud = _measured(cloud, name)
    if unit == "auto" and (cloud.dtype.names or ())[:6] == POINT.names:
        unit = "s"  # the driver's own layouts, whose sweeps may last for many seconds
    times = _relative_ns(cloud[name], stamp, unit)
    if (np.diff(times) < 0).any():
        order = np.argsort(times, kind="stable")
        cloud, times = records.selected(cloud, order), times[order]
    lasts = (int(times[-1]) - min(int(times[0]), 0)) / 1e9
    if lasts > MAX_DURATION_NS / 1e9:
        raise CloudError(
            f"a sweep that lasts {lasts:.6g} s is too long; up to {MAX_DURATION_NS / 1e9:g} s "
            "can be used"
        )
    before = min(int(times[0]), 0)
    if not is_ros_time(stamp + before) or not is_ros_time(stamp + int(times[-1])):
        raise CloudError("its time is out of range: ROS 2 stamps cover 1901 to 2038")
    points = _with_time(cloud, name, np.asarray((times - before) * 1e-9))
    points.flags.writeable = False
    return Sweep(HostNs(stamp + before), HostNs(stamp + int(times[-1])), points, 0, 0)


def positions(points: NDArray[np.void]) -> NDArray[np.float64]:
    """Return x, y and z of structured points (N,), float64, shape (N, 3), row by row in memory."""
    return np.stack([points[axis] for axis in "xyz"], axis=1, dtype=np.float64)


def positions_by_axis(points: NDArray[np.void]) -> NDArray[np.float64]:
    """Return x, y and z of structured points (N,), float64, shape (3, N), each contiguous."""
    return np.stack([points[axis] for axis in "xyz"], dtype=np.float64)


def without_time(points: NDArray[np.void]) -> NDArray[np.void]:
    """Return the points without any field of times, packed."""
    names = [name for name in points.dtype.names or () if name not in TIME_FIELDS]
    slim = np.empty(points.shape, dtype=[(name, points.dtype[name]) for name in names])
    for name in names:
        slim[name] = points[name]
    return slim


def position_problem(layout: np.dtype[Any]) -> str:
    """Return the problem with the fields x, y and z of a cloud; empty if there is none."""
    for axis in "xyz":
        if axis not in (layout.names or ()):
            return f"field '{axis}' is missing"
        if layout[axis].kind != "f" or layout[axis].shape:
            return f"field '{axis}' is {layout[axis]}, not one floating-point number"
    return ""


def _time_field(layout: np.dtype[Any], snapshots: bool) -> str:
    """Return the name of the time field, empty where there is none and need not be."""
    names = layout.names or ()
    if problem := position_problem(layout):
        raise CloudError(problem)
    found = [name for name in TIME_FIELDS if name in names]
    if not found and snapshots:
        return ""
    if not found:
        raise CloudError(f"no time field; one of {', '.join(TIME_FIELDS)} is needed")
    if len(found) > 1:
        raise CloudError(f"several time fields: {', '.join(found)}")
    if layout[found[0]].kind not in "fiu" or layout[found[0]].shape:
        raise CloudError(f"field '{found[0]}' is not a number")
    return found[0]


def _measured(cloud: NDArray[np.void], name: str) -> NDArray[np.void]:
    """Return the points (N,) without those that are zero where the others have absolute times.

    So drivers fill the places of beams without a return, and of lost packets. Zero is a time like
    any other where it lies within the sweep.
    """
    times = cloud[name]
    is_blank = times == 0
    for axis in "xyz":
        is_blank &= cloud[axis] == 0.0
    if not is_blank.any() or is_blank.all():
        return cloud
    others = times[~is_blank]
    first, last = float(others.min()), float(others.max())
    is_outside = first > 2.0 * (last - first) > 0.0
    return records.selected(cloud, ~is_blank) if is_outside else cloud


def _relative_ns(times: NDArray[Any], stamp: HostNs, unit: str) -> NDArray[np.int64]:
    """Return times after the stamp [ns], shape (N,), int64."""
    first, last = times.min(), times.max()
    spread = float(last) - float(first) if times.dtype.kind == "f" else int(last) - int(first)
    if spread == 0:
        raise CloudError(f"all {len(times)} times are equal")
    factor = _UNITS[_unit(times.dtype, spread) if unit == "auto" else unit]
    if float(np.abs([float(first), float(last)]).max()) * factor > 9e18:
        raise CloudError(f"times up to {float(last):g} are not valid times")
    if times.dtype.kind == "f":
        instants = np.round(times.astype(np.float64) * factor).astype(np.int64)
    else:
        instants = times.astype(np.int64) * factor
    ends = instants.min(), instants.max()
    from_stamp = max(abs(int(end)) for end in ends) <= _NEAR_NS * max(spread * factor / 1e9, 1.0)
    # half-width numbers cannot hold an instant, only what counts from the stamp
    absolute = times.dtype.itemsize == 8 and abs(int(ends[0]) - stamp) <= _NEAR_NS
    if from_stamp and absolute:
        raise CloudError("the stamp is near 0, so the times may be absolute or relative to it")
    if not from_stamp and not absolute:
        apart_s = (int(ends[0]) - stamp) / 1e9
        raise CloudError(
            f"the times are neither absolute nor relative to the stamp: taken as absolute, they "
            f"are {abs(apart_s):.2g} s {'after' if apart_s > 0.0 else 'before'} it"
        )
    return instants - stamp if absolute else instants


def _unit(layout: np.dtype[Any], spread: float) -> str:
    if layout.kind == "f":
        if spread <= 1.0:
            return "s"
        if 1e3 <= spread < 1e6:
            return "us"
    if 1e6 <= spread <= 1e9:
        return "ns"
    raise CloudError(
        f"times of type {layout} that span {spread:g} have no obvious unit; set time_unit to "
        "s, ms, us or ns"
    )


def _with_time(
    cloud: NDArray[np.void], name: str, seconds: NDArray[np.float64]
) -> NDArray[np.void]:
    """Return the points with their time field, if any, replaced by ``time``, float32 seconds."""
    layout = cloud.dtype
    renamed = {old: "time" if old == name else old for old in layout.names or ()}
    kinds = [
        (new, np.dtype("<f4") if old == name else layout[old]) for old, new in renamed.items()
    ]
    if not name:
        kinds.append(("time", np.dtype("<f4")))
    points = np.empty(len(cloud), dtype=kinds)
    for old, new in renamed.items():
        points[new] = cloud[old] if old != name else 0.0
    points["time"] = seconds
    return points


def joined(sweeps: list[Sweep], least_ns: int) -> list[Sweep]:
    """Return sweeps that last at least so long; a last one that is shorter is left out.

    Parameters
    ----------
    sweeps : list of Sweep
        Ascending, with the same fields.
    least_ns : int
    """
    out: list[Sweep] = []
    some: list[Sweep] = []
    for sweep in sweeps:
        some.append(sweep)
        if sweep.end - some[0].start >= least_ns:
            out.append(some[0] if len(some) == 1 else _one(some))
            some = []
    return out


def cropped(sweep: Sweep, nearest: float, farthest: float) -> Sweep:
    """Return the sweep without points that are not finite or out of a range [m]."""
    points = sweep.points
    squared = sum(points[axis].astype(np.float64) ** 2 for axis in "xyz")
    inside = (squared >= nearest**2) & (squared <= farthest**2) & np.isfinite(points["time"])
    return (
        sweep
        if inside.all()
        else dataclasses.replace(sweep, points=records.selected(points, inside))
    )


def _one(sweeps: list[Sweep]) -> Sweep:
    points = records.joined([sweep.points for sweep in sweeps])
    shift = [(sweep.start - sweeps[0].start) * 1e-9 for sweep in sweeps]
    counts = [len(sweep.points) for sweep in sweeps]
    points["time"] += np.repeat(shift, counts).astype(points["time"].dtype)
    return Sweep(
        sweeps[0].start,
        sweeps[-1].end,
        points,
        sum(sweep.packets for sweep in sweeps),
        sum(sweep.missing for sweep in sweeps),
    )
