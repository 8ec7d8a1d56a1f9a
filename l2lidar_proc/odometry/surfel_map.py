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
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import F64, I64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.cell_index import CellIndex
from l2lidar_proc.odometry.principal_axes import principal_axes

CELL: Final = np.dtype(
    [
        ("key", "<i8"),
        ("weight", "<f8"),  # sum of the points' weights
        ("squares", "<f8"),  # of the squares of the weights
        ("count", "<f8"),  # of points with equal weights that are worth as much (Kish 1965)
        ("sum", "<f8", (3,)),  # [m] weighted, of the points' offsets from the cell's middle
        ("products", "<f8", (6,)),  # [m^2] weighted, of the offsets: xx xy xz yy yz zz
        ("mean", "<f8", (3,)),  # [m] map frame
        ("axes", "<f8", (3, 3)),  # rows: the normal, then the two axes of the surface; unit
        ("spread", "<f8", (3,)),  # [m^2] variance along each of the axes, ascending
        ("sweeps", "<f8"),  # in which points came
        ("born", "<i8"),  # number of the sweep that was the first at its place
        ("opened", "<i8"),  # number of the sweep whose points opened it
        ("seen", "<i8"),  # number of the latest sweep with points in it
        ("fitted", "<f8"),  # weight when mean, axes and spread were computed
        ("sided", "<i8"),  # from which sides its points were seen, as _NO_SIDE and others
    ],
)
"""What is known about a cell."""

# Sides from which the points of a cell were seen: nobody said; the one that the normal points to;
# both. A flat cell with points from both is a board. A wall is thicker, and has two surfaces.
_NO_SIDE, _ONE_SIDE, _BOTH_SIDES = 0, 1, 2

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
    is_fine : ndarray, shape (M,)
        Whether that cell is one of the finest: what lies in a coarse one off its surface may be
        new, what lies in a fine one contradicts it.
    cells : ndarray, shape (M,)
        The cells of the surfaces, as :meth:`SurfelMap.tilts` takes them; until the map changes.
    axis : ndarray, shape (M,)
        Which of its cell's axes a surface's normal is.
    """

    index: I64
    normals: F64
    distances: F64
    variances: F64
    scatter: F64
    born: I64
    opened: I64
    is_fine: NDArray[np.bool_]
    cells: I64
    axis: I64


@dataclass(frozen=True, slots=True, eq=False)
class _Groups:
    """Points by cell of the finest level.

    Attributes
    ----------
    group : ndarray, shape (N,)
        Of each point.
    keys : ndarray, shape (G,)
        Ascending.
    middles : ndarray, shape (G, 3)
        Of the cells [m].
    counts : ndarray, shape (G,)
        Points of each.
    """

    group: I64
    keys: I64
    middles: F64
    counts: F64

    def moments(self, points: F64, wanted: NDArray[np.bool_]) -> F64:
        """Return count, sum and products of the points' offsets from the middles, (10, G).

        Of groups that are not wanted (G,) they are 0.
        """
        taken = np.flatnonzero(wanted[self.group])
        group = self.group[taken]
        middles = np.ascontiguousarray(self.middles.T)
        x, y, z = (
            axis[taken] - middle[group] for axis, middle in zip(points.T, middles, strict=True)
        )
        sums = [np.bincount(group, line, len(self.keys)) for line in (x, y, z, *products(x, y, z))]
        return np.stack((np.where(wanted, self.counts, 0.0), *sums))


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
        groups = self._groups(points)
        distinct, cell = self._cells_of(groups)
        rows = self._index.find(distinct)
        new = rows == 0
        rows[new] = self._open(distinct[new])
        fresh = self._note_sweep(rows, new, cell, groups.counts, sweep, apart)
        weights = np.ones(len(distinct))
        if weighted and origin is not None:
            weights = _weights(self._middles(distinct) - origin)
        self._extend(points, groups, rows, distinct, cell, weights, origin)
        return fresh

    def _groups(self, points: F64) -> _Groups:
        """Return which points (N, 3) lie in the same cell of the finest level."""
        keys = self._keys(points, slice(1))[0]
        # neighbors in a scan line mostly share a cell: look up runs of equal keys
        begins = np.flatnonzero(np.diff(keys, prepend=-1))
        lengths = np.diff(begins, append=len(keys))
        distinct, group = np.unique(keys[begins], return_inverse=True)
        counts = np.bincount(group, lengths, len(distinct)).astype(np.float64)
        return _Groups(np.repeat(group, lengths), distinct, self._middles(distinct), counts)

    def _cells_of(self, groups: _Groups) -> tuple[I64, I64]:
        """Return the cells (C,) of all levels that groups (G,) lie in, and which is whose (L, G).

        A group belongs to the coarser cells around its middle, so the sizes need not be multiples.
        """
        coarser = self._keys(groups.middles, slice(1, None))
        found = [groups.keys]
        cell = np.empty((len(self._sizes), len(groups.keys)), np.int64)
        cell[0] = np.arange(len(groups.keys))
        first = len(groups.keys)
        for keys, where in zip(coarser, cell[1:], strict=True):
            distinct, number = np.unique(keys, return_inverse=True)
            where[:] = first + number
            found.append(distinct)
            first += len(distinct)
        return np.concatenate(found), cell

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
        groups: _Groups,
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
        middles = self._middles(keys)
        cells = self._cells
        added = np.zeros((11, len(rows)))
        added[:10, :size], added[10, :size] = moments, squares
        for where, fits in zip(cell[1:], wanted[1:], strict=True):
            here = np.flatnonzero(fits)
            numbers = where[here] - size
            some = _shifted(moments[:, here], groups.middles[here] - middles[size + numbers])
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
            self._kind[rows[fitted]] = self._fit(grown, fitted, middles[changing][fitted], origin)
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
        row, index = np.concatenate(rows_found), np.concatenate(indices)
        cells = records.selected(self._cells, row)
        if origins is not None:
            behind = _are_behind(points[index], origins[index], cells)
            behind &= self._kind[row] == _FLAT
            if behind.any():
                seen = np.flatnonzero(~behind)
                row, index, axis = row[seen], index[seen], axis[seen]
                cells = records.selected(cells, seen)
        return _matches(
            points,
            index,
            row,
            cells,
            axis,
            self._kind[row],
        )

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
        """Return how far normals may be tilted towards each axis of their cells, 1 sigma.

        A plane fitted to points of extent l and scatter s is tilted by s / l / sqrt(n) (the first
        order of the eigenvectors' errors). The sweeps are counted, not the points: those of one
        sweep err together.

        Parameters
        ----------
        cells, axis : ndarray, shape (M,)
            Of :class:`Matches`; the map must not have changed since.

        Returns
        -------
        ndarray, shape (M, 3, 3)
            Row i is the cell's axis i, as long as the normal's tilt towards it [rad]; zero for
            the normal itself.
        """
        some = records.selected(self._cells, cells)
        each = np.arange(len(cells))
        spread = some["spread"]
        across = np.maximum(spread[each, axis], tuning.NORMAL_SCATTER**2) / some["sweeps"]
        angles = np.sqrt(across[:, None] / np.maximum(spread, tuning.NORMAL_LEAST_EXTENT**2))
        angles[each, axis] = 0.0
        return np.asarray(some["axes"] * angles[:, :, None])

    def rays_through(self, origin: F64, points: F64) -> float:
        """Return the share of the rays to some points that pass through known surfaces.

        What a ray passes through is not there: many such rays mean a wrong pose, or a wrong map.

        Parameters
        ----------
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
        found = self.match(places)
        cells = records.selected(self._cells, found.cells)
        ray = ray[found.index]
        offset = places[found.index] - cells["mean"]
        beside = np.einsum("nij,nj->ni", cells["axes"][:, 1:], offset) ** 2
        through = (
            (np.abs(found.distances) < tuning.RAY_NEAR)
            & (np.abs(np.einsum("ni,ni->n", found.normals, ways[ray])) > tuning.RAY_FACING)
            & (beside < tuning.RAY_EXTENT**2 * cells["spread"][:, 1:]).all(axis=1)
            & (cells["count"] >= tuning.RAY_POINTS)
            & (cells["sweeps"] >= tuning.RAY_SWEEPS)
        )
        return len(np.unique(ray[through])) / max(len(points), 1)

    def _rows(self, points: F64, levels: slice) -> I64:
        """Return the rows of the cells of some levels that points (N, 3) lie in, (L, N)."""
        keys = self._keys(points, levels)
        return self._index.find(keys.ravel()).reshape(keys.shape)

    def forget(self, origin: F64, distance: float, since: int = 0) -> None:
        """Drop cells farther than a distance [m] from a place (3,), or not seen since a sweep."""
        cells = self._cells[1 : len(self) + 1]
        kept = ((self._middles(cells["key"]) - origin) ** 2).sum(axis=1) <= distance * distance
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
            self._sizes.tolist(),
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

    def _fit(
        self, cells: NDArray[np.void], rows: I64, middles: F64, origin: F64 | None
    ) -> NDArray[np.int8]:
        """Fit planes to some (M,) of the cells, their middles (M, 3) given; return their kinds.

        Normals point to an origin (3,) of the latest points, if there is one.
        """
        weight = cells["weight"][rows]
        mean = cells["sum"][rows] / weight[:, None]
        covariance = cells["products"][rows].T / weight
        for line, product in zip(covariance, products(*mean.T), strict=True):
            line -= product
        spread, axes = principal_axes(covariance)
        spread = np.maximum(spread, 1e-8)
        size = self._sizes[cells["key"][rows] >> 3 * _BITS]
        wide = np.maximum(tuning.ELONGATED * spread[:, 0], (tuning.FLAT_WIDTH * size) ** 2)
        flat = (spread[:, 0] < self._thickness**2) & (spread[:, 1] > wide)
        mean += middles
        if origin is not None:
            ways = origin - mean
            behind = np.einsum("ni,ni->n", axes[:, 0], ways) < 0.0
            axes[behind, 0] *= -1.0
            least = tuning.SIDE_SLACK * np.sqrt(np.einsum("ni,ni->n", ways, ways))
            is_other = np.einsum("ni,ni->n", cells["axes"][rows, 0], ways) < -least
            both = is_other & (cells["sided"][rows] == _ONE_SIDE)
            both |= cells["sided"][rows] == _BOTH_SIDES
            cells["sided"][rows] = np.where(both, _BOTH_SIDES, _ONE_SIDE)
        cells["mean"][rows] = mean
        cells["axes"][rows] = axes
        cells["spread"][rows] = spread
        cells["fitted"][rows] = weight
        close = spread[:, :2] < (tuning.NARROW * size[:, None]) ** 2
        close &= (cells["sweeps"][rows] >= tuning.NARROW_SWEEPS)[:, None]
        return np.where(flat, _FLAT, close.sum(axis=1)).astype(np.int8)

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


def _weights(ways: F64) -> F64:
    """Return the weights (C,) of points that are seen at the ends of some ways (C, 3) [m]."""
    squared = np.einsum("ni,ni->n", ways, ways)
    return np.asarray(1.0 / (1.0 + squared / tuning.WEIGHT_RANGE**2))


def _places(keys: I64) -> I64:
    """Return the places (N, 3) of cells, as multiples of their edge."""
    cell = np.stack((keys >> 2 * _BITS, keys >> _BITS, keys), axis=1) & _MASK
    return np.asarray(cell - _HALF)


def products(x: F64, y: F64, z: F64) -> Iterator[F64]:
    """Yield the products of coordinates (N,), in the order of :func:`principal_axes`."""
    axes = x, y, z
    return (axes[i] * axes[j] for i, j in _PAIRS)


def _shifted(moments: F64, offsets: F64) -> F64:
    """Return the moments (10, G) of r + d from those of r, by the parallel axis theorem.

    Parameters
    ----------
    moments : ndarray, shape (10, G)
        Count, sum [m] and products [m^2] of some vectors r.
    offsets : ndarray, shape (G, 3)
        The same d for all vectors of a group [m].
    """
    count, total, products = moments[0], moments[1:4], moments[4:]
    d = np.ascontiguousarray(offsets.T)
    shifted = np.empty_like(moments)
    shifted[0] = count
    shifted[1:4] = total + count * d
    for line, product, (i, j) in zip(shifted[4:], products, _PAIRS, strict=True):
        np.add(product, d[i] * total[j] + shifted[1 + i] * d[j], out=line)
    return shifted


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
    points: F64,
    index: I64,
    rows: I64,
    cells: NDArray[np.void],
    axis: I64,
    kind: NDArray[np.int8],
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
        cells["key"] >> 3 * _BITS < tuning.FINE_LEVELS,
        rows,
        axis,
    )


def _are_behind(points: F64, origins: F64, cells: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return which points (M, 3) are seen from the other side than the surfaces of their cells."""
    ways = origins - points
    along = np.einsum("ni,ni->n", cells["axes"][:, 0], ways)
    least = tuning.SIDE_SLACK * np.sqrt(np.einsum("ni,ni->n", ways, ways))
    return np.asarray((cells["sided"] == _ONE_SIDE) & (along < -least))


def _grown(rows: NDArray[Any], size: int) -> NDArray[Any]:
    """Return rows with zeros after them; what is never used stays without memory."""
    grown = np.zeros(size, rows.dtype)
    grown[: len(rows)] = rows
    return grown
