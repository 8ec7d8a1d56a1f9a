"""Gives every point a ring: its elevation above the scanner's base plane in equal steps."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

RINGS: Final = 32
"""Rings over the 90 degrees from horizon to zenith, 2.8 degrees each.

A packet is an arc from horizon to horizon over the zenith, so the scanner has no lines of its own
that go round. Elevation bands do, and that is what projection-based pipelines use a ring for.
"""


def rings(points: NDArray[np.void]) -> NDArray[np.uint16]:
    """Return the ring of every point, 0 at the horizon, counted upwards.

    Parameters
    ----------
    points : ndarray, shape (N,), dtype with x, y, z
        Cloud frame [m].

    Returns
    -------
    ndarray, shape (N,), uint16
        0 to ``RINGS`` - 1; what lies below the horizon (wide field of view) is in ring 0.
    """
    horizontal = np.hypot(points["x"], points["y"])
    elevation = np.arctan2(points["z"], horizontal)
    ring = np.floor(elevation * (RINGS / (np.pi / 2)))
    return np.asarray(np.clip(ring, 0, RINGS - 1), np.uint16)
