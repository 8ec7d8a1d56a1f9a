"""Surfels: what a cell of the map knows of its surface, fitted to it, and told about a point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64, I64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.cell_grid import levels_of
from l2lidar_proc.odometry.principal_axes import principal_axes, products

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

FLAT: Final = 3
"""Kind of a flat cell; that of others is the number of axes along which their points lie close."""


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
        The cells of the surfaces, as the map's other methods take them; until the map changes.
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


def matches_with(
    points: F64,
    index: I64,
    rows: I64,
    cells: NDArray[np.void],
    axis: I64,
    kind: NDArray[np.int8],
) -> Matches:
    """Return how far some points are from the middles of their cells (M,) along axes (M,).

    Parameters
    ----------
    points : ndarray, shape (N, 3)
        [m], map frame.
    index : ndarray, shape (M,)
        Which of the points.
    rows : ndarray, shape (M,)
        Of the cells in the map.
    cells : ndarray, shape (M,), dtype CELL
    axis : ndarray, shape (M,)
    kind : ndarray, shape (M,)
        Of the cells.
    """
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
        np.where(kind == FLAT, 0.0, across),
        cells["born"],
        cells["opened"],
        levels_of(cells["key"]) < tuning.FINE_LEVELS,
        rows,
        axis,
    )


def are_behind(points: F64, origins: F64, cells: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return which points are seen from the other side than the surfaces of their cells.

    Parameters
    ----------
    points : ndarray, shape (M, 3)
        [m], map frame.
    origins : ndarray, shape (M, 3)
        Where each is seen from [m].
    cells : ndarray, shape (M,), dtype CELL
    """
    ways = origins - points
    along = np.einsum("ni,ni->n", cells["axes"][:, 0], ways)
    least = tuning.SIDE_SLACK * np.sqrt(np.einsum("ni,ni->n", ways, ways))
    return np.asarray((cells["sided"] == _ONE_SIDE) & (along < -least))


def tilts_of(cells: NDArray[np.void], axis: I64) -> F64:
    """Return how far normals may be tilted towards each axis of their cells, 1 sigma.

    A plane fitted to points of extent l and scatter s is tilted by s / l / sqrt(n) (the first
    order of the eigenvectors' errors). The sweeps are counted, not the points: those of one sweep
    err together.

    Parameters
    ----------
    cells : ndarray, shape (M,), dtype CELL
    axis : ndarray, shape (M,)
        Which of its cell's axes each normal is.

    Returns
    -------
    ndarray, shape (M, 3, 3)
        Row i is the cell's axis i, as long as the normal's tilt towards it [rad]; zero for the
        normal itself.
    """
    each = np.arange(len(cells))
    spread = cells["spread"]
    across = np.maximum(spread[each, axis], tuning.NORMAL_SCATTER**2) / cells["sweeps"]
    angles = np.sqrt(across[:, None] / np.maximum(spread, tuning.NORMAL_LEAST_EXTENT**2))
    angles[each, axis] = 0.0
    return np.asarray(cells["axes"] * angles[:, :, None])


def weights_from(ways: F64) -> F64:
    """Return the weights (C,) of points that are seen at the ends of some ways (C, 3) [m]."""
    squared = np.einsum("ni,ni->n", ways, ways)
    return np.asarray(1.0 / (1.0 + squared / tuning.WEIGHT_RANGE**2))


def fit(
    cells: NDArray[np.void],
    rows: I64,
    middles: F64,
    sizes: F64,
    thickness: float,
    origin: F64 | None,
) -> NDArray[np.int8]:
    """Fit planes to the moments of some cells, in place; return the kinds (M,) of these cells.

    Parameters
    ----------
    cells : ndarray, shape (C,), dtype CELL
    rows : ndarray, shape (M,)
        Which of them.
    middles : ndarray, shape (M, 3)
        Of these [m].
    sizes : ndarray, shape (M,)
        Their edges [m].
    thickness : float
        Largest standard deviation across a flat surface [m].
    origin : ndarray, shape (3,), optional
        Of the latest points: normals point to it, if there is one [m].
    """
    weight = cells["weight"][rows]
    mean = cells["sum"][rows] / weight[:, None]
    covariance = cells["products"][rows].T / weight
    for line, product in zip(covariance, products(*mean.T), strict=True):
        line -= product
    spread, axes = principal_axes(covariance)
    spread = np.maximum(spread, 1e-8)
    wide = np.maximum(tuning.ELONGATED * spread[:, 0], (tuning.FLAT_WIDTH * sizes) ** 2)
    flat = (spread[:, 0] < thickness**2) & (spread[:, 1] > wide)
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
    close = spread[:, :2] < (tuning.NARROW * sizes[:, None]) ** 2
    close &= (cells["sweeps"][rows] >= tuning.NARROW_SWEEPS)[:, None]
    return np.where(flat, FLAT, close.sum(axis=1)).astype(np.int8)
