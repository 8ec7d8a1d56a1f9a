"""Surfel map: points binned into cells, a plane fitted to each cell.

A surface averages the range noise of every point that ever fell into its cell, which
nearest-neighbor methods cannot do. Cells come in several sizes; the finest flat one at a place is
used. Where none is flat (foliage, rock, trunks, cables), a cell still constrains points along the
directions in which its own points lie close together, as sharply as these scatter.

Near points count for more than far ones, which errors of the attitude move more. A full cell still
takes points from so near that they count for more than those in it. A wall at the face between two
cells needs that: seen from afar, its noise fills both, and each plane is off towards the middle of
its cell, by up to 3 cm at 5 m.

Two kinds of correspondences are ambiguous, and can be rejected. A point may lie in a surface's
cell but not on the surface, as on the front of a wall beside its jamb (Turk and Levoy 1994 reject
pairs at the boundaries of meshes). And what is flat in a cell may be part of something larger, as
one of the columns of points by which a depth camera samples a wall that is far away.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import F64, I64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.local_map.cell_grid import (
    CellGrid,
    Cells,
    Groups,
    levels_of,
    places_of,
    shifted,
)
from l2lidar_proc.odometry.local_map.cell_index import CellIndex
from l2lidar_proc.odometry.local_map.surfels import (
    CELL,
    FLAT,
    PLANE,
    SIGHT,
    Candidates,
    Matches,
    YoungSurfaces,
    are_behind,
    are_within,
    fit,
    matches_with,
    tilts_of,
    weights_from,
    widths_of,
)

_CACHED: Final = 4096  # cells that are looked through at a time


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
    sweep_s : float
        From one sweep to the next [s].
    young : YoungSurfaces
        Of a map that has only just begun.
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
        self.sweep_s = tuning.SWEEP_S
        self.young = YoungSurfaces.TRUSTED
        self._index = CellIndex()
        # row 0 is that of all places without a cell
        self._cells: NDArray[np.void] = np.zeros(1, CELL)
        self._planes: NDArray[np.void] = np.zeros(1, PLANE)
        self._sights: NDArray[np.void] = np.zeros(1, SIGHT)
        self._kind: NDArray[np.int8] = np.zeros(1, np.int8)  # by row, apart: quickly looked up

    def __len__(self) -> int:
        """Return the number of cells of all sizes."""
        return len(self._index)

    def clear(self) -> None:
        """Forget everything."""
        used = len(self) + 1
        self.latest = 0
        self.young = YoungSurfaces.TRUSTED
        self._index.clear()
        # the arrays stay for the next map: allocating them again fragments the memory
        for table in (self._cells, self._planes, self._sights):
            table[:used] = np.zeros(1, table.dtype)
        self._kind[:used] = 0

    def add(
        self,
        points: F64,
        sweep: int = 0,
        apart: NDArray[np.bool_] | None = None,
        origin: F64 | None = None,
        *,
        weighted: bool = False,
        range_correction: float | None = None,
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
            Whether points near the origin count for more.
        range_correction : float, optional
            What was added to their ranges [m], if their lines of sight from the origin are to be
            noted for :meth:`sights`.

        Raises
        ------
        ValueError
            If ``weighted`` or ``range_correction`` is given without ``origin``.
        """
        if origin is None and (weighted or range_correction is not None):
            raise ValueError(
                "weighted and range_correction need origin, where points are seen from"
            )
        if not len(points):
            return 0.0
        self.latest = sweep
        groups = self._grid.groups(points)
        cells = self._grid.cells_of(groups)
        rows = self._index.find(cells.keys)
        new = rows == 0
        rows[new] = self._open(cells.keys[new])
        fresh = self._note_openers(rows, new, cells.of_groups, groups.counts, sweep, apart)
        weights = np.ones(len(rows))
        if weighted and origin is not None:
            weights = weights_from(np.ascontiguousarray(cells.middles.T) - origin)
        before = self._cells["weight"][rows]
        grown = self._extend(points, groups, cells, rows, weights)
        if range_correction is not None and origin is not None:
            added = self._cells["weight"][rows] - before
            self._note_sights(rows, added, cells.middles - origin[:, None], range_correction)
        self._fit(rows[grown], cells.middles[:, grown], origin)
        return fresh

    def _note_openers(
        self,
        rows: I64,
        new: NDArray[np.bool_],
        cell: I64,
        counts: F64,
        sweep: int,
        apart: NDArray[np.bool_] | None,
    ) -> float:
        """Note the sweep that opened the new cells among some (C,).

        Only a new cell of the coarsest level is a new place. Finer ones also open in known walls:
        such a place is as old as the coarsest cell around it. Return the share of points in new
        places.

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
        fresh = float(counts[new[cell[-1]]].sum() / counts.sum())
        self._planes["born"][rows[new]] = self._planes["opened"][rows[new]] = sweep
        if fresh < 1.0 and new.any():
            around = np.empty(len(rows), np.int64)
            around[cell] = rows[cell[-1]]
            born = self._planes["born"][around[new]]
            if apart is not None:
                is_apart = apart[np.minimum(born, len(apart) - 1)]
                born = np.where(is_apart, sweep, born)
            self._planes["born"][rows[new]] = born
        return fresh

    def _extend(
        self, points: F64, groups: Groups, cells: Cells, rows: I64, weights: F64
    ) -> NDArray[np.bool_]:
        """Add points (N, 3) to the sums of their cells, as far as these still change.

        The points of a group all have the weight of its cell. The sums of a coarser cell are those
        of its groups, moved to its middle (parallel axis theorem).

        Parameters
        ----------
        points : ndarray, shape (N, 3)
        groups : Groups
            Of the points.
        cells : Cells
            Of the groups.
        rows, weights : ndarray, shape (C,)
            Of the cells.

        Returns
        -------
        ndarray, shape (C,)
            Which cells have grown so much that their planes are due.
        """
        changing = self._cells["weight"][rows] < self._capacity * weights
        self._cells["seen"][rows[~changing]] = self.latest
        wanted = changing[cells.of_groups]
        size = len(groups.keys)
        moments = np.empty((11, size))
        moments[:10] = groups.moments(points, np.logical_or.reduce(wanted))
        moments[:10] *= weights[:size]
        np.multiply(moments[0], weights[:size], out=moments[10])
        due = np.zeros(len(rows), np.bool_)
        # level by level, what is summed stays in the processor's cache
        for level, (first, last) in enumerate(itertools.pairwise(cells.edges)):
            sums = moments
            if level:
                here = np.flatnonzero(wanted[level])
                numbers = cells.of_groups[level, here]
                some = moments if len(here) == size else moments[:, here]
                offsets = groups.middles[:, here] - cells.middles[:, numbers]
                lines = (*shifted(some[:10], offsets), some[10])
                sums = np.empty((11, last - first))
                numbers -= first
                for total, line in zip(sums, lines, strict=True):
                    total[:] = np.bincount(numbers, line, last - first)
            which = first + np.flatnonzero(changing[first:last])
            if len(which) < last - first:
                sums = sums[:, which - first]
            due[which] = self._grow(rows[which], sums)
        return due

    def _grow(self, rows: I64, sums: F64) -> NDArray[np.bool_]:
        """Add sums (11, M) to those of cells, and return which planes (M,) are due for a fit."""
        cells = records.selected(self._cells, rows)
        # column by column: numpy would go through the few columns of each row
        sum_, products = cells["sum"].T, cells["products"].T
        columns = (cells["weight"], *sum_, *products, cells["squares"])
        for column, line in zip(columns, sums, strict=True):
            column += line
        cells["count"] = cells["weight"] ** 2 / np.maximum(cells["squares"], 1e-300)
        cells["sweeps"] += 1.0
        cells["seen"] = self.latest
        records.assign(self._cells, rows, cells)
        is_due = cells["weight"] >= tuning.REFIT_GROWTH * cells["fitted"]
        return np.asarray(is_due & (cells["count"] >= self._least))

    def _note_sights(self, rows: I64, added: F64, ways: F64, range_correction: float) -> None:
        """Note how points were seen that have been added to cells.

        Parameters
        ----------
        rows : ndarray, shape (C,)
        added : ndarray, shape (C,)
            Sums of their weights.
        ways : ndarray, shape (3, C)
            From the sensor to the cells [m].
        range_correction : float
            [m]
        """
        grown = np.flatnonzero(added > 0.0)
        sights = records.selected(self._sights, rows[grown])
        sights["weight"] += added[grown]
        shares = added[grown] / np.maximum(np.linalg.norm(ways[:, grown], axis=0), 1e-9)
        for line, corrected, way in zip(
            sights["lines"].T, sights["corrected"].T, ways[:, grown], strict=True
        ):
            line += shares * way
            corrected += range_correction * shares * way
        records.assign(self._sights, rows[grown], sights)

    def _fit(self, rows: I64, middles: F64, origin: F64 | None) -> None:
        """Fit the planes of some cells anew.

        Parameters
        ----------
        rows : ndarray, shape (M,)
        middles : ndarray, shape (3, M)
            Of the cells [m].
        origin : ndarray, shape (3,), optional
            From which they were seen [m].
        """
        if not len(rows):
            return
        cells, planes = self.cells(rows), self.planes(rows)
        sizes = self._grid.sizes[levels_of(cells["key"])]
        self._kind[rows] = fit(cells, planes, middles, sizes, self._thickness, origin)
        self._cells["fitted"][rows] = cells["weight"]
        records.assign(self._planes, rows, planes)

    def match(
        self,
        points: F64,
        *,
        narrow: bool = False,
        sizes: Sequence[int] = (),
        origins: F64 | None = None,
        again: bool = False,
        reject_ambiguous: bool = False,
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
        origins : ndarray, shape (N, 3) or (3,), optional
            Where each point is seen from, or all [m]. A surface that would be seen from behind is
            not the point's: it is the other side of a wall.
        again : bool
            The points are mostly those of the last call with this, and have hardly moved.
        reject_ambiguous : bool
            Leave out points beyond the extent of a flat surface, and surfaces beyond both sides of
            which there are more points.
        """
        keys = self._grid.keys(points)
        find = self._index.find_again if again else self._index.find
        rows = find(keys.ravel()).reshape(keys.shape)
        kind = self._kind[rows]
        is_flat = kind == FLAT
        found = _finest(rows, is_flat, np.arange(len(points)))
        if narrow:
            bare = np.flatnonzero(~is_flat.any(axis=0))
            bare = _edges(bare, sizes or [len(points)])
            if len(bare):
                some = _finest(rows[:, bare], kind[:, bare] > 0, bare)
                found = found.followed_by(_both_axes(some, self._kind[some.cells]))
        flat = self._kind[found.cells] == FLAT
        planes, places = self.planes(found.cells), points[found.point]
        kept = np.ones(len(places), np.bool_)
        if origins is not None:
            eyes = origins if origins.ndim == 1 else origins[found.point]
            kept = ~(flat & are_behind(places, eyes, planes))
        if reject_ambiguous:
            kept &= ~flat | are_within(places, planes, *tuning.EXTENT)
            kept &= ~self._continue_across(found, planes)
        if not kept.all():
            left = np.flatnonzero(kept)
            found, flat, places = found.some(left), flat[left], places[left]
            planes = records.selected(planes, left)
        return matches_with(found, places, planes, self._cells["count"][found.cells], flat)

    def _continue_across(self, found: Candidates, planes: NDArray[np.void]) -> NDArray[np.bool_]:
        """Return which surfaces (M,) are part of something that continues across them.

        A surface is a boundary: the space before it is free, and what is behind it is hidden.
        Where both neighboring cells along the normal have points as well, its shape only shows
        how the sensor samples something larger.

        Parameters
        ----------
        found : Candidates
        planes : ndarray, shape (M,), dtype PLANE
        """
        normals = planes["axes"][np.arange(len(planes)), found.axis]
        moves = self._grid.sizes[found.level][:, None] * normals
        enough = tuning.CONTINUED * self._cells["weight"][found.cells]
        continued = np.ones(len(planes), np.bool_)
        for side in (1.0, -1.0):
            some = np.flatnonzero(continued)
            keys = self._grid.keys(planes["mean"][some] + side * moves[some])
            rows = self._index.find(keys[found.level[some], np.arange(len(some))])
            continued[some] = self._cells["weight"][rows] > enough[some]
        return continued

    def are_known(self, points: F64) -> NDArray[np.bool_]:
        """Return which points (N, 3) [m], map frame, lie in coarsest cells with points."""
        return self._index.find(self._grid.keys(points, slice(-1, None))[0]) > 0

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
        thickness2 = self._planes["spread"][found.cells, 0]
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
        return tilts_of(self.planes(cells), self._cells["sweeps"][cells], axis)

    def widths(self, cells: I64, axis: I64) -> F64:
        """Return how wide surfaces are, (M,) [m], as :func:`widths_of` has it.

        ``cells`` and ``axis`` (M,) are as for :meth:`tilts`.
        """
        return widths_of(self.planes(cells), axis)

    def cells(self, rows: I64) -> NDArray[np.void]:
        """Return the sums of the cells (M,) of some :class:`Matches`, dtype CELL."""
        return records.selected(self._cells, rows)

    def planes(self, rows: I64) -> NDArray[np.void]:
        """Return the surfaces in the cells (M,) of some :class:`Matches`, dtype PLANE."""
        return records.selected(self._planes, rows)

    def sights(self, rows: I64) -> NDArray[np.void]:
        """Return how the cells (M,) of some :class:`Matches` were seen, dtype SIGHT."""
        return records.selected(self._sights, rows)

    def correct_ranges(self, change: float) -> None:
        """Move points of the map along their lines of sight, by a change of their ranges.

        Points whose lines of sight were not noted stay.

        Parameters
        ----------
        change : float
            By which the correction of the ranges has grown [m].
        """
        rows = np.flatnonzero(self._sights["weight"] > 0.0)
        cells, sights, planes = self.cells(rows), self.sights(rows), self.planes(rows)
        moved = change * sights["lines"].astype(np.float64)
        shift = moved / cells["weight"][:, None]
        lines = np.column_stack((cells["weight"], cells["sum"], cells["products"])).T
        _, *sums = shifted(lines, shift.T)
        cells["sum"], cells["products"] = np.stack(sums[:3], axis=1), np.stack(sums[3:], axis=1)
        planes["mean"] += shift
        sights["corrected"] += moved
        records.assign(self._cells, rows, cells)
        records.assign(self._sights, rows, sights)
        records.assign(self._planes, rows, planes)

    def forget(self, origin: F64, distance: float, since: int = 0) -> None:
        """Drop cells farther than a distance [m] from a place (3,), or not seen since a sweep."""
        cells = self._cells[1 : len(self) + 1]
        kept = np.empty(len(cells), np.bool_)
        # some at a time, so that what is computed stays in the processor's cache
        for first in range(0, len(cells), _CACHED):
            part = slice(first, first + _CACHED)
            some = cells[part]
            x, y, z = self._grid.middles(some["key"].copy()) - origin[:, None]
            kept[part] = x * x + y * y + z * z <= distance * distance
            kept[part] &= some["seen"] >= since
        if not kept.all():
            self._drop(1 + np.flatnonzero(~kept))

    def _drop(self, rows: I64) -> None:
        """Drop the cells of some rows, ascending; the last of the others take their rows.

        The arrays keep their size: freeing and allocating them again fragments the memory.
        """
        end = len(self) + 1
        left = end - len(rows)
        holes = rows[: np.searchsorted(rows, left)]
        last = np.setdiff1d(np.arange(left, end), rows, assume_unique=True)
        self._index.remove(self._cells["key"][rows])
        self._index.move(self._cells["key"][last], holes)
        for table in (self._cells, self._planes, self._sights):
            records.assign(table, holes, records.selected(table, last))
            table[left:end] = np.zeros(1, table.dtype)
        self._kind[holes] = self._kind[last]
        self._kind[left:end] = 0

    def part_of(self, sweeps: NDArray[np.bool_]) -> SurfelMap:
        """Return a map with the cells of the places that some of the sweeps (S,) saw first."""
        part = SurfelMap(
            self._grid.sizes.tolist(),
            thickness=self._thickness,
            least=self._least,
            capacity=self._capacity,
        )
        part.latest, part.sweep_s = self.latest, self.sweep_s
        part.young = self.young
        born = self._planes["born"][1 : len(self) + 1]
        part._take(self, sweeps[np.minimum(born, len(sweeps) - 1)])
        return part

    def _take(self, other: SurfelMap, kept: NDArray[np.bool_]) -> None:
        """Take some of the cells (C,) of another map; this one is empty."""
        rows = np.concatenate(([0], 1 + np.flatnonzero(kept)))
        self._cells = records.selected(other._cells, rows)
        self._planes = records.selected(other._planes, rows)
        self._sights = records.selected(other._sights, rows)
        self._kind = other._kind[rows]
        self._index.insert(self._cells["key"][1:].copy(), np.arange(1, len(rows)))

    def flat_cells(self) -> list[tuple[float, I64, F64, F64]]:
        """Return what :meth:`match` knows of flat places, for each size, fine to coarse.

        Edge of the cells [m]; their places as multiples of it (N, 3); a point of each surface
        (N, 3) [m]; unit normals (N, 3).
        """
        order = np.argsort(self._cells["key"][1 : len(self) + 1]) + 1
        flat = order[self._kind[order] == FLAT]
        keys, planes = self._cells["key"][flat], self.planes(flat)
        level = levels_of(keys)
        places, means, normals = places_of(keys), planes["mean"], planes["axes"][:, 0]
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
            self._cells, self._planes = _grown(self._cells, size), _grown(self._planes, size)
            self._sights = _grown(self._sights, size)
            self._kind = _grown(self._kind, size)
        self._cells["key"][first : first + len(keys)] = keys
        return rows


def _edges(bare: I64, sizes: Sequence[int]) -> I64:
    """Return the points without a flat surface (N,) of those sweeps in which they are many."""
    if len(bare) <= tuning.EDGE_SHARE * min(sizes):
        return bare[:0]
    ends = np.cumsum(sizes)
    places = np.searchsorted(bare, [0, *ends.tolist()])
    parts = zip(places[:-1].tolist(), places[1:].tolist(), sizes, strict=True)
    return np.concatenate(
        [
            bare[first : last if last - first > tuning.EDGE_SHARE * size else first]
            for first, last, size in parts
        ]
    )


def _finest(rows: I64, wanted: NDArray[np.bool_], index: I64) -> Candidates:
    """Return the finest wanted of the cells that points lie in, level by level.

    Parameters
    ----------
    rows : ndarray, shape (L, N)
        Of the cells.
    wanted : ndarray, shape (L, N)
    index : ndarray, shape (N,)
        Names of the points.
    """
    free = np.ones(len(index), np.bool_)
    places = []
    for fits in wanted:
        places.append(np.flatnonzero(fits & free))
        free &= ~fits
    place = np.concatenate(places)
    level = np.repeat(np.arange(len(places)), [len(some) for some in places])
    return Candidates(index[place], rows[level, place], level, np.zeros(len(level), np.int64))


def _both_axes(found: Candidates, kind: NDArray[np.int8]) -> Candidates:
    """Return candidates with the second axes of those cells whose kind (M,) has two."""
    second = found.some(kind > 1)
    both = found.followed_by(second._replace(axis=second.axis + 1))
    return both.some(np.argsort(2 * both.level + both.axis, kind="stable"))


def _grown(rows: NDArray[Any], size: int) -> NDArray[Any]:
    """Return rows with zeros after them; what is never used stays without memory."""
    grown = np.zeros(size, rows.dtype)
    records.assign(grown, np.arange(len(rows)), rows)
    return grown
