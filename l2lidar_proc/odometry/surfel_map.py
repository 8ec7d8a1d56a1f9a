"""Keeps the map of small surfaces: points binned into cells, a plane fitted to each cell.

A surface averages the range noise of every point that ever fell into its cell, which
nearest-neighbour methods cannot do. Cells come in several sizes; the finest flat one speaks for a
place. Where none is flat (foliage, rock, trunks, cables) a cell still tells where its points are
across the directions in which they are few: less sharply, by their scatter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc import tuning

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

CELL: Final = np.dtype(
    [
        ("count", "<f8"),
        ("sum", "<f8", (3,)),  # [m] of the points' offsets from the cell's middle
        ("products", "<f8", (6,)),  # [m^2] of the offsets: xx xy xz yy yz zz
        ("mean", "<f8", (3,)),  # [m] map frame
        ("axes", "<f8", (3, 3)),  # rows: the normal, then the two axes of the surface; unit
        ("spread", "<f8", (3,)),  # [m^2] variance along each of the axes, ascending
        ("sweeps", "<f8"),  # in which points came
        ("born", "<i8"),  # number of the sweep that was the first at its place
        ("opened", "<i8"),  # number of the sweep whose points opened it
        ("fitted", "<f8"),  # count when mean, axes and spread were computed
        ("flat", "?"),
        ("narrow", "<i1"),  # axes of a cell that is not flat along which its points lie close
    ],
    align=True,
)
"""What is known about a cell."""

_PAIRS: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_BITS: Final = 21
_MASK: Final = (1 << _BITS) - 1
_HALF: Final = 1 << (_BITS - 1)


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """The surfaces that points belong to.

    Attributes
    ----------
    index : ndarray, shape (M,)
        Which of the points.
    normals : ndarray, shape (M, 3)
        Unit, map frame, either sign.
    distances : ndarray, shape (M,)
        Of the point from the plane along the normal [m].
    variances : ndarray, shape (M,)
        Of the plane's place under the point [m^2].
    scatter : ndarray, shape (M,)
        Variance of the map's points about the plane where they are no flat surface, else 0 [m^2].
    born : ndarray, shape (M,)
        Number of the sweep that was the first at the surface's place, of the coarsest size.
    opened : ndarray, shape (M,)
        Number of the sweep that opened the surface's own cell.
    """

    index: I64
    normals: F64
    distances: F64
    variances: F64
    scatter: F64
    born: I64
    opened: I64


class SurfelMap:
    """Surfaces of several sizes.

    Parameters
    ----------
    sizes : sequence of float
        Edges of the cells [m], fine to coarse.
    thickness : float
        Largest standard deviation across a surface [m].
    least : int
        Points a surface needs.
    capacity : int
        Points after which a cell changes no more, so that the map does not follow later errors.

    Attributes
    ----------
    latest : int
        Number of the sweep that was added last.
    """

    def __init__(
        self,
        sizes: Sequence[float],
        *,
        thickness: float = 0.03,
        least: int = 8,
        capacity: int = 400,
    ) -> None:
        self._levels = [_Level(size, thickness, least, capacity) for size in sizes]
        self.latest = 0

    def __len__(self) -> int:
        """Return the number of cells of all sizes."""
        return sum(len(level) for level in self._levels)

    def clear(self) -> None:
        """Forget everything."""
        for level in self._levels:
            level.clear()
        self.latest = 0

    def add(self, points: F64, sweep: int = 0) -> float:
        """Add points, and return the share of them in places where there were none before.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            [m], map frame.
        sweep : int
            Number of the sweep that they come from.
        """
        if not len(points):
            return 0.0
        self.latest = sweep
        # the coarsest level tells what is new: finer ones open cells in known walls as well
        *finer, coarsest = self._levels
        fresh = float(coarsest.unknown(points).mean())
        coarsest.add(points, np.full(len(points), sweep), sweep)
        born = coarsest.born_at(points)
        for level in finer:
            level.add(points, born, sweep)
        for level in self._levels:
            level.see(points, sweep)
        return fresh

    def match(self, points: F64, *, narrow: bool = False) -> Matches:
        """Return the surface of every point that has one: the finest at its place.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            [m], map frame.
        narrow : bool
            Points without a flat surface get the narrow directions of the finest cell that has
            any, one or two matches each; but not where most points have one: there the others are
            edges, and scan lines of the map's first sweeps.
        """
        found: list[Matches] = []
        left = np.arange(len(points))
        for level in self._levels:
            cell = level.flat_at(points[left])
            known = cell >= 0
            found.append(_distances(points, left[known], level.cells[cell[known]], 0))
            left = left[~known]
        narrow &= len(left) > tuning.EDGE_SHARE * len(points)
        for level in self._levels if narrow else ():
            cell = level.narrow_at(points[left])
            known = cell >= 0
            cells = level.cells[cell[known]]
            found.append(_distances(points, left[known], cells, 0))
            both = cells["narrow"] > 1
            found.append(_distances(points, left[known][both], cells[both], 1))
            left = left[~known]
        columns = zip(*map(_columns, found), strict=True)
        return Matches(*(np.concatenate(column) for column in columns))

    def forget(self, origin: F64, distance: float, since: int = 0) -> None:
        """Drop cells farther than a distance [m] from a place (3,), or not seen since a sweep."""
        for level in self._levels:
            level.forget(origin, distance, since)

    def flat_cells(self) -> list[tuple[float, I64, F64, F64]]:
        """Return what :meth:`match` knows of flat places, for each size, fine to coarse.

        Edge of the cells [m]; their places as multiples of it (N, 3); a point of each surface
        (N, 3) [m]; unit normals (N, 3).
        """
        return [level.flat_cells() for level in self._levels]

    def points(self) -> F64:
        """Return the middles of the finest level's surfaces [m], shape (N, 3), map frame."""
        return self._levels[0].points()


def _distances(points: F64, index: I64, cells: NDArray[np.void], axis: int) -> Matches:
    """Return how far some points are from the middles of their cells along an axis of these."""
    offset = points[index] - cells["mean"]
    along = np.einsum("nij,nj->ni", cells["axes"], offset)
    spread = cells["spread"]
    # a plane fitted to n points is worst known far from their middle
    reach = 1.0 + along[:, 1] ** 2 / spread[:, 1] + along[:, 2] ** 2 / spread[:, 2]
    scatter = np.where(cells["flat"], 0.0, spread[:, axis])
    return Matches(
        index,
        cells["axes"][:, axis],
        along[:, axis],
        spread[:, axis] * reach / cells["count"],
        scatter,
        cells["born"],
        cells["opened"],
    )


def _columns(found: Matches) -> tuple[NDArray[np.generic], ...]:
    return tuple(getattr(found, item.name) for item in dataclasses.fields(found))


class _Level:
    """Cells of one size: rows of ``cells``, found through a sorted array of keys."""

    def __init__(self, size: float, thickness: float, least: int, capacity: int) -> None:
        self._size = size
        self._thickness = thickness
        self._least = least
        self._capacity = capacity
        self._keys: I64 = np.empty(0, np.int64)
        self._rows: I64 = np.empty(0, np.int64)
        self.cells: NDArray[np.void] = np.zeros(1, CELL)
        # by row, compact copies for look-ups
        self._flat: NDArray[np.bool_] = np.zeros(1, np.bool_)
        self._narrow: NDArray[np.bool_] = np.zeros(1, np.bool_)
        self._count: I64 = np.zeros(1, np.int64)
        self._seen: I64 = np.zeros(1, np.int64)  # number of the latest sweep with points in it

    def clear(self) -> None:
        used = len(self._keys)
        self._keys, self._rows = np.empty(0, np.int64), np.empty(0, np.int64)
        # the arrays stay for the next map: memory freed and asked for again comes back in pieces
        self.cells[:used] = np.zeros(1, CELL)
        self._flat[:used] = self._narrow[:used] = False
        self._count[:used] = 0

    def __len__(self) -> int:
        return len(self._keys)

    def flat_at(self, points: F64) -> I64:
        """Return the row of the flat cell each point lies in, -1 where there is none."""
        return self._rows_at(points, self._flat)

    def narrow_at(self, points: F64) -> I64:
        """Return the row of the narrow cell each point lies in, -1 where there is none."""
        return self._rows_at(points, self._narrow)

    def _rows_at(self, points: F64, wanted: NDArray[np.bool_]) -> I64:
        rows = self._find(self._key(points))
        known = rows >= 0
        rows[known] = np.where(wanted[rows[known]], rows[known], -1)
        return rows

    def unknown(self, points: F64) -> NDArray[np.bool_]:
        """Return which points lie in no cell yet."""
        return np.asarray(self._find(self._key(points)) < 0)

    def born_at(self, points: F64) -> I64:
        """Return the number of the sweep that opened the cell of each point; all have one."""
        return np.asarray(self.cells["born"][self._find(self._key(points))])

    def add(self, points: F64, born: I64, sweep: int) -> None:
        every = self._key(points)
        rows = self._find(every)
        opened = (rows < 0) | (self._count[rows] < self._capacity)
        points = points[opened]
        keys, first, inverse = np.unique(every[opened], return_index=True, return_inverse=True)
        known = len(self._keys)
        rows = self._rows_of(keys)
        new = rows >= known
        self.cells["born"][rows[new]] = born[opened][first[new]]
        self.cells["opened"][rows[new]] = sweep
        middles = self._middle(keys)
        offsets = points - middles[inverse]
        bins = len(keys)
        count = np.bincount(inverse, minlength=bins)
        total = np.stack([np.bincount(inverse, axis, bins) for axis in offsets.T], axis=1)
        products = np.stack(
            [np.bincount(inverse, offsets[:, i] * offsets[:, j], bins) for i, j in _PAIRS], axis=1
        )
        self._count[rows] += count
        self.cells["count"][rows] = self._count[rows]
        self.cells["sweeps"][rows] += 1.0
        self.cells["sum"][rows] += total
        self.cells["products"][rows] += products
        self._fit(rows, middles)

    def see(self, points: F64, sweep: int) -> None:
        """Note that a sweep had points in their cells, which all exist."""
        self._seen[self._find(self._key(points))] = sweep

    def forget(self, origin: F64, distance: float, since: int) -> None:
        kept = ((self._middle(self._keys) - origin) ** 2).sum(axis=1) <= distance * distance
        kept &= self._seen[self._rows] >= since
        if kept.all():
            return
        rows = self._rows[kept]
        self._keys, self._rows = self._keys[kept], np.arange(len(rows))
        self.cells, self._flat = self.cells[rows].copy(), self._flat[rows]
        self._count, self._narrow = self._count[rows], self._narrow[rows]
        self._seen = self._seen[rows]
        self._reserve(1)

    def points(self) -> F64:
        used = self.cells[: len(self._keys)]
        return np.asarray(used["mean"][used["flat"]])

    def _fit(self, rows: I64, middles: F64) -> None:
        count = self._count[rows]
        enough = (count >= self._least) & (
            count >= tuning.REFIT_GROWTH * self.cells["fitted"][rows]
        )
        rows, middles = rows[enough], middles[enough]
        if not len(rows):
            return
        count = self.cells["count"][rows][:, None]
        mean = self.cells["sum"][rows] / count
        products = self.cells["products"][rows] / count
        covariance = np.empty((len(rows), 3, 3))
        for column, (i, j) in enumerate(_PAIRS):
            covariance[:, i, j] = products[:, column] - mean[:, i] * mean[:, j]
            covariance[:, j, i] = covariance[:, i, j]
        spread, axes = np.linalg.eigh(covariance)
        spread = np.maximum(spread, 1e-8)
        wide = np.maximum(tuning.ELONGATED * spread[:, 0], (tuning.FLAT_WIDTH * self._size) ** 2)
        flat = (spread[:, 0] < self._thickness**2) & (spread[:, 1] > wide)
        self.cells["mean"][rows] = mean + middles
        self.cells["axes"][rows] = np.swapaxes(axes, 1, 2)
        self.cells["spread"][rows] = spread
        self.cells["flat"][rows] = flat
        self._flat[rows] = flat
        close = spread[:, :2] < (tuning.NARROW * self._size) ** 2
        close &= (self.cells["sweeps"][rows] >= tuning.NARROW_SWEEPS)[:, None] & ~flat[:, None]
        self.cells["narrow"][rows] = close.sum(axis=1)
        self._narrow[rows] = close[:, 0]
        self.cells["fitted"][rows] = count[:, 0]

    def _key(self, points: F64) -> I64:
        cell = np.floor(points * (1.0 / self._size)).astype(np.int64) + _HALF
        return np.asarray((cell[:, 0] << 2 * _BITS) | (cell[:, 1] << _BITS) | cell[:, 2])

    def flat_cells(self) -> tuple[float, I64, F64, F64]:
        flat = self._flat[self._rows]
        rows = self._rows[flat]
        normals = self.cells["axes"][:, 0][rows]
        return self._size, _places(self._keys[flat]), self.cells["mean"][rows], normals

    def _middle(self, keys: I64) -> F64:
        return np.asarray((_places(keys) + 0.5) * self._size)

    def _find(self, keys: I64) -> I64:
        if not len(self._keys):
            return np.full(len(keys), -1)
        place = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        return np.where(self._keys[place] == keys, self._rows[place], -1)

    def _rows_of(self, keys: I64) -> I64:
        """Return the row of each key (ascending, unique), making rows for new ones."""
        rows = self._find(keys)
        new = np.flatnonzero(rows < 0)
        if len(new):
            first = len(self._keys)
            rows[new] = np.arange(first, first + len(new))
            place = np.searchsorted(self._keys, keys[new])
            self._keys = np.insert(self._keys, place, keys[new])
            self._rows = np.insert(self._rows, place, rows[new])
            self._reserve(first + len(new))
        return rows

    def _reserve(self, count: int) -> None:
        if count > len(self.cells):
            size = max(count, 2 * len(self.cells))
            self.cells = _grown(self.cells, size)
            self._flat, self._narrow = _grown(self._flat, size), _grown(self._narrow, size)
            self._count, self._seen = _grown(self._count, size), _grown(self._seen, size)


def _places(keys: I64) -> I64:
    """Return the places (N, 3) of cells, as multiples of their edge."""
    cell = np.stack((keys >> 2 * _BITS, (keys >> _BITS) & _MASK, keys & _MASK), axis=1)
    return cell - _HALF


def _grown(rows: NDArray[Any], size: int) -> NDArray[Any]:
    """Return rows with zeros after them; what is never used stays without memory."""
    grown = np.zeros(size, rows.dtype)
    grown[: len(rows)] = rows
    return grown
