"""Surfaces of a submap that is complete: which of them a point belongs to, told at once.

A :class:`SurfelMap` grows, and is asked level by level. Registration asks one that stays as it is
some hundred times: here each of its coarsest cells holds a block of its finest ones, and each of
these the number of the surface that speaks for it.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc.odometry.surfel_map import SurfelMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

BITS: Final = 21
"""Of a key, for each of the three axes."""

_HALF: Final = 1 << (BITS - 1)


class SurfaceGrid:
    """The flat surfaces of a map as it is now.

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
            raise ValueError(f"edges of cells {[edge for edge, *_ in levels]} m are no multiples")
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
