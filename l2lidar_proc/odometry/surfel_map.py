"""Surfel map: points binned into cells, a plane fitted to each cell.

A surface averages the range noise of every point that ever fell into its cell, which
nearest-neighbor methods cannot do. Cells come in several sizes; the finest flat one speaks for a
place. Where none is flat (foliage, rock, trunks, cables) a cell still tells where its points are
across the directions in which they are few: less sharply, by their scatter.

Near points count for more than far ones, which are off by the noise of the ranges and by the
attitude. A full cell takes points again from so near that they count for more than those in it. A
wall that lies at the face of two cells needs that: seen from afar, its noise fills both, and the
plane of either is off to its side, by up to 3 cm at 5 m.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import F64, I64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.cell_grid import CellGrid, Groups, levels_of, places_of, shifted
from l2lidar_proc.odometry.cell_index import CellIndex
from l2lidar_proc.odometry.surfels import (
    CELL,
    FLAT,
    Matches,
    are_behind,
    fit,
    matches_with,
    tilts_of,
    weights_from,
)


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
        Points after which a cell changes no more, so that the map does not follow later errors;
        of those to come, where points are weighted.

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
        self._grid = CellGrid(sizes)
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

    def add(
        self,
        points: F64,
        sweep: int = 0,
        apart: NDArray[np.bool_] | None = None,
        origin: F64 | None = None,
        *,
        weighted: bool = False,
    ) -> float:
        """Add points, and return the share of them in places where there were none before.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            [m], map frame.
        sweep : int
            Number of the sweep that they come from.
        apart : ndarray, shape (S,), optional
            Sweeps whose places these points are not known to belong to: they are the first there.
        origin : ndarray, shape (3,), optional
            Where they were seen from [m], map frame.
        weighted : bool
            Whether points near the origin, which then has to be given, count for more.
        """
        if not len(points):
            return 0.0
        self.latest = sweep
        groups = self._grid.groups(points)
        distinct, cell = self._grid.cells_of(groups)
        rows = self._index.find(distinct)
        new = rows == 0
        rows[new] = self._open(distinct[new])
        fresh = self._note_sweep(rows, new, cell, groups.counts, sweep, apart)
        weights = np.ones(len(distinct))
        if weighted and origin is not None:
            weights = weights_from(self._grid.middles(distinct) - origin)
        self._extend(points, groups, rows, distinct, cell, weights, origin)
        return fresh

    def _note_sweep(
        self,
        rows: I64,
        new: NDArray[np.bool_],
        cell: I64,
        counts: F64,
        sweep: int,
        apart: NDArray[np.bool_] | None,
    ) -> float:
        """Note who opened the new cells (C,) among some, and who has seen all of these last.

        The coarsest level tells what is new, finer ones open cells in known walls as well: such a
        place is as old as the coarsest cell around it. Return the share of points in new places.

        Parameters
        ----------
        rows, new : ndarray, shape (C,)
        cell : ndarray, shape (L, G)
            The cells that groups of points lie in.
        counts : ndarray, shape (G,)
            Points of each group.
        sweep : int
        apart : ndarray, shape (S,), optional
        """
        self._cells["seen"][rows] = sweep
        fresh = float(counts[new[cell[-1]]].sum() / counts.sum())
        self._cells["born"][rows[new]] = self._cells["opened"][rows[new]] = sweep
        if fresh < 1.0 and new.any():
            around = np.empty(len(rows), np.int64)
            around[cell] = rows[cell[-1]]
            born = self._cells["born"][around[new]]
            if apart is not None:
                is_apart = apart[np.minimum(born, len(apart) - 1)]
                born = np.where(is_apart, sweep, born)
            self._cells["born"][rows[new]] = born
        return fresh

    def _extend(
        self,
        points: F64,
        groups: Groups,
        rows: I64,
        keys: I64,
        cell: I64,
        weights: F64,
        origin: F64 | None,
    ) -> None:
        """Add points (N, 3) to the sums of their cells (C,), as far as these still change.

        The points of a group all have the weight of its cell, one of some weights (C,). The sums
        of a coarser cell are those of its groups, moved to its middle (parallel axis theorem).
        """
        changing = self._cells["weight"][rows] < self._capacity * weights
        wanted = changing[cell]
        size = len(groups.keys)
        moments = groups.moments(points, np.logical_or.reduce(wanted)) * weights[:size]
        squares = moments[0] * weights[:size]
        middles = self._grid.middles(keys)
        cells = self._cells
        added = np.zeros((11, len(rows)))
        added[:10, :size], added[10, :size] = moments, squares
        for where, fits in zip(cell[1:], wanted[1:], strict=True):
            here = np.flatnonzero(fits)
            numbers = where[here] - size
            some = shifted(moments[:, here], groups.middles[here] - middles[size + numbers])
            bins = len(rows) - size
            lines = (*some, squares[here])
            added[:, size:] += [np.bincount(numbers, line, bins) for line in lines]
        rows, added = rows[changing], added[:, changing]
        grown = records.selected(cells, rows)
        grown["weight"] += added[0]
        grown["squares"] += added[10]
        grown["count"] = grown["weight"] ** 2 / np.maximum(grown["squares"], 1e-300)
        grown["sweeps"] += 1.0
        grown["sum"] += added[1:4].T
        grown["products"] += added[4:10].T
        fitted = np.flatnonzero(
            (grown["count"] >= self._least)
            & (grown["weight"] >= tuning.REFIT_GROWTH * grown["fitted"])
        )
        if len(fitted):
            keys, middles = keys[changing][fitted], middles[changing][fitted]
            sizes = self._grid.sizes[levels_of(keys)]
            kinds = fit(grown, fitted, middles, sizes, self._thickness, origin)
            self._kind[rows[fitted]] = kinds
        records.assign(cells, rows, grown)

    def match(
        self,
        points: F64,
        *,
        narrow: bool = False,
        sizes: Sequence[int] = (),
        origins: F64 | None = None,
    ) -> Matches:
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
        origins : ndarray, shape (N, 3), optional
            Where each point is seen from [m]. A surface that would be seen from behind is not the
            point's: it is the other side of a wall.
        """
        # nearly all points have a surface in the finest level
        finest = self._rows(points, slice(1))
        is_flat = self._kind[finest] == FLAT
        left = np.flatnonzero(~is_flat[0])
        coarser = self._rows(points[left], slice(1, None))
        found = [(finest[is_flat], np.flatnonzero(is_flat), 0)]
        found += [(*item, 0) for item in _taken(coarser, self._kind[coarser] == FLAT, left)]
        if narrow:
            kind = self._kind[coarser]
            bare = _edges(left[~(kind == FLAT).any(axis=0)], sizes or [len(points)])
            rows = self._rows(points[bare], slice(None))
            for row, index in _taken(rows, self._kind[rows] > 0, bare):
                both = self._kind[row] > 1
                found += [(row, index, 0), (row[both], index[both], 1)]
        rows_found, indices, axes = zip(*found, strict=True)
        axis = np.repeat(axes, [len(some) for some in indices])
        row, index = np.concatenate(rows_found), np.concatenate(indices)
        cells = records.selected(self._cells, row)
        if origins is not None:
            behind = are_behind(points[index], origins[index], cells)
            behind &= self._kind[row] == FLAT
            if behind.any():
                seen = np.flatnonzero(~behind)
                row, index, axis = row[seen], index[seen], axis[seen]
                cells = records.selected(cells, seen)
        return matches_with(points, index, row, cells, axis, self._kind[row])

    def are_along(self, points: F64, direction: F64) -> NDArray[np.bool_]:
        """Return which points lie on thin flat surfaces that run along a direction.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            [m], map frame.
        direction : ndarray, shape (3,)
            Unit.
        """
        found = self.match(points)
        thickness2 = self._cells["spread"][found.cells, 0]
        on_wall = (
            (np.abs(found.normals @ direction) < tuning.LINE_WALL_SLOPE)
            & (np.abs(found.distances) < tuning.LINE_WALL_REACH)
            & (thickness2 < tuning.LINE_WALL_THICKNESS**2)
        )
        along = np.zeros(len(points), np.bool_)
        along[found.index[on_wall]] = True
        return along

    def tilts(self, cells: I64, axis: I64) -> F64:
        """Return how far normals may be tilted, (M, 3, 3) [rad], as :func:`tilts_of` has it.

        Parameters
        ----------
        cells, axis : ndarray, shape (M,)
            Of :class:`Matches`; the map must not have changed since.
        """
        return tilts_of(self.surfels(cells), axis)

    def surfels(self, cells: I64) -> NDArray[np.void]:
        """Return what is known about the cells (M,) of some :class:`Matches`, dtype CELL."""
        return records.selected(self._cells, cells)

    def _rows(self, points: F64, levels: slice) -> I64:
        """Return the rows of the cells of some levels that points (N, 3) lie in, (L, N)."""
        keys = self._grid.keys(points, levels)
        return self._index.find(keys.ravel()).reshape(keys.shape)

    def forget(self, origin: F64, distance: float, since: int = 0) -> None:
        """Drop cells farther than a distance [m] from a place (3,), or not seen since a sweep."""
        cells = self._cells[1 : len(self) + 1]
        ways = self._grid.middles(cells["key"]) - origin
        kept = (ways**2).sum(axis=1) <= distance * distance
        kept &= cells["seen"] >= since
        if not kept.all():
            self._drop(1 + np.flatnonzero(~kept))

    def _drop(self, rows: I64) -> None:
        """Drop the cells of some rows, ascending; the last ones of the others take their places.

        The memory stays: what is freed and asked for again comes back in pieces.
        """
        end = len(self) + 1
        left = end - len(rows)
        holes = rows[: np.searchsorted(rows, left)]
        last = np.setdiff1d(np.arange(left, end), rows, assume_unique=True)
        records.assign(self._cells, holes, records.selected(self._cells, last))
        self._kind[holes] = self._kind[last]
        self._cells[left:end] = np.zeros(1, CELL)
        self._kind[left:end] = 0
        self._index.clear()
        self._index.insert(self._cells["key"][1:left].copy(), np.arange(1, left))

    def part_of(self, sweeps: NDArray[np.bool_]) -> SurfelMap:
        """Return a map with the cells of the places that some of the sweeps (S,) saw first."""
        part = SurfelMap(
            self._grid.sizes.tolist(),
            thickness=self._thickness,
            least=self._least,
            capacity=self._capacity,
        )
        part.latest = self.latest
        born = self._cells["born"][1 : len(self) + 1]
        part._take(self, sweeps[np.minimum(born, len(sweeps) - 1)])
        return part

    def _take(self, other: SurfelMap, kept: NDArray[np.bool_]) -> None:
        """Take some of the cells (C,) of another map; this one is empty."""
        rows = np.concatenate(([0], 1 + np.flatnonzero(kept)))
        self._cells = records.selected(other._cells, rows)
        self._kind = other._kind[rows]
        self._index.insert(self._cells["key"][1:].copy(), np.arange(1, len(rows)))

    def flat_cells(self) -> list[tuple[float, I64, F64, F64]]:
        """Return what :meth:`match` knows of flat places, for each size, fine to coarse.

        Edge of the cells [m]; their places as multiples of it (N, 3); a point of each surface
        (N, 3) [m]; unit normals (N, 3).
        """
        order = np.argsort(self._cells["key"][1 : len(self) + 1]) + 1
        flat = order[self._kind[order] == FLAT]
        cells = records.selected(self._cells, flat)
        level = levels_of(cells["key"])
        places, means, normals = places_of(cells["key"]), cells["mean"], cells["axes"][:, 0]
        return [
            (size, places[level == number], means[level == number], normals[level == number])
            for number, size in enumerate(self._grid.sizes.tolist())
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


def _grown(rows: NDArray[Any], size: int) -> NDArray[Any]:
    """Return rows with zeros after them; what is never used stays without memory."""
    grown = np.zeros(size, rows.dtype)
    grown[: len(rows)] = rows
    return grown
