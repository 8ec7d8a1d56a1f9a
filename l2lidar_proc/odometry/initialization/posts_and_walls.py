"""Upright things in some seconds of points, divided into posts and walls.

Points of several sweeps are placed as a motion says. Where one sweep saw an upright thing, others
do as well, so at the right motion the points occupy the fewest cells. That holds for posts. A wall
is met by each scan line somewhere else: at 20 m the columns of points of a sweep are 2 m apart,
and where the sensor turns as it moves, those of later sweeps may lie on top of them at a velocity
of 2 m/s more than the right one. So the place of a point along its wall does not count, only the
one across it.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import F64, I64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.walls.wall_velocity import level_axes

SEEN: Final = np.dtype(
    [
        ("stamp", "<i8"),  # [ns]
        ("place", "<f8", (3,)),  # [m] from where the sensor is at the end, map axes
        ("sight", "<f8", (3,)),  # [m] from where the sensor was then, map axes
        ("intensity", "<f8"),  # of any unit; 0 where none is measured
        ("sweep", "<i8"),  # number of its sweep
    ]
)
"""A point of the last seconds, placed by the IMU."""

AT_ONCE: Final = 20_000
"""Points placed at once, at several velocities: more leave the cache, fewer take longer."""

Seen = NDArray[np.void]
"""Points (N,), dtype SEEN."""


class Upright(NamedTuple):
    """Upright things whose points are counted alike: all posts, or the walls of one direction.

    Attributes
    ----------
    points : ndarray, shape (N,), dtype SEEN
    axes : ndarray, shape (3, 3)
        Its rows are the axes of the cells, map axes: along, across to the left, and up.
    least : tuple of float
        Smallest edges of a cell along these axes [m].
    is_wall : bool
        Whether the axes turn with the points, where these are turned.
    """

    points: Seen
    axes: F64
    least: tuple[float, float, float]
    is_wall: bool

    def occupied(
        self, now: int, errors: F64, cells: tuple[float, ...], yaw_rate: float = 0.0
    ) -> I64:
        """Return how many cells the points occupy at some errors of the velocity.

        Parameters
        ----------
        now : int
            Instant at which place and heading are right [ns].
        errors : ndarray, shape (M, 3)
            What has to be added to the velocity [m/s], map axes.
        cells : tuple of float
            Their sizes [m]; those of all sizes count.
        yaw_rate : float
            What has to be added to the yaw rate [rad/s].

        Returns
        -------
        ndarray, shape (M,), dtype int64
        """
        ages, axes = (self.points["stamp"] - now) * 1e-9, self.axes
        if self.is_wall:
            axes = _yawed(axes.T, -yaw_rate * float(np.median(ages))).T
        sights = self.points["sight"] @ axes.T
        places = _yawed(sights, yaw_rate * ages) + (self.points["place"] @ axes.T - sights)
        counts = np.zeros(len(errors), np.int64)
        moves = (errors @ axes.T)[:, :, None]
        edges = [np.maximum(size, self.least)[:, None] for size in cells]
        some = max(AT_ONCE // len(places), 1)
        for first in range(0, len(errors), some):
            part = slice(first, first + some)
            moved = places.T + moves[part] * ages
            for edge in edges:
                keys = _keys(*np.floor(moved / edge).astype(np.int64).swapaxes(0, 1))
                keys.sort(axis=1)
                counts[part] += np.count_nonzero(np.diff(keys, axis=1), axis=1) + 1
        return counts

    def decimated(self, share: float) -> Upright:
        """Return them with a share of their points."""
        most = max(round(share * len(self.points)), 1)
        return self._replace(points=records.decimated(self.points, most))


def posts_and_walls(seen: Seen, along: F64) -> list[Upright]:
    """Return the upright things among points: posts, and then walls of up to four directions.

    Points of walls that face elsewhere, or of too few points in one direction, are left out.

    Parameters
    ----------
    seen : ndarray, shape (N,), dtype SEEN
    along : ndarray, shape (3, 3)
        Level axes as :func:`~l2lidar_proc.odometry.walls.wall_velocity.level_axes` returns them,
        along which posts are counted.

    Returns
    -------
    list of Upright
        Without those that have no points.
    """
    points = upright(seen, -along[2])
    angles = _wall_angles(points, along)
    is_post = np.isnan(angles)
    of_posts = 0.0, tuning.START_ACROSS, tuning.START_ROW
    of_walls = tuning.START_WALL_CELL, 0.0, tuning.START_WALL_ROW
    found = [Upright(points[is_post], along, of_posts, is_wall=False)]
    left = ~is_post
    for _ in range(tuning.START_WALLS):
        if np.count_nonzero(left) < tuning.START_WALL_POINTS:
            break
        angle = _commonest(angles[left])
        off = np.abs(_folded(angles - angle))
        mine = left & (off < tuning.START_WALL_ANGLE)
        axes = _yawed(along.T, -angle).T
        found.append(Upright(points[mine], axes, of_walls, is_wall=True))
        left &= off >= tuning.START_WALL_ANGLE
    return [one for one in found if len(one.points)]


def upright(seen: Seen, gravity: F64) -> Seen:
    """Return points of upright things, one for each small cell and sweep.

    Points with others close above or below, seen within so short a time that no velocity matters.

    Parameters
    ----------
    seen : ndarray, shape (N,), dtype SEEN
    gravity : ndarray, shape (3,)
    """
    seen = seen[(seen["sight"] ** 2).sum(axis=1) < tuning.START_RANGE**2]
    frame = level_axes(np.eye(3)[np.argmin(np.abs(gravity))], gravity)
    places = seen["place"] @ frame.T
    if not len(seen):
        return seen
    times = (seen["stamp"] - seen["stamp"].min()) // tuning.START_SLICE_NS
    levels = np.floor(places / tuning.START_COLUMN).astype(np.int64)
    keys, column = np.unique(_keys(times, *levels.T), return_inverse=True)
    down_2, down, up, up_2 = (
        np.isin(keys + step, keys, assume_unique=True) for step in (-2, -1, 1, 2)
    )
    is_upright = ((down_2 & down) | (down & up) | (up & up_2))[column]
    seen, places = seen[is_upright], places[is_upright]
    if not len(seen):
        return seen
    cells = np.floor(places / tuning.START_SPOT).astype(np.int64)
    first = np.unique(_keys(seen["sweep"], *cells.T), return_index=True)[1]
    return records.decimated(seen[first], tuning.START_MOST)


def _wall_angles(points: Seen, along: F64) -> F64:
    """Return the direction of the wall of each upright point (N,) [rad]; NaN where it has none.

    A wall is a row of columns of points, as long as the gaps that a sweep leaves at its range.
    """
    from scipy.spatial import cKDTree  # brings scipy.sparse along; a node starts without

    places, sights = (points[name] @ along[:2].T for name in ("place", "sight"))
    angles = np.full(len(points), np.nan)
    for number in np.unique(points["sweep"]).tolist():
        mine = np.flatnonzero(points["sweep"] == number)
        cells = np.floor(places[mine] / tuning.START_WALL_COLUMN).astype(np.int64)
        _, first, column = np.unique(_keys(*cells.T), return_index=True, return_inverse=True)
        columns = places[mine[first]]
        ranges = np.linalg.norm(sights[mine[first]], axis=1)
        reach = np.clip(tuning.START_WALL_REACH[0] * ranges, *tuning.START_WALL_REACH[1:])
        near = cKDTree(columns).query_ball_point(columns, reach).tolist()
        count = np.array([len(some) for some in near])
        starts = np.cumsum(count) - count  # each is near itself
        apart = columns[np.concatenate(near)] - np.repeat(columns, count, axis=0)
        mean = np.add.reduceat(apart, starts) / count[:, None]
        products = apart[:, :, None] * apart[:, None]
        second = np.add.reduceat(products, starts) / count[:, None, None]
        squares, directions = np.linalg.eigh(second - mean[:, :, None] * mean[:, None])
        is_wall = (
            (count >= tuning.START_WALL_COLUMNS)
            & (squares[:, 1] > (tuning.START_WALL_LENGTH * reach) ** 2)
            & (squares[:, 0] < tuning.START_WALL_FLAT**2 * squares[:, 1])
        )
        found = np.arctan2(directions[:, 1, 1], directions[:, 0, 1])
        angles[mine] = np.where(is_wall, found, np.nan)[column.ravel()]
    return angles


def _commonest(angles: F64) -> float:
    """Return the direction near which most directions (N,) lie [rad]; half a turn is none."""
    bins = np.floor(np.rad2deg(angles) % 180.0).astype(np.int64) % 180
    counts = np.bincount(bins, minlength=180)
    width = round(np.rad2deg(tuning.START_WALL_ANGLE))
    shifts = range(-width, width + 1)  # near ones count more: the middle of a crowd is its peak
    crowd = sum((width + 1 - abs(shift)) * np.roll(counts, shift) for shift in shifts)
    peak = np.deg2rad(int(np.argmax(crowd)) + 0.5)
    off = _folded(angles - peak)
    return float(peak + np.median(off[np.abs(off) < tuning.START_WALL_ANGLE]))


def _folded(angles: F64) -> F64:
    """Return directions within a quarter turn of zero [rad]."""
    return np.asarray((angles + np.pi / 2) % np.pi - np.pi / 2)


def _yawed(points: F64, angles: F64 | float) -> F64:
    """Return points (N, 3) turned about the third axis by angles, one or (N,) [rad]."""
    cosines, sines = np.cos(angles), np.sin(angles)
    x, y, z = points.T
    return np.column_stack((cosines * x - sines * y, sines * x + cosines * y, z))


def _keys(*parts: I64) -> I64:
    """Return one number for each combination of numbers; neighbors differ in the last one."""
    keys = np.zeros(parts[0].shape, np.int64)
    for part in parts:
        lowest = int(part.min())
        # four more, so that two steps beyond the last do not meet the next combination
        keys = keys * (int(part.max()) - lowest + 5) + (part - lowest + 2)
    return keys
