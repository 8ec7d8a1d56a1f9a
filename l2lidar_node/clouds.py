"""Point layouts: fields and points of a PointCloud2, rings, and the layouts to publish.

A packet is an arc from horizon to horizon over the zenith, so this scanner has no lines that go
round. Elevation bands do go round, and projection-based pipelines use a ring for just that.

Every layout has at most one time field, since consumers choose among several by their own rules.
Offsets, types and units are those that the consumer's own driver publishes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import POINT, HostNs

DATATYPES: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Type code by the number that PointField has for it."""


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a cloud, as in PointField."""

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


@dataclass(frozen=True, slots=True)
class Layout:
    """A point layout.

    Attributes
    ----------
    name : str
    dtype : dtype
        Of one point as published, little-endian.
    meant_for : str
        Who reads it.
    ring_count : int
        Rings over the 90 degrees from horizon to zenith, where the layout has rings.
    """

    name: str
    dtype: np.dtype[np.void]
    meant_for: str
    ring_count: int = RINGS

    def with_rings(self, count: int) -> Layout:
        """Return the layout with another number of rings."""
        return dataclasses.replace(self, ring_count=count)

    @property
    def time_field(self) -> str:
        """Name of the time field; empty if there is none."""
        names = self.dtype.names or ()
        return next((name for name in _TIME_FIELDS if name in names), "")

    @property
    def longest_ns(self) -> int | None:
        """Largest time of a point that the layout can hold [ns]; None where any sweep fits."""
        return _MOST_NS if self.time_field in _NS_FIELDS else None

    def without_time(self) -> Layout:
        """Return the layout without its time field, for points that need none any more."""
        fields = dict(self.dtype.fields or {})
        kept = [name for name in self.dtype.names or () if name != self.time_field]
        layout = np.dtype(
            {
                "names": kept,
                "formats": [fields[name][0] for name in kept],
                "offsets": [fields[name][1] for name in kept],
                "itemsize": self.dtype.itemsize,
            }
        )
        return dataclasses.replace(self, dtype=layout)

    def convert(self, points: NDArray[np.void], start: HostNs) -> NDArray[np.void]:
        """Return points in this layout.

        Parameters
        ----------
        points : ndarray, shape (N,), dtype POINT
            Or any other with x, y and z, and with ``time`` where the layout has a time: a missing
            range is computed, a missing intensity is 0.
        start : HostNs
            Instant at which ``time`` is 0.

        Returns
        -------
        ndarray, shape (N,), dtype ``dtype``
            ``points`` itself when it has this layout already; bytes between fields are 0.
        """
        if points.dtype == self.dtype:
            return points
        converted = np.zeros(len(points), self.dtype)
        for name in self.dtype.names or ():
            is_ring = name in ("ring", "channel")
            converted[name] = (
                rings(points, self.ring_count) if is_ring else _field(name, points, start)
            )
        if self.name == "ouster_legacy":
            converted["range"] = np.rint(_range(points) * 1e3)  # whole millimeters
        return converted


_TIME_FIELDS: Final = ("time", "t", "timestamp", "time_stamp")
_NS_FIELDS: Final = ("t", "time_stamp")
_MOST_NS: Final = (1 << 32) - 1  # they are uint32


def _field(name: str, points: NDArray[np.void], start: HostNs) -> NDArray[Any]:
    """Return the values of one field of a layout."""
    if name in _NS_FIELDS:  # ns after the header's stamp
        # The settings allow no longer sweeps, but where packets are lost one may become longer.
        return np.minimum(np.rint(points["time"].astype(np.float64) * 1e9), _MOST_NS)
    if name == "timestamp":  # s since the epoch
        return np.float64(start / 1e9) + points["time"].astype(np.float64)
    if name in ("range", "distance"):
        return _range(points)
    if name == "azimuth":
        return np.asarray(np.arctan2(points["y"], points["x"]))
    if name == "elevation":
        return np.asarray(np.arctan2(points["z"], np.hypot(points["x"], points["y"])))
    if name in ("intensity", "reflectivity"):
        known = "intensity" in (points.dtype.names or ())
        return np.asarray(points["intensity"]) if known else np.zeros(len(points))
    if name in ("noise", "return_type"):
        return np.full(len(points), _CONSTANTS[name])
    return np.asarray(points[name])


def _range(points: NDArray[np.void]) -> NDArray[Any]:
    if "range" in (points.dtype.names or ()):
        return np.asarray(points["range"])
    return np.asarray(np.sqrt(points["x"] ** 2 + points["y"] ** 2 + points["z"] ** 2))


_CONSTANTS: Final = {
    "noise": 0,  # the L2 measures no ambient light
    "return_type": 1,  # Autoware's number for "strongest" among single returns
}


def _layout(name: str, meant_for: str, fields: str, itemsize: int) -> Layout:
    """Return a layout from ``name:type@offset`` words."""
    names, formats, offsets = [], [], []
    for word in fields.split():
        field_name, _, rest = word.partition(":")
        code, _, offset = rest.partition("@")
        names.append(field_name)
        formats.append(f"<{code}" if code != "u1" else code)
        offsets.append(int(offset))
    layout: np.dtype[np.void] = np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": itemsize}
    )
    return Layout(name, layout, meant_for)


_XYZ: Final = "x:f4@0 y:f4@4 z:f4@8"

LAYOUTS: Final[dict[str, Layout]] = {
    layout.name: layout
    for layout in (
        Layout("native", POINT, "deskew, KISS-ICP, RKO-LIO, GLIM, RViz"),
        Layout("native_ring", np.dtype([*POINT.descr, ("ring", "<u2")]), "as native, with ring"),
        _layout(
            "velodyne",
            "LIO-SAM, FAST-LIO, rtabmap",
            f"{_XYZ} intensity:f4@12 ring:u2@16 time:f4@18",
            22,
        ),
        _layout(
            "unitree",
            "Point-LIO for Unitree: the vendor's own layout",
            f"{_XYZ} intensity:f4@16 ring:u2@20 time:f4@24",
            32,
        ),
        _layout(
            "ouster_legacy",
            "LIO-SAM with sensor ouster, FAST-LIO with lidar_type 3; range in mm",
            f"{_XYZ} intensity:f4@16 t:u4@20 reflectivity:u2@24 ring:u1@26 noise:u2@28 "
            "range:u4@32",
            48,
        ),
        _layout(
            "hesai",
            "readers of Hesai clouds; timestamp is absolute",
            f"{_XYZ} intensity:f4@12 ring:u2@16 timestamp:f8@18",
            26,
        ),
        _layout(
            "autoware",
            "Autoware (PointXYZIRCAEDT)",
            f"{_XYZ} intensity:u1@12 return_type:u1@13 channel:u2@14 azimuth:f4@16 "
            "elevation:f4@20 distance:f4@24 time_stamp:u4@28",
            32,
        ),
        _layout(
            "xyzi", "costmaps and everything that needs no time", f"{_XYZ} intensity:f4@12", 16
        ),
    )
}
