"""Place correlation: matches bird's-eye images of vertical structure by FFT.

Gravity fixes roll and pitch, so a place has four unknowns. x, y and yaw come from here, the height
and the verdict from registration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from l2lidar_node.types import F64
from l2lidar_proc.slam.submap import STRUCTURE_CELL_M

_BESIDE: Final = 0.6  # what structure one cell off counts
_APART: Final = (1.0, np.radians(12.0))  # [m, rad] peaks closer than this are one place
_PER_YAW: Final = 60  # cells of each yaw that may become peaks
_FEWEST: Final = 8  # cells of structure: with fewer there is nothing to recognize
_NEAR_CELLS: Final = 400  # of the query's cells take part in a search around a guess
_LEAST_YAW: Final = np.radians(0.5)
_GLOBAL_CELL_M: Final = 0.5
_GLOBAL_YAWS: Final = 72


@dataclass(frozen=True, slots=True)
class Place:
    """Pose of one structure on another.

    Attributes
    ----------
    x, y : float
        Origin of the query in the target's frame [m].
    yaw : float
        [rad]
    score : float
        Part of the query's structure that lies on structure of the target, 0 to 1.
    """

    x: float
    y: float
    yaw: float
    score: float


def near(
    query: F64, target: F64, guess: Place, radius: float, yaw_radius: float, count: int
) -> list[Place]:
    """Return the best places around a guess.

    Parameters
    ----------
    query, target : ndarray, shape (N, 2)
        Middles of cells that hold upright structure [m], each in its own frame.
    guess : Place
    radius : float
        Distance from the guess within which to look [m].
    yaw_radius : float
        [rad]
    count : int
        Largest number of places.
    """
    if min(len(query), len(target)) < _FEWEST:
        return []
    query = query[:: max(len(query) // _NEAR_CELLS, 1)]
    extent = max(float(np.abs(query).max()), 1.0)
    steps = min(int(np.ceil(yaw_radius / max(2.0 * STRUCTURE_CELL_M / extent, _LEAST_YAW))), 60)
    yaws = guess.yaw + np.linspace(-yaw_radius, yaw_radius, 2 * steps + 1)
    origin = np.array([guess.x, guess.y])
    reach = int(np.ceil(radius / STRUCTURE_CELL_M))
    margin = int(np.ceil(np.sqrt(2.0) * extent / STRUCTURE_CELL_M)) + reach + 2
    cells = np.floor((target - origin) / STRUCTURE_CELL_M).astype(int) + margin
    cells = cells[((cells >= 0) & (cells < 2 * margin)).all(axis=1)]
    image = np.zeros((2 * margin, 2 * margin), np.float32)
    image[cells[:, 0], cells[:, 1]] = 1.0
    image = np.maximum(image, np.float32(_BESIDE) * ndimage.maximum_filter(image, size=3)).ravel()
    steps_1d = np.arange(-reach, reach + 1)
    dx, dy = (axis.ravel() for axis in np.meshgrid(steps_1d, steps_1d, indexing="ij"))
    inside = np.hypot(dx, dy) <= reach
    dx, dy = dx[inside], dy[inside]
    found: list[Place] = []
    for yaw in yaws:
        at = np.floor(_turned(query, yaw) / STRUCTURE_CELL_M).astype(int) + margin
        flat = at[:, 0] * (2 * margin) + at[:, 1]
        score = image[flat[:, None] + (dx * (2 * margin) + dy)[None]].mean(axis=0)
        for k in np.argsort(-score)[:_PER_YAW]:
            x, y = guess.x + dx[k] * STRUCTURE_CELL_M, guess.y + dy[k] * STRUCTURE_CELL_M
            found.append(Place(float(x), float(y), float(yaw), float(score[k])))
    return _distinct(found, count)


def anywhere(query: F64, target: F64, around: F64, radius: float, count: int) -> list[Place]:
    """Return the best places in all of a map, best first.

    Parameters
    ----------
    query, target : ndarray, shape (N, 2)
        As :func:`near`.
    around : ndarray, shape (K, 2)
        Places that the map was seen from [m], target frame.
    radius : float
        Distance from one of these within which the query's origin has to be [m].
    count : int
        Largest number of places.
    """
    if min(len(query), len(target)) < _FEWEST:
        return []
    cell = _GLOBAL_CELL_M
    low = np.minimum(target.min(axis=0), around.min(axis=0) - radius) - cell
    high = np.maximum(target.max(axis=0), around.max(axis=0) + radius) + cell
    # what leaves the map on one side must not come back on the other
    beyond = float(np.linalg.norm(query, axis=1).max()) + 2.0 * cell
    shape = tuple(
        fft.next_fast_len(int(np.ceil(extent / cell)), real=True)
        for extent in (high - low + beyond).tolist()
    )
    image = np.zeros(shape, np.float32)
    index = np.floor((target - low) / cell).astype(int)
    image[index[:, 0], index[:, 1]] = 1.0
    beside = ndimage.maximum_filter(image, size=3)
    spectrum = fft.rfft2(np.maximum(image, np.float32(_BESIDE) * beside))
    allowed = _cells_around((around - low) / cell, radius / cell, shape)
    found: list[Place] = []
    for yaw in np.arange(_GLOBAL_YAWS // 2) * (2.0 * np.pi / _GLOBAL_YAWS):
        part = np.zeros(shape, np.float32)
        at = np.floor(_turned(query, yaw) / cell + 0.5).astype(int)
        part[at[:, 0], at[:, 1]] = 1.0  # about the corner: negative indices are the far sides
        own = fft.rfft2(part)
        # half a turn more conjugates the spectrum
        for heading, product in ((yaw, spectrum * np.conj(own)), (yaw + np.pi, spectrum * own)):
            score = fft.irfft2(product, shape).ravel()[allowed] / part.sum()
            best = np.argpartition(-score, min(_PER_YAW, len(score) - 1))[:_PER_YAW]
            rows, columns = np.divmod(allowed[best], shape[1])
            # a cell's middle on a cell's middle: the origins are half a cell apart
            x, y = low[0] + (rows + 0.5) * cell, low[1] + (columns + 0.5) * cell
            found += [
                Place(float(x[n]), float(y[n]), float(heading), float(score[k]))
                for n, k in enumerate(best)
                if score[k] > 0.0
            ]
    return _distinct(found, count)


def _cells_around(places: F64, radius: float, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the cells within a radius of places (K, 2), both in cells, as flat indices."""
    steps = np.arange(-int(radius), int(radius) + 1)
    dx, dy = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    inside = np.hypot(dx, dy) <= radius
    cells = np.floor(places).astype(int)
    mask = np.zeros(shape, np.bool_)
    mask[cells[:, :1] + dx[inside], cells[:, 1:] + dy[inside]] = True
    return np.flatnonzero(mask)


def _distinct(places: list[Place], count: int) -> list[Place]:
    """Return the best places that are not beside a better one."""
    kept: list[Place] = []
    for place in sorted(places, key=lambda other: -other.score):
        if all(_apart(place, other) for other in kept):
            kept.append(place)
            if len(kept) == count:
                break
    return kept


def _apart(one: Place, other: Place) -> bool:
    turn = (one.yaw - other.yaw + np.pi) % (2.0 * np.pi) - np.pi
    return bool(np.hypot(one.x - other.x, one.y - other.y) > _APART[0] or abs(turn) > _APART[1])


def _turned(points: F64, yaw: float) -> F64:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))
