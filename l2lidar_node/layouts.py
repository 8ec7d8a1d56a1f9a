"""Names the point layouts clouds can be published in, and turns POINT records into them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.rings import rings
from l2lidar_node.types import POINT, Sweep

NATIVE_RING: Final = np.dtype([*POINT.descr, ("ring", "<u2")])


class Layout(NamedTuple):
    """A point layout.

    Attributes
    ----------
    dtype : dtype
        Of one point as published.
    convert : callable
        Takes a sweep, returns its points in ``dtype``, shape (N,).
    """

    dtype: np.dtype[np.void]
    convert: Callable[[Sweep], NDArray[np.void]]


def _native(sweep: Sweep) -> NDArray[np.void]:
    return sweep.points


def _native_ring(sweep: Sweep) -> NDArray[np.void]:
    points = np.empty(len(sweep.points), NATIVE_RING)
    for name in POINT.names or ():
        points[name] = sweep.points[name]
    points["ring"] = rings(sweep.points)
    return points


LAYOUTS: Final[dict[str, Layout]] = {
    "native": Layout(POINT, _native),
    "native_ring": Layout(NATIVE_RING, _native_ring),
}
