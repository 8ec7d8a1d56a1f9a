"""Surfels: planes fitted to the points of map cells, and their distances from other points."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64, I64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.local_map.principal_axes import principal_axes, products

CELL: Final = np.dtype(
    [
        ("key", "<i8"),
        ("weight", "<f8"),  # sum of the points' weights
        ("squares", "<f8"),  # of the squares of the weights
        ("count", "<f8"),  # of points with equal weights that are worth as much (Kish 1965)
        ("sum", "<f8", (3,)),  # [m] weighted, of the points' offsets from the cell's middle
        ("products", "<f8", (6,)),  # [m^2] weighted, of the offsets: xx xy xz yy yz zz
        ("sweeps", "<f8"),  # in which points came
        ("seen", "<i8"),  # number of the latest sweep with points in it
        ("fitted", "<f8"),  # weight when its plane was fitted
    ],
)
"""The sums of a cell's points, which change with most sweeps."""

PLANE: Final = np.dtype(
    [
        ("mean", "<f8", (3,)),  # [m] map frame
        ("axes", "<f8", (3, 3)),  # rows: the normal, then the two axes of the surface; unit
        ("spread", "<f8", (3,)),  # [m^2] variance along each of the axes, ascending
        ("born", "<i8"),  # number of the sweep that was the first at its place
        ("opened", "<i8"),  # number of the sweep whose points opened it
        ("sided", "<i8"),  # from which sides its points were seen, a value of Sides
    ],
)
"""The surface in a cell, with which points are matched; it seldom changes."""

SIGHT: Final = np.dtype(
    [
        ("weight", "<f4"),  # sum of the weights of the points whose lines of sight were noted
        ("lines", "<f4", (3,)),  # weighted sum of their lines of sight, unit, away from the sensor
        ("corrected", "<f4", (3,)),  # [m] the same, each by the correction of its range
    ],
)
"""From where the points of a cell were seen: an error of their ranges moves them along that."""


class Sides(IntEnum):
    """Sides from which the points of a cell were seen.

    A flat cell with points from both is a board. A wall is thicker, and has two surfaces.
    """

    UNKNOWN = 0  # its points came without an origin
    ONE = 1  # the one that the normal points to
    BOTH = 2


FLAT: Final = 3
"""Kind of a flat cell; that of others is the number of axes along which their points lie close."""


class YoungSurfaces(Enum):
    """How surfaces of a map that has only just begun count in weak directions.

    The rims of the view look like surfaces too, and move along with the sensor.
    """

    TRUSTED = "trusted"  # like surfaces that have been in the map for long
    APART = "apart"  # weak directions of the place are separated from all others
    IGNORED = "ignored"  # the same, and young surfaces say nothing about them


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
    point_variances : ndarray, shape (M,)
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
    point_variances: F64
    born: I64
    opened: I64
    is_fine: NDArray[np.bool_]
    cells: I64
    axis: I64


class Candidates(NamedTuple):
    """Points and the surfaces that may be theirs.

    Attributes
    ----------
    point : ndarray, shape (M,)
        Which of the points.
    cells : ndarray, shape (M,)
        Rows of the surfaces' cells in the map.
    level : ndarray, shape (M,)
        Of these cells.
    axis : ndarray, shape (M,)
        Which of its cell's axes a surface's normal is.
    """

    point: I64
    cells: I64
    level: I64
    axis: I64

    def some(self, which: I64 | NDArray[np.bool_]) -> Candidates:
        """Return some of these, by indices or a mask."""
        return Candidates(*(part[which] for part in self))

    def followed_by(self, others: Candidates) -> Candidates:
        """Return these and others after them."""
        return Candidates(*(np.concatenate(pair) for pair in zip(self, others, strict=True)))


def matches_with(
    found: Candidates,
    points: F64,
    planes: NDArray[np.void],
    count: F64,
    flat: NDArray[np.bool_],
) -> Matches:
    """Return how far points are from the surfaces that may be theirs.

    Parameters
    ----------
    found : Candidates
    points : ndarray, shape (M, 3)
        [m], map frame.
    planes : ndarray, shape (M,), dtype PLANE
        Of the cells.
    count : ndarray, shape (M,)
        Of the points in the cells.
    flat : ndarray, shape (M,)
        Whether the cells are flat.
    """
    offset = points - planes["mean"]
    axes = planes["axes"]
    along = np.einsum("nij,nj->ni", axes, offset)
    spread = planes["spread"]
    # a plane fitted to n points is worst known far from their middle
    reach = 1.0 + along[:, 1] ** 2 / spread[:, 1] + along[:, 2] ** 2 / spread[:, 2]
    normal: tuple[Any, ...] = slice(None), 0  # of nearly all the first of their axes
    if found.axis.any():
        normal = np.arange(len(found.axis)), found.axis
    across = spread[normal]
    return Matches(
        found.point,
        np.ascontiguousarray(axes[normal]),
        along[normal],
        across * reach / count,
        np.where(flat, 0.0, across),
        planes["born"],
        planes["opened"],
        found.level < tuning.FINE_LEVELS,
        found.cells,
        found.axis,
    )


def are_behind(points: F64, origins: F64, planes: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return which points are seen from the back of their surfaces.

    Parameters
    ----------
    points : ndarray, shape (M, 3)
        [m], map frame.
    origins : ndarray, shape (M, 3) or (3,)
        Where each is seen from, or all [m].
    planes : ndarray, shape (M,), dtype PLANE
    """
    ways = origins - points
    along = np.einsum("ni,ni->n", planes["axes"][:, 0], ways)
    least = tuning.SIDE_SLACK * np.sqrt(np.einsum("ni,ni->n", ways, ways))
    return np.asarray((planes["sided"] == Sides.ONE) & (along < -least))


def are_within(
    points: F64, planes: NDArray[np.void], sigmas: float, margin: float = 0.0
) -> NDArray[np.bool_]:
    """Return which points (M,) lie within the extent of flat surfaces, along these.

    Parameters
    ----------
    points : ndarray, shape (M, 3)
        [m], map frame.
    planes : ndarray, shape (M,), dtype PLANE
        The surface of each.
    sigmas : float
        The extent on either side of the middle, in standard deviations of a surface's points,
    margin : float
        and so much more [m].
    """
    along = np.einsum("nij,nj->ni", planes["axes"][:, 1:], points - planes["mean"])
    limits = sigmas * np.sqrt(planes["spread"][:, 1:]) + margin
    return np.asarray((np.abs(along) <= limits).all(axis=1))


def tilts_of(planes: NDArray[np.void], sweeps: F64, axis: I64) -> F64:
    """Return how far normals may be tilted towards each axis of their cells, 1 sigma.

    A plane fitted to points of extent l and scatter s is tilted by s / l / sqrt(n) (the first
    order of the eigenvectors' errors). The sweeps are counted, not the points: those of one sweep
    err together.

    Parameters
    ----------
    planes : ndarray, shape (M,), dtype PLANE
    sweeps : ndarray, shape (M,)
        In which points of them came.
    axis : ndarray, shape (M,)
        Which of its cell's axes each normal is.

    Returns
    -------
    ndarray, shape (M, 3, 3)
        Row i is the cell's axis i, as long as the normal's tilt towards it [rad]; zero for the
        normal itself.
    """
    each = np.arange(len(planes))
    spread = planes["spread"]
    across = np.maximum(spread[each, axis], tuning.NORMAL_SCATTER**2) / sweeps
    angles = np.sqrt(across[:, None] / np.maximum(spread, tuning.NORMAL_LEAST_EXTENT**2))
    angles[each, axis] = 0.0
    return np.asarray(planes["axes"] * angles[:, :, None])


def widths_of(planes: NDArray[np.void], axis: I64) -> F64:
    """Return the standard deviations [m], (M,), of surfaces along the narrower of their own axes.

    Parameters
    ----------
    planes : ndarray, shape (M,), dtype PLANE
    axis : ndarray, shape (M,)
        Which of its cell's axes each normal is.
    """
    spread = planes["spread"].copy()
    spread[np.arange(len(planes)), axis] = np.inf
    return np.asarray(np.sqrt(spread.min(axis=1)))


def weights_from(ways: F64) -> F64:
    """Return the weights (C,) of points at vectors (C, 3) from the sensor [m]."""
    squared = np.einsum("ni,ni->n", ways, ways)
    return np.asarray(1.0 / (1.0 + squared / tuning.WEIGHT_RANGE**2))


def fit(
    cells: NDArray[np.void],
    planes: NDArray[np.void],
    middles: F64,
    sizes: F64,
    thickness: float,
    origin: F64 | None,
) -> NDArray[np.int8]:
    """Fit planes, in place, to the points in some cells; return the kinds (M,) of these cells.

    Parameters
    ----------
    cells : ndarray, shape (M,), dtype CELL
    planes : ndarray, shape (M,), dtype PLANE
        As they are known so far.
    middles : ndarray, shape (3, M)
        Of the cells [m].
    sizes : ndarray, shape (M,)
        Their edges [m].
    thickness : float
        Largest standard deviation across a flat surface [m].
    origin : ndarray, shape (3,), optional
        Of the latest points: normals point to it, if there is one [m].
    """
    weight = cells["weight"]
    mean = cells["sum"].T / weight
    covariance = cells["products"].T / weight
    for line, product in zip(covariance, products(*mean), strict=True):
        line -= product
    spread, axes = principal_axes(covariance)
    spread = np.maximum(spread, 1e-8)
    wide = np.maximum(tuning.ELONGATED * spread[:, 0], (tuning.FLAT_WIDTH * sizes) ** 2)
    flat = (spread[:, 0] < thickness**2) & (spread[:, 1] > wide)
    place = np.ascontiguousarray((mean + middles).T)
    if origin is not None:
        ways = origin - place
        behind = np.einsum("ni,ni->n", axes[:, 0], ways) < 0.0
        axes[behind, 0] *= -1.0
        least = tuning.SIDE_SLACK * np.sqrt(np.einsum("ni,ni->n", ways, ways))
        is_other = np.einsum("ni,ni->n", planes["axes"][:, 0], ways) < -least
        both = is_other & (planes["sided"] == Sides.ONE)
        both |= planes["sided"] == Sides.BOTH
        planes["sided"] = np.where(both, Sides.BOTH, Sides.ONE)
    planes["mean"], planes["axes"], planes["spread"] = place, axes, spread
    close = spread[:, :2] < (tuning.NARROW * sizes[:, None]) ** 2
    close &= (cells["sweeps"] >= tuning.NARROW_SWEEPS)[:, None]
    return np.where(flat, FLAT, close.sum(axis=1)).astype(np.int8)
