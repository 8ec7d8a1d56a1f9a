"""Compressed clouds: ``point_cloud_interfaces/CompressedPointCloud2`` for slow networks.

The zstd plugin of point_cloud_transport hands on what it decompresses as the data of an ordinary
PointCloud2. So what is compressed has to be a cloud that everybody reads: lossy means fewer fields
and coordinates on a grid of about a millimeter, whose last bits are all zero.
"""

from __future__ import annotations

import struct
from typing import Any, Final

import numpy as np
import zstandard
from numpy.typing import NDArray

from l2lidar_node.ros.conversions import CloudTemplate
from l2lidar_node.types import HostNs

GRID_M: Final = 2.0**-10
"""A power of two, so that rounding clears bits of the mantissa; off by 0.5 mm at most."""

_FORMAT: Final = b"zstd\0"
_KEPT: Final = ("x", "y", "z", "intensity")


def on_grid(points: NDArray[np.void]) -> NDArray[np.void]:
    """Return x, y, z, rounded to :data:`GRID_M`, and intensity of points (N,), as float32."""
    names = [name for name in _KEPT if name in (points.dtype.names or ())]
    coarse = np.zeros(len(points), np.dtype([(name, "<f4") for name in names]))
    for name in names:
        if name == "intensity":
            coarse[name] = points[name]
        else:
            coarse[name] = np.round(points[name] * np.float32(1.0 / GRID_M)) * np.float32(GRID_M)
    return coarse


class CompressedCloudTemplate:
    """Makes serialized compressed clouds of one layout and frame.

    Parameters
    ----------
    layout : dtype
        Of the points.
    frame : str
    level : int
        Of zstd.
    is_lossy : bool
        Whether only what :func:`on_grid` leaves is sent.
    """

    def __init__(self, layout: np.dtype[np.void], frame: str, level: int, is_lossy: bool) -> None:
        self._is_lossy = is_lossy
        kept = on_grid(np.zeros(0, layout)).dtype if is_lossy else layout
        self._cloud = CloudTemplate(kept, frame)
        self._zstd = zstandard.ZstdCompressor(level=level)  # the size stands in the frame

    def serialize(self, points: NDArray[np.void], stamp: HostNs) -> bytes:
        """Return the CDR message of finite points, shape (N,), of this template's layout."""
        if self._is_lossy:
            points = on_grid(points)
        data: Any = self._zstd.compress(np.ascontiguousarray(points).view(np.uint8).data)
        body = b"".join(
            (self._cloud.head(len(points), points.nbytes, stamp),
             struct.pack("<I", len(data)), data, b"\x01")  # is_dense
        )  # fmt: skip
        padding = -len(body) % 4  # the encapsulation is four bytes long
        return body + bytes(padding) + struct.pack("<I", len(_FORMAT)) + _FORMAT
