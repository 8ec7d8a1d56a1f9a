"""Planes that both halves of the fan see: small cells, and large surfaces merged from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64, I64

CELLS_M: Final = (0.4, 0.6)  # edges of the cells of both grids
_FEWEST: Final = 40  # points of a cell
_FEWEST_OF_HALF: Final = 10
_FLATNESS: Final = 0.08  # smallest over middle eigenvalue of a cell's scatter
_THICKEST_M: Final = 0.05
_TRIM: Final = 3.0  # standard deviations
_MOST: Final = 80  # points of a cell: beyond that the surface limits, not the noise
_MOST_LARGE: Final = 3000
_LARGE_CELL_M: Final = 0.6
_LARGE_CELLS: Final = 4
_LARGE_M: Final = 1.2  # standard deviation of a large surface's points along its longer side
_SAME_ANGLE: Final = np.cos(np.deg2rad(10.0))
_SAME_OFFSET_M: Final = 0.05
_SHIFT: Final = np.array(
    [0.137, 0.211, 0.173]
)  # of the grid: walls like to stand on round numbers


class Planes(NamedTuple):
    """Planes and the points on them.

    Attributes
    ----------
    member : ndarray, shape (M,)
        Index of each point on a plane, plane by plane.
    first : ndarray, shape (K,)
        Where the points of each plane begin in ``member``; none is empty.
    center, normal, u, v : ndarray, shape (K, 3)
        Mean [m] and orthonormal axes; u and v lie in the plane.
    spread : ndarray, shape (K, 3)
        Variances of the points along the normal and two axes in the plane, ascending [m^2].
    """

    member: I64
    first: I64
    center: F64
    normal: F64
    u: F64
    v: F64
    spread: F64

    @property
    def plane(self) -> I64:
        """Number of the plane of each member, shape (M,)."""
        return np.repeat(np.arange(len(self.first)), self.counts)

    @property
    def counts(self) -> I64:
        """Points of each plane, shape (K,)."""
        return np.diff(np.append(self.first, len(self.member)))

    def at(self, first: int = 0) -> Planes:
        """Return the same planes of points that are stored plane by plane."""
        return self._replace(member=np.arange(first, first + len(self.member)))

    def heights(self, points: F64) -> F64:
        """Return the distance of each member from its plane [m], shape (M,)."""
        plane = self.plane
        away = points[self.member] - self.center[plane]
        return np.asarray(np.einsum("ni,ni->n", away, self.normal[plane]))


def cells(points: F64, is_far_half: NDArray[np.bool_], groups: I64, most: int = _MOST) -> Planes:
    """Return the flat cells of two grids that hold points of both halves of the fan.

    Parameters
    ----------
    points : ndarray, shape (N, 3)
        [m], each group in a frame of its own.
    is_far_half : ndarray, shape (N,)
        Whether alpha is above 90 degrees.
    groups : ndarray, shape (N,), int
        Planes never hold points of two groups.
    most : int
        Points that a cell keeps.
    """
    return joined([_cells(points, is_far_half, groups, size, most) for size in CELLS_M])


def _cells(
    points: F64, is_far_half: NDArray[np.bool_], groups: I64, size: float, most: int
) -> Planes:
    found = _grid(points, groups, size, is_far_half)
    found = _kept(found, _flat(found))
    found = _trimmed(found, points)
    found = _kept(found, _both_halves(found, is_far_half) & _flat(found))
    return _thinned(found, points, most)


def large(
    points: F64, is_far_half: NDArray[np.bool_], groups: I64, extent: float = _LARGE_M
) -> Planes:
    """Return large flat surfaces, merged from neighboring cells; one half may see them alone.

    Takes ``is_far_half`` to be called as :func:`cells` is. The tolerance is wide enough for a
    surface that a range bias of some centimeters bows. ``extent`` is the least standard deviation
    of a surface's points along its longer side [m].
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    del is_far_half
    found = _grid(points, groups, _LARGE_CELL_M)
    found = _kept(found, _flat(found))
    if not len(found.first):
        return found
    owner = groups[found.member[found.first]]
    # Groups are set apart, so that one search serves all.
    place = found.center + np.outer(owner, [1e4, 0.0, 0.0])
    pairs = cKDTree(place).query_pairs(1.8 * _LARGE_CELL_M, output_type="ndarray")
    one, other = pairs[:, 0], pairs[:, 1]
    between = found.center[other] - found.center[one]
    cosine = np.abs(np.einsum("ni,ni->n", found.normal[one], found.normal[other]))
    offset = np.maximum(
        np.abs(np.einsum("ni,ni->n", between, found.normal[one])),
        np.abs(np.einsum("ni,ni->n", between, found.normal[other])),
    )
    same = (cosine > _SAME_ANGLE) & (offset < _SAME_OFFSET_M)
    count = len(found.first)
    graph = coo_array((np.ones(int(same.sum())), (one[same], other[same])), shape=(count, count))
    label = connected_components(graph, directed=False)[1]
    is_large = np.bincount(label, minlength=count)[label] >= _LARGE_CELLS
    label = np.where(is_large, label, -1)
    merged = _sorted(found.member, label[found.plane], points)
    for _ in range(3):
        merged = _trimmed(merged, points)
    sides = np.sqrt(merged.spread)
    return _thinned(_kept(merged, sides[:, 2] > extent), points, _MOST_LARGE)


def joined(parts: Sequence[Planes]) -> Planes:
    """Return the planes of several sets as one set."""
    offsets = np.cumsum([0, *(len(part.member) for part in parts)])[:-1]
    return Planes(
        np.concatenate([part.member for part in parts]),
        np.concatenate([part.first + offset for part, offset in zip(parts, offsets, strict=True)]),
        *(np.concatenate(values) for values in zip(*(part[2:] for part in parts), strict=True)),
    )


def part(planes: Planes, keep: NDArray[np.bool_], points: F64) -> Planes:
    """Return the planes through some of their members, shape (M,); few remain no plane."""
    found = _sorted(planes.member[keep], planes.plane[keep], points)
    return _kept(found, found.counts >= _FEWEST_OF_HALF)


def refitted(planes: Planes, points: F64) -> Planes:
    """Return the same planes through the same members where these are now."""
    return _fitted(planes.member, planes.first, points)


def products(columns: F64, first: I64, weight: F64 | None = None) -> F64:
    """Return the weighted scalar products of columns (N, C) in each plane, shape (K, C, C)."""
    count = columns.shape[1]
    rows = np.ascontiguousarray(columns.T)
    weighted = rows if weight is None else rows * weight
    found = np.empty((len(first), count, count))
    for i in range(count):
        for j in range(i, count):
            found[:, i, j] = found[:, j, i] = np.add.reduceat(weighted[i] * rows[j], first)
    return found


def _grid(
    points: F64, groups: I64, size: float, is_far_half: NDArray[np.bool_] | None = None
) -> Planes:
    """Return the cells of a grid with enough points, and of both halves where these are given."""
    cell = np.floor(points / size + _SHIFT).astype(np.int64)
    cell -= cell.min(axis=0) if len(cell) else 0
    span = cell.max(axis=0) + 1 if len(cell) else np.ones(3, np.int64)
    key = ((groups * span[0] + cell[:, 0]) * span[1] + cell[:, 1]) * span[2] + cell[:, 2]
    label = np.unique(key, return_inverse=True)[1]
    counts = np.bincount(label)
    enough = counts >= _FEWEST
    if is_far_half is not None:
        far = np.bincount(label, is_far_half)
        enough &= (far >= _FEWEST_OF_HALF) & (counts - far >= _FEWEST_OF_HALF)
    return _sorted(np.arange(len(points)), np.where(enough[label], label, -1), points)


def _sorted(member: I64, key: I64, points: F64) -> Planes:
    """Return planes of members by key; negative keys are left out."""
    member, key = member[key >= 0], key[key >= 0]
    order = np.argsort(key, kind="stable")
    member, key = member[order], key[order]
    is_first = np.ones(len(key), np.bool_)
    is_first[1:] = key[1:] != key[:-1]
    return _fitted(member, np.flatnonzero(is_first), points)


def _fitted(member: I64, first: I64, points: F64) -> Planes:
    if not len(first):
        none = np.empty((0, 3))
        return Planes(member, first, none, none, none, none, none)
    counts = np.diff(np.append(first, len(member)))
    mine = points[member]
    center = np.add.reduceat(mine, first) / counts[:, None]
    scatter = products(mine - np.repeat(center, counts, axis=0), first) / counts[:, None, None]
    values, axes = np.linalg.eigh(scatter)
    return Planes(
        member,
        first,
        center,
        axes[..., 0],
        axes[..., 1],
        axes[..., 2],
        np.maximum(values, 0.0),
    )


def _flat(planes: Planes) -> NDArray[np.bool_]:
    thin, wide = planes.spread[:, 0], planes.spread[:, 1]
    return np.asarray((thin < _FLATNESS * wide) & (thin < _THICKEST_M**2))


def _both_halves(planes: Planes, is_far_half: NDArray[np.bool_]) -> NDArray[np.bool_]:
    if not len(planes.first):
        return np.empty(0, np.bool_)
    far = np.add.reduceat(is_far_half[planes.member].astype(np.int64), planes.first)
    enough = (far >= _FEWEST_OF_HALF) & (planes.counts - far >= _FEWEST_OF_HALF)
    return np.asarray(enough & (planes.counts >= _FEWEST))


def _kept(planes: Planes, keep: NDArray[np.bool_]) -> Planes:
    counts = planes.counts
    member = planes.member[np.repeat(keep, counts)]
    first = np.concatenate(([0], np.cumsum(counts[keep])))[:-1].astype(np.int64)
    return Planes(member, first, *(values[keep] for values in planes[2:]))


def _trimmed(planes: Planes, points: F64) -> Planes:
    """Return the planes without points that stick out, refitted."""
    if not len(planes.first):
        return planes
    height = planes.heights(points)
    spread = np.sqrt(np.add.reduceat(height**2, planes.first) / planes.counts)
    plane = planes.plane
    inside = np.abs(height) <= _TRIM * spread[plane]
    return _sorted(planes.member[inside], plane[inside], points)


def _thinned(planes: Planes, points: F64, most: int) -> Planes:
    """Return the planes with at most so many points each, evenly taken."""
    if not len(planes.first):
        return planes
    counts = planes.counts
    rank = np.arange(len(planes.member)) - np.repeat(planes.first, counts)
    share = np.minimum(1.0, most / counts)[planes.plane]
    taken = np.floor((rank + 1) * share) > np.floor(rank * share)
    return _sorted(planes.member[taken], planes.plane[taken], points)
