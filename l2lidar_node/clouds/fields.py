"""Fields and points of a PointCloud2, and the ring of every point.

A packet is an arc from horizon to horizon over the zenith, so this scanner has no lines that go
round. Elevation bands do go round, and projection-based pipelines use a ring for just that.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

DATATYPES: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Type code by the number that PointField has for it."""


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a cloud, as PointField says it."""

    name: str
    offset: int
    datatype: int
    count: int

    @property
    def code(self) -> str:
        """Type such as ``f4``, ``f4[3]`` for more than one, ``?9`` for an unknown number."""
        code = DATATYPES.get(self.datatype, f"?{self.datatype}")
        return code if self.count <= 1 else f"{code}[{self.count}]"


def fields_of(message: Any) -> tuple[Field, ...]:
    """Return the fields of a PointCloud2."""
    return tuple(
        Field(str(item.name), int(item.offset), int(item.datatype), int(item.count))
        for item in message.fields
    )


def dtype_of(fields: Iterable[Field], point_step: int, is_bigendian: bool) -> np.dtype[np.void]:
    """Return the structured dtype of points.

    Raises
    ------
    ValueError
        If there is no field, one does not fit ``point_step`` or stands twice, or its type is
        unknown, naming the field.
    """
    order = ">" if is_bigendian else "<"
    names: list[str] = []
    formats: list[Any] = []
    offsets: list[int] = []
    for item in fields:
        code = DATATYPES.get(item.datatype)
        if code is None:
            raise ValueError(f"field '{item.name}': datatype {item.datatype} is not known")
        count = max(item.count, 1)
        if item.offset + int(code[1]) * count > point_step:
            raise ValueError(f"field '{item.name}': does not fit point_step {point_step}")
        if not item.name or item.name in names:
            raise ValueError(f"field '{item.name}': {'occurs twice' if item.name else 'no name'}")
        names.append(item.name)
        formats.append(f"{order}{code}" if count == 1 else (f"{order}{code}", (count,)))
        offsets.append(item.offset)
    if not names:
        raise ValueError("there are no fields")
    return np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": point_step}
    )


def points_of(message: Any) -> NDArray[np.void]:
    """Return the points of a PointCloud2, row by row, shape (N,), where possible without a copy.

    Raises
    ------
    ValueError
        If sizes and data do not agree, or a field is impossible.
    """
    layout = dtype_of(fields_of(message), message.point_step, message.is_bigendian)
    data = np.frombuffer(message.data, np.uint8)
    used = message.width * message.point_step
    row_step = message.row_step or used
    if row_step < used or len(data) < row_step * message.height:
        raise ValueError(
            f"cloud of {message.width} x {message.height} points of {message.point_step} B has "
            f"row_step {message.row_step} and {len(data)} B of data"
        )
    rows = data[: row_step * message.height].reshape(message.height, row_step)[:, :used]
    return np.ascontiguousarray(rows).reshape(-1).view(layout)


RINGS: Final = 150
"""Rings over the 90 degrees from horizon to zenith, 0.6 degrees each.

That is the spacing of the slots: each point of an arc gets a ring of its own. LIO-SAM keeps one
point for each ring and column (0.2 degrees of azimuth at 1800 columns), and the head turns only
0.012 degrees from slot to slot: with wider rings, most points of an arc would share a cell and go.
"""

OPTICAL_CENTRE_M: Final = 0.0445  # height above the mounting face, the same on all units


def rings(points: NDArray[np.void], count: int = RINGS) -> NDArray[np.uint16]:
    """Return the ring of every point, 0 at the horizon, counted upwards.

    Parameters
    ----------
    points : ndarray, shape (N,), dtype with x, y, z
        Cloud frame [m], finite.
    count : int
        Rings over the 90 degrees.

    Returns
    -------
    ndarray, shape (N,), uint16
        0 to ``count`` - 1; what lies below the horizon (wide field of view) is in ring 0.
    """
    horizontal = np.hypot(points["x"], points["y"])
    elevation = np.arctan2(points["z"] - OPTICAL_CENTRE_M, horizontal)
    ring = np.floor(elevation * (count / (np.pi / 2)))
    return np.asarray(np.clip(ring, 0, count - 1), np.uint16)
