"""Follows LIO-SAM's projection of points to an image, which keeps one point for each cell."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

COLUMNS: Final = 1800
"""``Horizon_SCAN`` of our configuration for LIO-SAM: 0.2 degrees each."""


def kept_share(ring: NDArray[np.int64], x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Return the share of points, 0 to 1, that are the first of their cell.

    Parameters
    ----------
    ring : ndarray, shape (N,), int64
        Row of each point.
    x, y : ndarray, shape (N,)
        Finite [m].
    """
    if not len(ring):
        return 1.0
    degrees = np.degrees(np.arctan2(x, y))
    column = COLUMNS // 2 - np.round((degrees - 90.0) / (360.0 / COLUMNS)).astype(np.int64)
    column %= COLUMNS
    return len(np.unique(ring * COLUMNS + column)) / len(ring)
