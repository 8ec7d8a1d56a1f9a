"""Grid of cells in several sizes: their keys, and the moments of the points that lie in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64, I64
from l2lidar_proc.odometry.principal_axes import PAIRS, products

# A key is the number of the level and of the cell along x, y and z.
_BITS: Final = 19
_MASK: Final = (1 << _BITS) - 1
_HALF: Final = 1 << (_BITS - 1)


class CellGrid:
    """Space, divided into cells of several sizes.

    Parameters
    ----------
    sizes : sequence of float
        Edges of the cells [m], fine to coarse; each size is a level.

    Attributes
    ----------
    sizes : ndarray, shape (L,)
        [m]
    """

    def __init__(self, sizes: Sequence[float]) -> None:
        self.sizes: F64 = np.array(sizes, dtype=np.float64)

    def keys(self, points: F64, levels: slice = slice(None)) -> I64:
        """Return the keys of the cells that points (N, 3) lie in, level by level, (L, N)."""
        numbers = range(len(self.sizes))[levels]
        keys = np.empty((len(numbers), len(points)), np.int64)
        axes = np.ascontiguousarray(points.T)
        for level, key in zip(numbers, keys, strict=True):
            x, y, z = (np.floor(axes * (1.0 / self.sizes[level])).astype(np.int64) + _HALF) & _MASK
            np.left_shift(x, _BITS, out=key)
            key |= y
            key <<= _BITS
            key |= z
            key |= level << 3 * _BITS
        return keys

    def middles(self, keys: I64) -> F64:
        """Return the middles of cells [m], shape (C, 3)."""
        return np.asarray((places_of(keys) + 0.5) * self.sizes[levels_of(keys)][:, None])

    def groups(self, points: F64) -> Groups:
        """Return which points (N, 3) lie in the same cell of the finest level."""
        keys = self.keys(points, slice(1))[0]
        # neighbors in a scan line mostly share a cell: look up runs of equal keys
        begins = np.flatnonzero(np.diff(keys, prepend=-1))
        lengths = np.diff(begins, append=len(keys))
        distinct, group = np.unique(keys[begins], return_inverse=True)
        counts = np.bincount(group, lengths, len(distinct)).astype(np.float64)
        return Groups(np.repeat(group, lengths), distinct, self.middles(distinct), counts)

    def cells_of(self, groups: Groups) -> tuple[I64, I64]:
        """Return the cells (C,) of all levels that groups (G,) lie in, and which is whose (L, G).

        A group belongs to the coarser cells around its middle, so the sizes need not be multiples.
        """
        coarser = self.keys(groups.middles, slice(1, None))
        found = [groups.keys]
        cell = np.empty((len(self.sizes), len(groups.keys)), np.int64)
        cell[0] = np.arange(len(groups.keys))
        first = len(groups.keys)
        for keys, where in zip(coarser, cell[1:], strict=True):
            distinct, number = np.unique(keys, return_inverse=True)
            where[:] = first + number
            found.append(distinct)
            first += len(distinct)
        return np.concatenate(found), cell


def levels_of(keys: I64) -> I64:
    """Return the levels (N,) of cells, 0 for the finest."""
    return keys >> 3 * _BITS


def places_of(keys: I64) -> I64:
    """Return the places (N, 3) of cells, as multiples of their edge."""
    cell = np.stack((keys >> 2 * _BITS, keys >> _BITS, keys), axis=1) & _MASK
    return np.asarray(cell - _HALF)


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
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


def shifted(moments: F64, offsets: F64) -> F64:
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
    moved = np.empty_like(moments)
    moved[0] = count
    moved[1:4] = total + count * d
    for line, product, (i, j) in zip(moved[4:], products, PAIRS, strict=True):
        np.add(product, d[i] * total[j] + moved[1 + i] * d[j], out=line)
    return moved
