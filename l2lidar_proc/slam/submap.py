"""Submaps: points over a few meters of travel, and the data that registration needs.

A submap's frame stands at its first sweep with z up. It keeps one point per voxel as int16 steps
of 2 mm and the number of the viewpoint that saw it: 7 bytes a point, +-65 m.

A :class:`SurfelMap` grows, and is asked level by level. Registration asks one that stays as it is
some hundred times: in a :class:`SurfaceGrid` each of its coarsest cells holds a block of its
finest ones, and each of these the number of the surface that speaks for it.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from l2lidar_node import records
from l2lidar_node.types import F64, I64
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.slam.se3 import error, magnitude, transformed

BITS: Final = 21
"""Of a key, for each of the three axes."""

_HALF: Final = 1 << (BITS - 1)


class SurfaceGrid:
    """The flat surfaces of a map.

    Parameters
    ----------
    surfaces : SurfelMap
        The edges of its cells double from size to size, or are other multiples of the finest.
    """

    def __init__(self, surfaces: SurfelMap) -> None:
        levels = surfaces.flat_cells()
        self._edge = levels[0][0]
        ratios = [round(edge / self._edge) for edge, *_ in levels]
        if any(ratios[-1] % ratio for ratio in ratios):
            raise ValueError(f"edges of cells {[edge for edge, *_ in levels]} m are not multiples")
        self._per_block = wide = ratios[-1]
        owners = [
            cells // (wide // ratio) for ratio, (_, cells, *_) in zip(ratios, levels, strict=True)
        ]
        keys = [cell_keys(owner) for owner in owners]
        self._keys = np.unique(np.concatenate(keys))
        blocks = np.zeros((len(self._keys), wide, wide, wide), np.int32)
        self._planes = np.zeros((1 + sum(map(len, keys)), 4))
        number = 1
        for ratio, (_, cells, middles, normals), key in reversed(
            list(zip(ratios, levels, keys, strict=True))
        ):
            count = wide // ratio
            planes = self._planes[number : number + len(cells)]
            planes[:, :3] = normals
            planes[:, 3] = (normals * middles).sum(axis=1)
            block, (i, j, k) = np.searchsorted(self._keys, key), (cells % count).T
            numbers = np.arange(number, number + len(cells), dtype=np.int32)
            # finer cells are written over the coarser one they lie in
            parts = blocks.reshape(-1, count, ratio, count, ratio, count, ratio)
            parts[block, i, :, j, :, k, :] = numbers[:, None, None, None]
            number += len(cells)
        self._numbers = blocks.ravel()

    def match(self, points: F64) -> tuple[I64, F64, F64]:
        """Return the surfaces of the points that have one: the finest at their place.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            [m], map frame.

        Returns
        -------
        index : ndarray, shape (M,)
            Which of the points.
        normals : ndarray, shape (M, 3)
            Unit, map frame, either sign.
        distances : ndarray, shape (M,)
            Of the point from the plane along the normal [m].
        """
        if not len(self._keys):
            return np.empty(0, np.int64), np.empty((0, 3)), np.empty(0)
        wide = self._per_block
        cell = np.floor(points * (1.0 / self._edge)).astype(np.int64)
        owner = cell // wide
        i, j, k = (cell - owner * wide).T
        key = cell_keys(owner)
        block = np.minimum(np.searchsorted(self._keys, key), len(self._keys) - 1)
        number = self._numbers[((block * wide + i) * wide + j) * wide + k]
        index = np.flatnonzero((number > 0) & (self._keys[block] == key))
        planes = self._planes[number[index]]
        normals = planes[:, :3]
        distances = np.einsum("ij,ij->i", points[index], normals) - planes[:, 3]
        return index, normals, distances


def cell_keys(cells: I64) -> I64:
    """Return one integer for each cell (N, 3), shape (N,)."""
    i, j, k = (cells + _HALF).T
    return np.asarray((i << 2 * BITS) | (j << BITS) | k)


STEP_M: Final = 0.002
"""Resolution of the stored points [m]."""

REACH_M: Final = (2**15 - 1) * STEP_M
"""Largest coordinate of a point or viewpoint [m]."""

SUBMAP_POINT: Final = np.dtype([("xyz", "<i2", (3,)), ("view", "u1")])
"""Place in steps of :data:`STEP_M` in the submap's frame, and which viewpoint saw it."""

STRUCTURE_CELL_M: Final = 0.25
"""Edge of the cells of bird's-eye images [m]."""

_STRUCTURE_HEIGHTS: Final = 3  # levels of the same height that make a cell a wall, not a floor
_SURFACES: Final = (0.3, 0.6, 1.2)  # [m] voxel means are too sparse for finer cells
_SURFACE_POINTS: Final = 6
_SURFACE_THICKNESS: Final = 0.035
_LYING: Final = 0.7  # cosine: surfaces flatter than 45 degrees are floors and ceilings
_SPREAD_M: Final = 0.3  # distance between the points that are registered
_FREE_CELL_M: Final = 0.3  # and the way between the points of a ray that are looked at
_FREE_SHORT_M: Final = 0.5  # a ray frees no space this close before its end
_FREE_RAYS: Final = 4000
_OPEN_CELL_M: Final = 0.15
_OPEN_M: Final = (0.25, 2.0)  # before the end of a ray
_OPEN_RAYS: Final = 8000
_VIEW_STEP_M: Final = 0.5  # way between viewpoints
_MOST_VIEWS: Final = 255
_STILL: Final = (0.05, np.radians(4.0))  # [m, rad] moved less than this, a place is seen enough
_STILL_SWEEPS: Final = 3  # after so many sweeps from there
_COMPACT: Final = 200_000  # points after which an open submap is thinned


@dataclass(frozen=True, slots=True, eq=False)
class Submap:
    """Points over a few meters of travel.

    Attributes
    ----------
    points : ndarray, shape (N,), dtype SUBMAP_POINT
    views : ndarray, shape (V, 3), float32
        Places the points were seen from [m], submap frame.
    """

    points: NDArray[np.void]
    views: NDArray[np.float32]

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)

    @property
    def xyz(self) -> F64:
        """Points [m], shape (N, 3), submap frame."""
        return np.asarray(self.points["xyz"] * STEP_M)

    @property
    def nbytes(self) -> int:
        """Bytes of memory."""
        return self.points.nbytes + self.views.nbytes


class SubmapBuilder:
    """Collects the sweeps of a submap.

    Parameters
    ----------
    voxel : float
        Edge of the cubes of which one point is kept [m].
    max_range : float
        Farther points are left out [m].
    """

    def __init__(self, voxel: float, max_range: float) -> None:
        self._voxel = voxel
        self._max_range = max_range
        self._parts: list[tuple[F64, F64, NDArray[np.uint8]]] = []
        self._pending = 0
        self._views: list[F64] = []
        self._seen_from: F64 | None = None
        self._sweeps_here = 0

    def add(self, T_submap_body: F64, points: F64) -> None:
        """Add the points (N, 3) [m] of a sweep, seen from and given in the body frame."""
        if self._seen_from is not None:
            turn, way = magnitude(error(self._seen_from, T_submap_body))
            if way < _STILL[0] and turn < _STILL[1] and self._sweeps_here >= _STILL_SWEEPS:
                return
            self._sweeps_here += 1
            if way >= _STILL[0] or turn >= _STILL[1]:
                self._seen_from, self._sweeps_here = T_submap_body, 1
        else:
            self._seen_from, self._sweeps_here = T_submap_body, 1
        place = T_submap_body[:3, 3]
        reach = min(self._max_range, REACH_M - float(np.abs(place).max()) - 1.0)
        if reach <= 0.0:
            return
        far = not self._views or np.linalg.norm(place - self._views[-1]) > _VIEW_STEP_M
        if far and len(self._views) < _MOST_VIEWS:
            self._views.append(place.copy())
        near = (points**2).sum(axis=1) < reach**2
        placed = transformed(T_submap_body, points[near])
        view = np.full(len(placed), len(self._views) - 1, np.uint8)
        self._parts.append((placed, np.ones(len(placed)), view))
        self._pending += len(placed)
        if self._pending > _COMPACT:
            self._parts = [self._thinned()]
            self._pending = 0

    def finish(self) -> Submap:
        """Return the submap so far; more may be added afterwards."""
        if not self._parts:
            return Submap(np.empty(0, SUBMAP_POINT), np.zeros((0, 3), np.float32))
        placed, _, view = self._thinned()
        points = np.empty(len(placed), SUBMAP_POINT)
        points["xyz"] = np.rint(placed / STEP_M)
        points["view"] = view
        return Submap(points, np.array(self._views, np.float32).reshape(-1, 3))

    def _thinned(self) -> tuple[F64, F64, NDArray[np.uint8]]:
        """Return the mean, weight and first view of each voxel."""
        placed, weight, view = (
            np.concatenate(column) for column in zip(*self._parts, strict=True)
        )
        keys, first, inverse = np.unique(
            voxel_keys(placed, self._voxel), return_index=True, return_inverse=True
        )
        total = np.bincount(inverse, weight, len(keys))
        mean = np.stack(
            [np.bincount(inverse, weight * axis, len(keys)) / total for axis in placed.T], axis=1
        )
        return mean, np.asarray(total, np.float64), np.asarray(view[first], np.uint8)


class SubmapView:
    """Registration data of a submap: surfaces, neighbors, free space, vertical structure.

    Parameters
    ----------
    submap : Submap

    Attributes
    ----------
    points : ndarray, shape (N, 3)
        [m], submap frame.
    surfaces : SurfaceGrid
    tree : cKDTree
        Of the points.
    structure : ndarray, shape (M, 2)
        Middles of the cells of 0.25 m that hold something upright [m], submap frame.
    source : ndarray, shape (S, 3)
        Points spread evenly over the surfaces, in random order: any first part is a fair sample.
    is_upright : ndarray, shape (S,)
        Which of these are not on a floor or ceiling; these tell places apart.
    """

    def __init__(self, submap: Submap) -> None:
        self._submap = submap
        self.points = submap.xyz
        surfaces = SurfelMap(
            _SURFACES, thickness=_SURFACE_THICKNESS, least=_SURFACE_POINTS, capacity=10_000
        )
        surfaces.add(self.points)
        self.surfaces = SurfaceGrid(surfaces)
        self.tree = cKDTree(self.points)
        self.structure = structure_of(self.points)
        self._free = _free_cells(submap)
        self.source = _spread(self.points)
        self.is_upright = np.ones(len(self.source), np.bool_)
        index, normals, _ = self.surfaces.match(self.source)
        self.is_upright[index] = np.abs(normals[:, 2]) < _LYING

    def is_free(self, points: F64) -> NDArray[np.bool_]:
        """Return which points (N, 3) lie where rays of the submap passed, shape (N,)."""
        return _contained(voxel_keys(points, _FREE_CELL_M), self._free)

    def is_open(self, points: F64) -> NDArray[np.bool_]:
        """Return which points (N, 3) rays passed on their last two meters, shape (N,).

        Finer than :meth:`is_free`, and up to the surfaces: the caller must make sure that
        they are not on one.
        """
        return _contained(voxel_keys(points, _OPEN_CELL_M), self._open)

    @cached_property
    def _open(self) -> I64:
        chosen = records.decimated(self._submap.points, _OPEN_RAYS)
        ends = chosen["xyz"] * STEP_M
        way = self._submap.views[chosen["view"]] - ends
        length = np.linalg.norm(way, axis=1)
        back = np.arange(*_OPEN_M, _OPEN_CELL_M)
        ray, step = np.nonzero(length[:, None] > back)
        ahead = way / np.maximum(length, 1e-9)[:, None]
        return _distinct(voxel_keys(ends[ray] + ahead[ray] * back[step][:, None], _OPEN_CELL_M))


class ViewCache:
    """The latest views of submaps, by number.

    Parameters
    ----------
    capacity : int
        Views to keep: some 2 MB each.
    """

    def __init__(self, capacity: int = 48) -> None:
        self._capacity = capacity
        self._views: OrderedDict[int, SubmapView] = OrderedDict()

    def of(self, number: int, submap: Submap) -> SubmapView:
        """Return the view of a submap."""
        if number in self._views:
            self._views.move_to_end(number)
            return self._views[number]
        view = self._views[number] = SubmapView(submap)
        if len(self._views) > self._capacity:
            self._views.popitem(last=False)
        return view


def voxel_keys(points: F64, edge: float) -> I64:
    """Return one integer for the voxel of each point (N, 3), shape (N,)."""
    return cell_keys(np.floor(points * (1.0 / edge)).astype(np.int64))


def structure_of(points: F64) -> F64:
    """Return the middles (M, 2) [m] of cells with points (N, 3) at several heights."""
    cells = _distinct(voxel_keys(points, STRUCTURE_CELL_M))
    columns = cells >> BITS  # the height is in the lowest bits
    first = np.flatnonzero(np.r_[True, columns[1:] != columns[:-1]]) if len(cells) else cells
    count = np.diff(np.r_[first, len(cells)])
    tall = columns[first[count >= _STRUCTURE_HEIGHTS]]
    cell = np.stack((tall >> BITS, tall & (2 * _HALF - 1)), axis=1) - _HALF
    return np.asarray((cell + 0.5) * STRUCTURE_CELL_M)


def _spread(points: F64) -> F64:
    """Return one point per voxel, shuffled."""
    _, first = np.unique(voxel_keys(points, _SPREAD_M), return_index=True)
    order = np.random.default_rng(0).permutation(len(first))
    return np.asarray(points[first[order]])


def _free_cells(submap: Submap) -> I64:
    """Return the sorted keys of the cells that rays passed and no surface is next to."""
    chosen = records.decimated(submap.points, _FREE_RAYS)
    occupied = np.floor(submap.xyz * (1.0 / _FREE_CELL_M)).astype(np.int64)
    ends = chosen["xyz"] * (STEP_M / _FREE_CELL_M)
    origins = submap.views[chosen["view"]].astype(np.float64) * (1.0 / _FREE_CELL_M)
    length = np.linalg.norm(ends - origins, axis=1)
    ahead = (ends - origins) / np.maximum(length, 1e-9)[:, None]
    steps = np.maximum(length - _FREE_SHORT_M / _FREE_CELL_M, 0.0).astype(np.int64)
    along = np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps)
    # marks in a box around all of it: to sort the keys of all cells takes several times as long
    corners = np.concatenate((origins, occupied))
    low = np.floor(corners.min(axis=0, initial=0.0)).astype(np.int64) - 1
    size = np.ceil(corners.max(axis=0, initial=0.0)).astype(np.int64) + 3 - low
    pitch = np.array((size[1] * size[2], size[2], 1))
    passed = np.zeros(len(along), np.int64)
    for axis in range(3):
        place = np.repeat(origins[:, axis] - low[axis], steps)
        place += np.repeat(ahead[:, axis], steps) * along
        passed += place.astype(np.int64) * pitch[axis]
    free = np.zeros(int(size.prod()), np.bool_)
    free[passed] = True
    beside = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    free[(((occupied - low) @ pitch)[:, None] + beside @ pitch).ravel()] = False
    return cell_keys(np.stack(np.unravel_index(np.flatnonzero(free), size), axis=1) + low)


def _distinct(keys: I64) -> I64:
    """Return the sorted distinct keys; ``numpy.unique`` hashes, which is slower."""
    keys = np.sort(keys)
    return keys[np.r_[True, keys[1:] != keys[:-1]]] if len(keys) else keys


def _contained(keys: I64, among: I64) -> NDArray[np.bool_]:
    """Return which keys are among some sorted ones."""
    if not len(among):
        return np.zeros(len(keys), np.bool_)
    place = np.minimum(np.searchsorted(among, keys), len(among) - 1)
    return np.asarray(among[place] == keys)
