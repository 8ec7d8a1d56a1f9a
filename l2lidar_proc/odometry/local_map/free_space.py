"""Free-space test: finds surfaces of the map that the rays of a sweep pass through."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.odometry.local_map.surfels import are_within


class SeenThrough(NamedTuple):
    """Known surfaces through which the rays to the points of a sweep pass.

    Attributes
    ----------
    share : float
        Of the rays that do. Many mean a wrong pose, or a wrong map.
    sweeps : ndarray of int64, shape (N,)
        For each of these rays, the sweep that was the first at the surface's place.
    """

    share: float
    sweeps: NDArray[np.int64]


def seen_through(surfaces: SurfelMap, origin: F64, points: F64) -> SeenThrough:
    """Return the known surfaces through which the rays to some points pass.

    Parameters
    ----------
    surfaces : SurfelMap
    origin : ndarray, shape (3,)
        Where the rays begin [m], map frame.
    points : ndarray, shape (N, 3)
        Where they end.
    """
    points = points[:: max(len(points) // tuning.RAYS, 1)]
    ways = points - origin
    ranges = np.maximum(np.linalg.norm(ways, axis=1), 1e-9)
    ways = ways / ranges[:, None]
    free = np.minimum(ranges, tuning.RAY_LONGEST) - tuning.RAY_MARGIN - tuning.RAY_FROM
    counts = np.maximum(free / tuning.RAY_STEP, 0.0).astype(np.int64)
    ray = np.repeat(np.arange(len(points)), counts)
    number = np.arange(len(ray)) - np.repeat(np.cumsum(counts) - counts, counts)
    places = origin + ways[ray] * (tuning.RAY_FROM + tuning.RAY_STEP * number)[:, None]
    found = surfaces.match(places)
    cells, planes = surfaces.cells(found.cells), surfaces.planes(found.cells)
    ray = ray[found.index]
    through = (
        (np.abs(found.distances) < tuning.RAY_NEAR)
        & (np.abs(np.einsum("ni,ni->n", found.normals, ways[ray])) > tuning.RAY_FACING)
        & are_within(places[found.index], planes, tuning.RAY_EXTENT)
        & (cells["count"] >= tuning.RAY_POINTS)
        & (cells["sweeps"] >= tuning.RAY_SWEEPS)
    )
    rays, first = np.unique(ray[through], return_index=True)
    born = planes["born"][through][first].astype(np.int64)
    return SeenThrough(len(rays) / max(len(points), 1), born)
