"""Keeps the map of small surfaces: points binned into cells, a plane fitted to each cell.

A surface averages the range noise of every point that ever fell into its cell, which
nearest-neighbor methods cannot do. Cells come in several sizes; the finest flat one speaks for a
place. Where none is flat (foliage, rock, trunks, cables) a cell still tells where its points are
across the directions in which they are few: less sharply, by their scatter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import F64, I64
from l2lidar_proc import tuning

_ODD: Final = np.uint64(0x9E3779B97F4A7C15)  # 2^64 divided by the golden ratio (Knuth, 6.4)
_LEAST_BITS: Final = 10


class CellIndex:
    """Rows by key, for arrays of keys.

    The slot of a key follows from the high bits of its product with a constant (Fibonacci
    hashing); a slot that is taken passes it on to the next one (linear probing). At most half of
    the slots are in use, so most keys are found at once. A binary search of as many random keys
    takes four to five times as long.
    """

    def __init__(self) -> None:
        self.clear()

    def __len__(self) -> int:
        """Return the number of keys."""
        return self._used

    def clear(self) -> None:
        """Forget all keys."""
        self._used = 0
        self._make_slots(_LEAST_BITS)

    def find(self, keys: I64) -> I64:
        """Return the row of each key, 0 for those that are not known.

        Parameters
        ----------
        keys : ndarray, shape (N,)
        """
        slots = self._first_slots(keys)
        rows = self._rows[slots]
        # an empty slot ends the search
        left = np.flatnonzero((self._keys[slots] != keys) & (rows > 0))
        slots, keys = slots[left], keys[left]
        while len(left):
            slots = (slots + 1) & self._last
            found = self._rows[slots]
            rows[left] = found
            others = (self._keys[slots] != keys) & (found > 0)
            left, slots, keys = left[others], slots[others], keys[others]
        return rows

    def insert(self, keys: I64, rows: I64) -> None:
        """Add keys that are not known yet.

        Parameters
        ----------
        keys : ndarray, shape (N,)
            All different.
        rows : ndarray, shape (N,)
            From 1 on.
        """
        self._used += len(keys)
        if 2 * self._used > len(self._rows):
            taken = self._rows > 0
            keys = np.concatenate((self._keys[taken], keys))
            rows = np.concatenate((self._rows[taken], rows))
            self._make_slots((2 * self._used).bit_length())
        slots = self._first_slots(keys)
        while len(keys):
            free = self._rows[slots] == 0
            self._keys[slots[free]], self._rows[slots[free]] = keys[free], rows[free]
            lost = self._rows[slots] != rows  # taken before, or by another of these keys
            keys, rows = keys[lost], rows[lost]
            slots = (slots[lost] + 1) & self._last

    def _make_slots(self, bits: int) -> None:
        self._keys: I64 = np.zeros(1 << bits, np.int64)
        self._rows: I64 = np.zeros(1 << bits, np.int64)
        self._last = (1 << bits) - 1
        self._shift = np.uint64(64 - bits)

    def _first_slots(self, keys: I64) -> I64:
        return ((keys.view(np.uint64) * _ODD) >> self._shift).view(np.int64)


CELL: Final = np.dtype(
    [
        ("key", "<i8"),
        ("count", "<f8"),
        ("sum", "<f8", (3,)),  # [m] of the points' offsets from the cell's middle
        ("products", "<f8", (6,)),  # [m^2] of the offsets: xx xy xz yy yz zz
        ("mean", "<f8", (3,)),  # [m] map frame
        ("axes", "<f8", (3, 3)),  # rows: the normal, then the two axes of the surface; unit
        ("spread", "<f8", (3,)),  # [m^2] variance along each of the axes, ascending
        ("sweeps", "<f8"),  # in which points came
        ("born", "<i8"),  # number of the sweep that was the first at its place
        ("opened", "<i8"),  # number of the sweep whose points opened it
        ("seen", "<i8"),  # number of the latest sweep with points in it
        ("fitted", "<f8"),  # count when mean, axes and spread were computed
    ],
)
"""What is known about a cell."""

_FLAT: Final = 3
"""Kind of a flat cell; that of others is the number of axes along which their points lie close."""

_PAIRS: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
# A key is the number of the level and of the cell along x, y and z.
_BITS: Final = 19
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
        self._sizes = np.array(sizes, dtype=np.float64)
        self._thickness = thickness
        self._least = least
        self._capacity = capacity
        self.latest = 0
        self._index = CellIndex()
        # row 0 is that of all places without a cell
        self._cells: NDArray[np.void] = np.zeros(1, CELL)
        self._kind: NDArray[np.int8] = np.zeros(1, np.int8)  # by row, apart: quickly looked up

    def __len__(self) -> int:
        """Return the number of cells of all sizes."""
        return len(self._index)

    def clear(self) -> None:
        """Forget everything."""
        used = len(self) + 1
        self.latest = 0
        self._index.clear()
        # the arrays stay for the next map: memory freed and asked for again comes back in pieces
        self._cells[:used] = np.zeros(1, CELL)
        self._kind[:used] = 0

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
        keys = self._keys(points).ravel()
        # neighbors in a scan line mostly share a cell: look up runs of equal keys
        begins = np.flatnonzero(np.diff(keys, prepend=-1))
        lengths = np.diff(begins, append=len(keys))
        distinct, cell = np.unique(keys[begins], return_inverse=True)
        rows = self._index.find(distinct)
        new = rows == 0
        rows[new] = self._open(distinct[new])
        fresh = self._note_sweep(rows, new, cell, begins, lengths, len(points), sweep)
        self._extend(points, rows, distinct, cell, lengths)
        return fresh

    def _note_sweep(
        self,
        rows: I64,
        new: NDArray[np.bool_],
        cell: I64,
        begins: I64,
        lengths: I64,
        points: int,
        sweep: int,
    ) -> float:
        """Note who opened the new cells (C,) among some, and who has seen all of these last.

        The coarsest level tells what is new, finer ones open cells in known walls as well: such a
        place is as old as the coarsest cell around it. Return the share of points in new places.

        Parameters
        ----------
        rows, new : ndarray, shape (C,)
        cell : ndarray, shape (R,)
            Which of the cells each run of points is in.
        begins, lengths : ndarray, shape (R,)
            Of the runs, level after level.
        points, sweep : int
        """
        self._cells["seen"][rows] = sweep
        coarsest = begins >= (len(self._sizes) - 1) * points
        fresh = float(lengths[coarsest & new[cell]].sum()) / points
        self._cells["born"][rows[new]] = self._cells["opened"][rows[new]] = sweep
        if fresh < 1.0 and new.any():
            first = np.empty(len(rows), np.int64)
            first[cell[::-1]] = begins[::-1] % points  # the first of its points is written last
            around = np.repeat(rows[cell[coarsest]], lengths[coarsest])
            self._cells["born"][rows[new]] = self._cells["born"][around[first[new]]]
        return fresh

    def _extend(self, points: F64, rows: I64, keys: I64, cell: I64, lengths: I64) -> None:
        """Add points (N, 3) to the sums of their cells (C,), as far as these still change."""
        known = self._cells["count"][rows]
        changing = known < self._capacity
        rows, keys = rows[changing], keys[changing]
        bins = len(rows)
        count = np.bincount(cell, lengths, len(changing))[changing]
        number = np.cumsum(changing) - 1  # of the cells that change
        taken = np.flatnonzero(np.repeat(changing[cell], lengths))
        number = np.repeat(number[cell], lengths)[taken]
        middles = self._middles(keys)
        offsets = points[taken % len(points)] - middles[number]
        x, y, z = np.ascontiguousarray(offsets.T)
        total = np.stack([np.bincount(number, axis, bins) for axis in (x, y, z)], axis=1)
        products = np.stack([np.bincount(number, a * b, bins) for a, b in _pairs(x, y, z)], axis=1)
        cells = self._cells
        cells["count"][rows] = known[changing] + count
        cells["sweeps"][rows] += 1.0
        cells["sum"][rows] += total
        cells["products"][rows] += products
        self._fit(rows, middles)

    def match(self, points: F64, *, narrow: bool = False, sizes: Sequence[int] = ()) -> Matches:
        """Return the surface of every point that has one: the finest at its place.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            [m], map frame.
        narrow : bool
            Points without a flat surface get the narrow directions of the finest cell that has
            any, one or two matches each; but not where most points have one: there the others are
            edges, and scan lines of the map's first sweeps.
        sizes : sequence of int
            Points of each of several sweeps that lie one after the other; what most points have
            is asked for each by itself.
        """
        # nearly all points have a surface in the finest level
        finest = self._rows(points, slice(1))
        is_flat = self._kind[finest] == _FLAT
        left = np.flatnonzero(~is_flat[0])
        coarser = self._rows(points[left], slice(1, None))
        found = [(finest[is_flat], np.flatnonzero(is_flat), 0)]
        found += [(*item, 0) for item in _taken(coarser, self._kind[coarser] == _FLAT, left)]
        if narrow:
            kind = self._kind[coarser]
            bare = _edges(left[~(kind == _FLAT).any(axis=0)], sizes or [len(points)])
            rows = self._rows(points[bare], slice(None))
            for row, index in _taken(rows, self._kind[rows] > 0, bare):
                both = self._kind[row] > 1
                found += [(row, index, 0), (row[both], index[both], 1)]
        rows_found, indices, axes = zip(*found, strict=True)
        axis = np.repeat(axes, [len(some) for some in indices])
        row = np.concatenate(rows_found)
        return _matches(
            points,
            np.concatenate(indices),
            records.selected(self._cells, row),
            axis,
            self._kind[row],
        )

    def _rows(self, points: F64, levels: slice) -> I64:
        """Return the rows of the cells of some levels that points (N, 3) lie in, (L, N)."""
        keys = self._keys(points, levels)
        return self._index.find(keys.ravel()).reshape(keys.shape)

    def forget(self, origin: F64, distance: float, since: int = 0) -> None:
        """Drop cells farther than a distance [m] from a place (3,), or not seen since a sweep."""
        cells = self._cells[1 : len(self) + 1]
        kept = ((self._middles(cells["key"]) - origin) ** 2).sum(axis=1) <= distance * distance
        kept &= cells["seen"] >= since
        if kept.all():
            return
        rows = np.concatenate(([0], 1 + np.flatnonzero(kept)))
        self._cells = records.selected(self._cells, rows)
        self._kind = self._kind[rows]
        self._index.clear()
        self._index.insert(self._cells["key"][1:].copy(), np.arange(1, len(rows)))

    def flat_cells(self) -> list[tuple[float, I64, F64, F64]]:
        """Return what :meth:`match` knows of flat places, for each size, fine to coarse.

        Edge of the cells [m]; their places as multiples of it (N, 3); a point of each surface
        (N, 3) [m]; unit normals (N, 3).
        """
        order = np.argsort(self._cells["key"][1 : len(self) + 1]) + 1
        flat = order[self._kind[order] == _FLAT]
        cells = records.selected(self._cells, flat)
        level = cells["key"] >> 3 * _BITS
        places, means, normals = _places(cells["key"]), cells["mean"], cells["axes"][:, 0]
        return [
            (size, places[level == number], means[level == number], normals[level == number])
            for number, size in enumerate(self._sizes.tolist())
        ]

    def _open(self, keys: I64) -> I64:
        """Return the rows of new cells."""
        first = len(self) + 1
        rows = np.arange(first, first + len(keys))
        self._index.insert(keys, rows)
        if first + len(keys) > len(self._cells):
            size = max(first + len(keys), 2 * len(self._cells))
            self._cells, self._kind = _grown(self._cells, size), _grown(self._kind, size)
        self._cells["key"][rows] = keys
        return rows

    def _fit(self, rows: I64, middles: F64) -> None:
        """Fit planes to cells (C,) that have grown, their middles (C, 3) given."""
        cells = self._cells
        count = cells["count"][rows]
        enough = (count >= self._least) & (count >= tuning.REFIT_GROWTH * cells["fitted"][rows])
        rows, middles, count = rows[enough], middles[enough], count[enough]
        if not len(rows):
            return
        mean = cells["sum"][rows] / count[:, None]
        products = cells["products"][rows] / count[:, None]
        covariance = np.empty((len(rows), 3, 3))
        for column, (i, j) in enumerate(_PAIRS):
            covariance[:, i, j] = products[:, column] - mean[:, i] * mean[:, j]
            covariance[:, j, i] = covariance[:, i, j]
        spread, axes = np.linalg.eigh(covariance)
        spread = np.maximum(spread, 1e-8)
        size = self._sizes[cells["key"][rows] >> 3 * _BITS]
        wide = np.maximum(tuning.ELONGATED * spread[:, 0], (tuning.FLAT_WIDTH * size) ** 2)
        flat = (spread[:, 0] < self._thickness**2) & (spread[:, 1] > wide)
        cells["mean"][rows] = mean + middles
        cells["axes"][rows] = np.swapaxes(axes, 1, 2)
        cells["spread"][rows] = spread
        cells["fitted"][rows] = count
        close = spread[:, :2] < (tuning.NARROW * size[:, None]) ** 2
        close &= (cells["sweeps"][rows] >= tuning.NARROW_SWEEPS)[:, None]
        self._kind[rows] = np.where(flat, _FLAT, close.sum(axis=1))

    def _keys(self, points: F64, levels: slice = slice(None)) -> I64:
        """Return the keys of the cells that points (N, 3) lie in, level by level, (L, N)."""
        numbers = range(len(self._sizes))[levels]
        keys = np.empty((len(numbers), len(points)), np.int64)
        axes = np.ascontiguousarray(points.T)
        for level, key in zip(numbers, keys, strict=True):
            x, y, z = (
                np.floor(axes * (1.0 / self._sizes[level])).astype(np.int64) + _HALF
            ) & _MASK
            np.left_shift(x, _BITS, out=key)
            key |= y
            key <<= _BITS
            key |= z
            key |= level << 3 * _BITS
        return keys

    def _middles(self, keys: I64) -> F64:
        """Return the middles of cells [m], shape (C, 3)."""
        return np.asarray((_places(keys) + 0.5) * self._sizes[keys >> 3 * _BITS][:, None])


def _places(keys: I64) -> I64:
    """Return the places (N, 3) of cells, as multiples of their edge."""
    cell = np.stack((keys >> 2 * _BITS, keys >> _BITS, keys), axis=1) & _MASK
    return np.asarray(cell - _HALF)


def _pairs(x: F64, y: F64, z: F64) -> Iterator[tuple[F64, F64]]:
    """Yield the factors of the products, in their order in a cell."""
    axes = x, y, z
    return ((axes[i], axes[j]) for i, j in _PAIRS)


def _edges(bare: I64, sizes: Sequence[int]) -> I64:
    """Return the points without a flat surface (N,) of those sweeps in which they are many."""
    ends = np.cumsum(sizes)
    places = np.searchsorted(bare, [0, *ends.tolist()])
    parts = zip(places[:-1].tolist(), places[1:].tolist(), sizes, strict=True)
    return np.concatenate(
        [
            bare[first : last if last - first > tuning.EDGE_SHARE * size else first]
            for first, last, size in parts
        ]
    )


def _taken(rows: I64, wanted: NDArray[np.bool_], index: I64) -> Iterator[tuple[I64, I64]]:
    """Yield, level by level, the first wanted of the rows (L, N) of points, and these points.

    ``index`` (N,) names the points.
    """
    free = np.ones(len(index), np.bool_)
    for row, fits in zip(rows, wanted, strict=True):
        here = np.flatnonzero(fits & free)
        free[here] = False
        yield row[here], index[here]


def _matches(
    points: F64, index: I64, cells: NDArray[np.void], axis: I64, kind: NDArray[np.int8]
) -> Matches:
    """Return how far some points are from the middles of their cells (M,) along axes (M,)."""
    offset = points[index] - cells["mean"]
    axes = cells["axes"]
    along = np.einsum("nij,nj->ni", axes, offset)
    spread = cells["spread"]
    # a plane fitted to n points is worst known far from their middle
    reach = 1.0 + along[:, 1] ** 2 / spread[:, 1] + along[:, 2] ** 2 / spread[:, 2]
    each = np.arange(len(index))
    across = spread[each, axis]
    return Matches(
        index,
        axes[each, axis],
        along[each, axis],
        across * reach / cells["count"],
        np.where(kind == _FLAT, 0.0, across),
        cells["born"],
        cells["opened"],
    )


def _grown(rows: NDArray[Any], size: int) -> NDArray[Any]:
    """Return rows with zeros after them; what is never used stays without memory."""
    grown = np.zeros(size, rows.dtype)
    grown[: len(rows)] = rows
    return grown
