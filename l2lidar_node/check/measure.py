"""Measures what the checks need to know of one cloud's points, so that these need not be kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.check.projection import kept_share

F64 = NDArray[np.float64]

TIME_FIELDS: Final = ("t", "time", "timestamp", "time_stamp", "stamps")
"""Names that some consumer takes for a time."""

_SAMPLE: Final = 400


class Times(NamedTuple):
    """The values of a time field, in its own unit.

    Attributes
    ----------
    first, last : float
        Of the points in their order; of the finite ones.
    least, greatest : float
    descents : int
        Points whose time is below the one before.
    invalid : int
        Points whose time is not finite.
    """

    first: float
    last: float
    least: float
    greatest: float
    descents: int
    invalid: int


class Rings(NamedTuple):
    """The values of the ring field.

    Attributes
    ----------
    least, greatest : int
    kept : float
        Share of the points that LIO-SAM's projection keeps if it has enough rings.
    """

    least: int
    greatest: int
    kept: float


@dataclass(frozen=True, slots=True, eq=False)
class Contents:
    """What is in a cloud.

    Attributes
    ----------
    count : int
        Points.
    nonfinite : int
        Points whose x, y or z is NaN or infinite.
    at_origin : int
        Points whose x, y and z are 0.
    times : mapping
        By name of the field.
    rings : Rings or None
    sample : ndarray, shape (K, 3), float32
        Some of the finite points [m].
    """

    count: int
    nonfinite: int
    at_origin: int
    times: Mapping[str, Times]
    rings: Rings | None
    sample: NDArray[np.float32]


def contents(points: NDArray[np.void]) -> Contents:
    """Return what is in a cloud.

    Parameters
    ----------
    points : ndarray, shape (N,)
        Structured, of any fields.
    """
    xyz = [_column(points, axis) for axis in "xyz"]
    known = [axis for axis in xyz if axis is not None]
    with np.errstate(all="ignore"):
        finite = np.ones(len(points), np.bool_)
        for axis in known:
            finite &= np.isfinite(axis)
        at_origin = 0
        sample = np.zeros((0, 3), np.float32)
        if len(known) == 3:
            positions = np.stack(known, axis=1)
            at_origin = int((positions == 0).all(axis=1).sum())
            usable = positions[finite]
            sample = usable[:: max(len(usable) // _SAMPLE, 1)].astype(np.float32)
        times = {}
        for name in TIME_FIELDS:
            values = _column(points, name)
            if values is not None and len(values):
                times[name] = _times(values)
        ring = _column(points, "ring")
        rings = None
        if ring is not None and len(known) == 3 and finite.any():
            rings = _rings(ring[finite], positions[finite])
    return Contents(len(points), int(len(points) - finite.sum()), at_origin, times, rings, sample)


def _column(points: NDArray[np.void], name: str) -> F64 | None:
    """Return a field's values, None if there is no such field of plain numbers."""
    if name not in (points.dtype.names or ()) or points.dtype[name].shape:
        return None
    with np.errstate(invalid="ignore"):  # of a signalling NaN
        return np.asarray(points[name], np.float64)


def _times(values: F64) -> Times:
    finite = values[np.isfinite(values)]
    invalid = len(values) - len(finite)
    if not len(finite):
        return Times(0.0, 0.0, 0.0, 0.0, 0, invalid)
    return Times(
        float(finite[0]),
        float(finite[-1]),
        float(finite.min()),
        float(finite.max()),
        int((finite[1:] < finite[:-1]).sum()),
        invalid,
    )


def _rings(ring: F64, positions: F64) -> Rings:
    rows = np.clip(np.nan_to_num(ring, nan=-1.0), -(2**31), 2**31).astype(np.int64)
    return Rings(
        int(rows.min()),
        int(rows.max()),
        kept_share(rows, positions[:, 0], positions[:, 1]),
    )
