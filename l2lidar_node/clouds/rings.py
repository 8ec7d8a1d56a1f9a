"""Gives every point a ring: its elevation as seen from the optical centre, in equal steps.

A packet is an arc from horizon to horizon over the zenith, so this scanner has no lines that go
round. Elevation bands do go round, and projection-based pipelines use a ring for just that.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

RINGS: Final = 150
"""Rings over the 90 degrees from horizon to zenith, 0.6 degrees each.

That is the spacing of the slots: each point of an arc gets a ring of its own. LIO-SAM keeps one
point for each ring and column (0.2 degrees of azimuth at 1800 columns), and the head turns only
0.012 degrees from slot to slot: with wider rings, most points of an arc would share a cell and go.
"""

OPTICAL_CENTRE_M: Final = 0.0445  # height above the mounting face, the same on all units


def rings(points: NDArray[np.void]) -> NDArray[np.uint16]:
    """Return the ring of every point, 0 at the horizon, counted upwards.

    Parameters
    ----------
    points : ndarray, shape (N,), dtype with x, y, z
        Cloud frame [m], finite.

    Returns
    -------
    ndarray, shape (N,), uint16
        0 to ``RINGS`` - 1; what lies below the horizon (wide field of view) is in ring 0.
    """
    horizontal = np.hypot(points["x"], points["y"])
    elevation = np.arctan2(points["z"] - OPTICAL_CENTRE_M, horizontal)
    ring = np.floor(elevation * (RINGS / (np.pi / 2)))
    return np.asarray(np.clip(ring, 0, RINGS - 1), np.uint16)
