"""The two halves of an L2's fan: which of them measured a point, and the gaps between them.

A cloud does not say which half a point belongs to, but the head turns steadily: twice the azimuth
of a point is twice the head's angle in either half, so a line through it over time gives the
head's angle but for half a turn, and the elevation rises in one half and falls in the other.
Clouds without that pattern, of other sensors or in other frames, have no halves.

To first order (:mod:`l2lidar_node.calibration.model`) an error of xi moves a point at range D by
-D, and one of beta by its height z, along e_A, the horizontal direction across the fan. One of
alpha turns the fan in its own plane: one half rises by it, the other one sinks.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.clouds import OPTICAL_CENTRE_M
from l2lidar_node.types import F64, I64
from l2lidar_proc import tuning
from l2lidar_proc.cloud import positions_by_axis
from l2lidar_proc.odometry.local_map.cell_grid import begins_of_runs, distinct_in_runs
from l2lidar_proc.odometry.local_map.principal_axes import principal_axes, products

_HEAD_HZ: Final = np.arange(3.0, 8.0, 0.05)  # units were measured from 4.3 to 5.6
_RATE_NEAR: Final = 1.0 + np.arange(-0.02, 0.0201, 0.004)  # of a head whose rate is known
_NEAR_M: Final = 0.5  # from the head's axis; nearer, the azimuth says little
_FAN_S: Final = 2e-4  # between points that follow each other in a fan
_RATE_SPAN_S: Final = 0.04  # a sixth of a turn tells the head's rate to 3 %; in less any rate fits
_MOST: Final = 200  # points that show the head's angle
_SHOWN: Final = 3000  # points whose order tells the halves apart
_FITS: Final = 0.9  # length of the mean of unit vectors; 1 where a line fits all points
_RISES: Final = 0.1  # mean of the signs by which elevations change; 0 where there is no fan
_HALF_LEAST: Final = 0.05  # share of the points that the smaller half has
# standard deviations at which a cell keeps a quarter of its weight, in the steps of each round;
# wide at first, or a few false gaps decide the sign
_SCALES_AT_REST: Final = ((12.0, 8.4, 6.0, 4.2, 3.0, 3.0), *[(3.0, 3.0, 3.0)] * 5)


class Halves(NamedTuple):
    """Which half of the fan measured each point of a cloud.

    Attributes
    ----------
    sign : ndarray, shape (N,)
        1 where the elevation rises with time, -1 where it falls.
    rate : float
        Of the head [rad/s].
    angle : float
        Azimuth of the half that rises, at time 0 of the points [rad].
    """

    sign: F64
    rate: float
    angle: float


def halves(points: NDArray[np.void], rate: float | None = None) -> Halves | None:
    """Return the halves of a cloud, None where it does not have the pattern of an L2.

    Parameters
    ----------
    points : ndarray, shape (N,)
        With x, y, z [m] in the cloud frame, not deskewed, and time [s], ascending.
    rate : float, optional
        Of the head as known so far [rad/s].
    """
    x, y, z, time = (points[name].astype(np.float32) for name in ("x", "y", "z", "time"))
    radius = np.maximum(np.sqrt(x * x + y * y), np.float32(1e-6))
    far = np.flatnonzero(radius > _NEAR_M)
    if len(far) < tuning.BEAM_POINTS:
        return None
    some = records.decimated(far, _MOST)
    if rate is None and time[some[-1]] - time[some[0]] < _RATE_SPAN_S:
        return None
    doubled = ((x[some] + 1j * y[some]) / radius[some]) ** 2
    rates = 2.0 * np.pi * _HEAD_HZ if rate is None else rate * _RATE_NEAR
    means = np.exp(-2j * np.outer(rates, time[some])) @ doubled / len(some)
    best = int(np.abs(means).argmax())
    if np.abs(means[best]) < _FITS:
        return None
    found = float(rates[best])
    fan = np.float32(found) * time + np.float32(0.5 * np.angle(means[best]))
    sign = np.where(x * np.cos(fan) + y * np.sin(fan) >= 0.0, 1.0, -1.0)
    part = slice(_SHOWN)
    height = z[part] / radius[part]
    follows = (np.diff(time[part]) < _FAN_S) & (sign[1:_SHOWN] == sign[: len(height) - 1])
    rises = (np.sign(np.diff(height)) * sign[1:_SHOWN])[follows]
    if len(rises) < tuning.BEAM_POINTS or abs(rises.mean()) < _RISES:
        return None
    share = np.count_nonzero(sign > 0.0) / len(sign)
    if not _HALF_LEAST < share < 1.0 - _HALF_LEAST:
        return None
    angle = 0.5 * float(np.angle(means[best])) + np.pi * float(rises.mean() < 0.0)
    return Halves(sign * np.sign(rises.mean()), found, angle)


class Gaps(NamedTuple):
    """Flat cells that both halves see.

    Attributes
    ----------
    gap : ndarray, shape (C,)
        Of the rising half from the falling one along the normal [m].
    derivatives : ndarray, shape (C, 3)
        Derivatives of the gap by xi, beta and alpha [m/rad].
    motion : ndarray, shape (C, 6)
        Derivatives by errors of velocity [s] and rate [m s/rad] of what deskewed the points.
    """

    gap: F64
    derivatives: F64
    motion: F64


def angle_derivatives(points: NDArray[np.void], head: Halves) -> F64:
    """Return how points move with errors of xi, beta and alpha.

    The direction of the fan is that of the head, not that of the point: near the head's axis, what
    is 0.8 degrees beside the fan is seen elsewhere, by up to a right angle.

    Parameters
    ----------
    points : ndarray, shape (N,)
        Some of the cloud's, with x, y, z [m] in the cloud frame, not deskewed, and time [s].
    head : Halves
        Of the cloud.

    Returns
    -------
    ndarray, shape (3, 3, N)
        Along x, y and z; by xi, beta and alpha [m/rad].
    """
    x, y, z = (points[name].astype(np.float64) for name in "xyz")
    fan = head.angle + head.rate * points["time"].astype(np.float64)
    cos, sin = np.cos(fan), np.sin(fan)
    xi, above = -np.sqrt(x * x + y * y + z * z), z - OPTICAL_CENTRE_M
    level = np.zeros_like(z)
    return np.stack(
        (
            np.stack((xi * sin, z * sin, -above * cos)),
            np.stack((-xi * cos, -z * cos, -above * sin)),
            np.stack((level, level, x * cos + y * sin)),
        )
    )


def between_halves(points: NDArray[np.void], moved: NDArray[np.void], head: Halves) -> Gaps | None:
    """Return the gaps between the halves of a cloud, None where no flat cell has both.

    Parameters
    ----------
    points, moved : ndarray, shape (N,)
        As measured, and deskewed.
    head : Halves
        Of the cloud.
    """
    at = positions_by_axis(moved)
    cell = cell_numbers(at)
    count = int(cell.max()) + 1 if len(cell) else 0
    rising = head.sign > 0.0
    numbers = np.stack([np.bincount(cell[some], minlength=count) for some in (rising, ~rising)])
    both = numbers.min(axis=0, initial=len(rising)) >= tuning.BEAM_CELL_POINTS
    inside = both[cell]
    if not inside.any():
        return None
    kept = np.cumsum(both) - 1
    at, cell, rising = at[:, inside], kept[cell[inside]], rising[inside]
    derivatives = angle_derivatives(records.selected(points, inside), head).reshape(9, -1)
    time = points["time"][inside].astype(np.float64)
    time -= 0.5 * (time.min() + time.max())
    values = np.concatenate((at, derivatives, time[None], time * at))
    apart, spread, axes = _compared(values, cell, rising)
    normal = axes[:, 0].T
    gap = (normal * apart[:3]).sum(axis=0)
    beside = np.sqrt(np.maximum((apart[:3] ** 2).sum(axis=0) - gap**2, 0.0))
    flat = (spread[:, 0] < tuning.BEAM_THICKNESS**2) & (
        spread[:, 1] > (tuning.BEAM_WIDTH * tuning.BEAM_CELL) ** 2
    )
    flat &= (beside < 0.5 * tuning.BEAM_CELL) & (np.abs(gap) < tuning.BEAM_GAP_MOST)
    if np.count_nonzero(flat) < tuning.BEAM_CELLS:
        return None
    across = np.einsum("jk,jak->ak", normal, apart[3:12].reshape(3, 3, -1))
    turned = np.cross(apart[13:16].T, normal.T)
    motion = np.column_stack(((normal * apart[12]).T, turned))
    return Gaps(gap[flat], across.T[flat], motion[flat])


def angles_at_rest(
    sweeps: list[tuple[NDArray[np.void], Halves]], prior: F64, start: tuple[F64, F64]
) -> tuple[F64, F64] | None:
    """Return the beam angles with which both halves see the same at rest, and their information.

    In each cell, the mean of the points of one half is compared with that of the other, along the
    directions in which the points lie close together: across walls, but also across trunks and
    poles, of which both halves see the whole width. Along anything that continues in the next
    cell, the mean is that of the cell, whatever the angles. The halves see a cell in a few lines
    each, so a mean is as uncertain as the points scatter, over the number of lines.

    The angles are applied before the next round. Points of one thing must lie in one cell, so a
    cell counts once the angles are known well enough for that.

    Parameters
    ----------
    sweeps : list of tuple of ndarray and Halves
        From one place: the points (N,) of each, cloud frame, as the unit reports them.
    prior : ndarray, shape (3, 3)
        Information of the angles' being zero [1/rad^2].
    start : tuple of ndarray
        Angles (3,) to begin with, and information (3, 3) of them: far cells can be compared at
        once if it is known. It adds nothing to what is returned.

    Returns
    -------
    angles : ndarray, shape (3,)
        Corrections of xi, beta and alpha [rad].
    information : ndarray, shape (3, 3)
        Of them, the prior's included [1/rad^2].

    None instead where no cell can be compared.
    """
    points = records.joined([some for some, _ in sweeps])
    at = positions_by_axis(points)
    along = np.concatenate([angle_derivatives(*some) for some in sweeps], axis=2)
    sign = np.concatenate([head.sign for _, head in sweeps])
    line = np.floor(np.arctan2(at[1], at[0]) / tuning.BEAM_REST_APART).astype(np.int64)
    line -= line.min(initial=0)
    angles, information = start
    compared = False
    for number, scales in enumerate(_SCALES_AT_REST):
        moved = at + np.einsum("jan,a->jn", along, angles)
        shift = 0.5 * (number % 2)  # what a face of a cell cuts is whole in the next round
        seen = _seen_by_both(moved, along, sign, line, shift)
        if seen is None:
            continue
        gap, lever, weight = seen
        unknown = np.einsum("kia,ab,kib->k", lever, np.linalg.inv(information), lever)
        inside = weight * (unknown < tuning.BEAM_REST_UNKNOWN**2)[:, None]
        compared |= bool(inside.any())
        step = np.zeros(3)
        for scale in scales:
            squared = (inside * (gap + lever @ step) ** 2).sum(axis=1)
            robust = inside / (1.0 + squared[:, None] / scale**2) ** 2
            weighted = lever * robust[..., None]
            information = prior + np.einsum("kia,kib->ab", weighted, lever)
            gradient = np.einsum("kia,ki->a", weighted, gap) + prior @ angles
            step = -np.linalg.solve(information, gradient)
        angles = angles + step
    return (angles, information) if compared else None


def _seen_by_both(
    at: F64, along: F64, sign: F64, line: I64, shift: float
) -> tuple[F64, F64, F64] | None:
    """Return the gaps between the halves in cells, along the cells' principal axes.

    None where no cell is seen often enough by both.

    Parameters
    ----------
    at : ndarray, shape (3, N)
        Points [m].
    along : ndarray, shape (3, 3, N)
        Their :func:`angle_derivatives`.
    sign, line : ndarray, shape (N,)
        Their halves, and the numbers of the directions of the head in which they were seen.
    shift : float
        Of the grid, in cells.

    Returns
    -------
    gap : ndarray, shape (C, 3)
        Of the rising half from the falling one [m].
    derivatives : ndarray, shape (C, 3, 3)
        Derivatives of the gap by xi, beta and alpha [m/rad].
    weight : ndarray, shape (C, 3)
        Of the gaps [1/m^2], 0 along what continues in the next cell.
    """
    cell = cell_numbers(at, shift)
    count = int(cell.max()) + 1 if len(cell) else 0
    rising = sign > 0.0
    lines = int(line.max(initial=0)) + 1
    swept = []
    numbers = []
    for half in (rising, ~rising):
        cells = cell[half]
        pairs = np.sort(cells * lines + line[half])
        swept.append(np.bincount(pairs[begins_of_runs(pairs)] // lines, minlength=count))
        numbers.append(np.bincount(cells, minlength=count))
    both = (np.min(numbers, axis=0) >= tuning.BEAM_REST_POINTS) & (
        np.min(swept, axis=0) >= tuning.BEAM_REST_LINES
    )
    inside = both[cell]
    if not inside.any():
        return None
    kept = np.cumsum(both) - 1
    values = np.concatenate((at, along.reshape(9, -1)))[:, inside]
    apart, spread, axes = _compared(values, kept[cell[inside]], rising[inside])
    swept = [n[both] for n in swept]
    ends = 1.0 - spread / (tuning.BEAM_REST_WIDTH * tuning.BEAM_CELL) ** 2
    per_line = (1.0 / swept[0] + 1.0 / swept[1])[:, None]
    variance = tuning.BEAM_REST_SCATTER * spread * per_line + tuning.BEAM_GAP_SIGMA**2
    weight = np.maximum(ends, 0.0) ** 2 / variance
    gap = np.einsum("kij,jk->ki", axes, apart[:3])
    lever = np.einsum("kij,jak->kia", axes, apart[3:12].reshape(3, 3, -1))
    return gap, lever, weight


def _compared(values: F64, cell: I64, rising: NDArray[np.bool_]) -> tuple[F64, F64, F64]:
    """Return the differences of the halves' means in cells, and the cells' principal axes.

    Parameters
    ----------
    values : ndarray, shape (L, N)
        Of points; the first three are their places [m].
    cell : ndarray, shape (N,)
        Numbers of their cells, from 0 on; each has points of both halves.
    rising : ndarray, shape (N,), bool

    Returns
    -------
    apart : ndarray, shape (L, C)
        Means of the rising half less those of the falling one.
    spread, axes : ndarray, shape (C, 3) and (C, 3, 3)
        Of the points about the mean of their half, as :func:`principal_axes` returns them.
    """
    half = 2 * cell + rising
    numbers = np.bincount(half)
    means = np.stack([np.bincount(half, line) for line in values]) / numbers
    around = values[:3] - means[:3, half]
    total = numbers[::2] + numbers[1::2]
    covariance = [np.bincount(cell, line) / total for line in products(*around)]
    spread, axes = principal_axes(np.stack(covariance))
    return means[:, 1::2] - means[:, ::2], spread, axes


def cell_numbers(at: F64, shift: float = 0.0) -> I64:
    """Return the number (N,) of the cell of each point (3, N) [m], from 0 on.

    Cells have edges of BEAM_CELL; the grid may be shifted, by a share of them.
    """
    x, y, z = np.floor(at / tuning.BEAM_CELL + shift).astype(np.int64)
    return distinct_in_runs((x << 40) + (y << 20) + z)[1]
