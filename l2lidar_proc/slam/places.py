"""Place search in plan: correlates bird's-eye images of upright structure by FFT.

Gravity fixes roll and pitch, so a place has four unknowns. x, y and yaw come from here, the height
and the verdict from registration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from l2lidar_proc.slam.submap import STRUCTURE_CELL_M

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

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
    """Where one structure lies on another.

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


def anywhere(query: F64, target: F64, count: int) -> list[Place]:
    """Return the best places in all of a map, best first; see :func:`near`."""
    if min(len(query), len(target)) < _FEWEST:
        return []
    yaws = np.arange(_GLOBAL_YAWS) * (2.0 * np.pi / _GLOBAL_YAWS)
    return _distinct(_correlated(query, target, yaws, _GLOBAL_CELL_M), count)


def _correlated(query: F64, target: F64, yaws: NDArray[Any], cell: float) -> list[Place]:
    """Return the places with the highest correlation at each yaw."""
    reach = float(np.linalg.norm(query, axis=1).max()) + cell
    low = target.min(axis=0) - reach
    size = np.ceil((target.max(axis=0) + reach - low) / cell).astype(int) + 2
    shape = tuple(fft.next_fast_len(int(n) + int(2 * reach / cell) + 2, real=True) for n in size)
    image = np.zeros(shape, np.float32)
    index = np.floor((target - low) / cell).astype(int)
    image[index[:, 0], index[:, 1]] = 1.0
    beside = ndimage.maximum_filter(image, size=3)
    spectrum = fft.rfft2(np.maximum(image, np.float32(_BESIDE) * beside))
    # what correlation at an offset means: the query's origin in the target's frame
    axes = [low[i] + reach + np.arange(int(size[i])) * cell for i in range(2)]
    found: list[Place] = []
    for yaw in yaws:
        turned = np.unique(np.floor(_turned(query, yaw) / cell + 0.5), axis=0) * cell
        part = np.zeros(shape, np.float32)
        at = np.floor((turned + reach) / cell + 0.5).astype(int)
        part[at[:, 0], at[:, 1]] = 1.0
        score = fft.irfft2(spectrum * np.conj(fft.rfft2(part)), shape)
        score = score[: int(size[0]), : int(size[1])] / len(turned)
        score = score.ravel()
        best = np.argpartition(-score, min(_PER_YAW, len(score) - 1))[:_PER_YAW]
        rows, columns = np.divmod(best, int(size[1]))
        found += [
            # a cell's middle on a cell's middle: the origins are half a cell apart
            Place(float(axes[0][i] + cell / 2), float(axes[1][j] + cell / 2), float(yaw), float(s))
            for i, j, s in zip(rows, columns, score[best], strict=True)
            if s > 0.0
        ]
    return found


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
