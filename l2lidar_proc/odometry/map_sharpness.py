"""Sharpness of a map: the errors of the motion with which some seconds of points fit together.

Points of several sweeps are placed as a motion says. An error of its velocity shears them along
the way, one of its yaw rate winds them up, and either smears every post. The errors with which
they occupy the fewest cells are the most likely ones: autofocus, as of a synthetic aperture. Only
upright things count: floors and ceilings look the same at any velocity.

Beside bare walls the fewest cells are those of a sensor at rest, since the rims of the view move
along with it. There the profile of the walls tells the velocity
(:mod:`~l2lidar_proc.odometry.wall_profile`).
"""

from __future__ import annotations

import itertools
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import F64, I64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.wall_profile import (
    Spots,
    are_walls,
    extract_spots,
    likelihood_of,
    log_likelihood,
)
from l2lidar_proc.odometry.wall_velocity import level_axes

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

Seen = NDArray[np.void]
"""Points (N,), dtype SEEN."""


def candidates(sigma: float, step: float) -> list[float]:
    """Return the errors of the velocity to compare along one axis [m/s].

    Parameters
    ----------
    sigma : float
        Of the velocity along it [m/s].
    step : float
        They are no farther apart [m/s].
    """
    reach = min(tuning.START_SIGMAS * sigma, tuning.START_REACH)
    return _steps(reach, step)


def _steps(reach: float, step: float) -> list[float]:
    """Return values from -reach to reach, no farther apart than a step, and 0 among them."""
    count = max(int(np.ceil(reach / step - 1e-6)), 2)
    return [float(value) for value in np.linspace(-reach, reach, 2 * count + 1)]


def velocity_log_likelihoods(
    seen: Seen, now: int, axes: F64, errors: F64, gravity: F64, walls: Spots | None
) -> F64 | None:
    """Return how likely errors of the velocity are, as logarithms (M,); None if nobody can tell.

    Parameters
    ----------
    seen : ndarray, shape (N,), dtype SEEN
    now : int
        Instant of the state whose velocity is compared [ns].
    axes : ndarray, shape (K, 3)
        Level, orthonormal; K is 1 or 2.
    errors : ndarray, shape (M, K)
        What has to be added to the velocity along each axis [m/s].
    gravity : ndarray, shape (3,)
        [m/s^2]
    walls : ndarray, dtype SPOT, or None
        As :func:`wall_spots` returns them.
    """
    along = level_axes(axes[0], gravity)
    if walls is not None:
        logs = log_likelihood(walls, now, along, errors[:, 0])
        has_edges = np.ptp(logs) > tuning.START_PROFILE
        return np.log(likelihood_of(logs, errors[:, 0])) if has_edges else None
    posts = upright(seen, gravity)
    if len(posts) < tuning.START_POSTS:
        return None
    places, ages = posts["place"] @ along.T, (posts["stamp"] - now) * 1e-9
    moves = errors @ (axes @ along.T)
    counts = np.array(
        [_occupied(places + ages[:, None] * move, tuning.START_CELLS) for move in moves]
    )
    return np.asarray((counts.min() - counts) / (tuning.START_SCALE * np.sqrt(len(posts))))


def yaw_rate_error(
    seen: Seen, now: int, axes: F64, gravity: F64, velocity: F64
) -> tuple[float, float] | None:
    """Return what has to be added to the yaw rate, and its sigma [rad/s]; None where nothing is.

    It is the one with which upright points occupy the fewest cells, at the velocity with which
    they then do so. A slow one is likelier.

    Parameters
    ----------
    seen : ndarray, shape (N,), dtype SEEN
    now : int
        Instant at which the heading is right [ns].
    axes : ndarray, shape (K, 3)
        Level, orthonormal, along which the velocity may be wrong; K is 1 or 2.
    gravity : ndarray, shape (3,)
        [m/s^2]
    velocity : ndarray, shape (3,)
        As estimated [m/s], map axes.
    """
    if wall_spots(seen, axes, gravity) is not None:
        return None  # they show the heading
    frame = level_axes(axes[0], gravity)
    posts = upright(seen, gravity)
    if len(posts) < tuning.START_POSTS:
        return None
    moves = axes @ frame.T
    along = velocity @ frame.T @ moves.T @ moves
    steps = candidates(tuning.START_PRIOR, tuning.START_YAW_VELOCITY_STEP)
    errors = np.array([*itertools.product(steps, repeat=len(axes))]) @ moves
    rates = np.array(_steps(tuning.START_YAW_REACH, tuning.START_YAW_STEP))
    some = records.decimated(posts, tuning.START_YAW_MOST)
    logs, best = _sharpest(some, now, frame, rates, errors, along, tuning.START_CELLS[:2])
    unchanged = len(rates) // 2
    others = np.delete(np.arange(len(rates)), unchanged)
    other = others[np.argmax(logs[others])]
    better = logs[other] - logs[unchanged]
    if better < -tuning.START_YAW_BETTER:
        return None
    near = np.array([*itertools.product(
        _steps(tuning.START_YAW_VELOCITY_STEP, tuning.START_STEP), repeat=len(axes)
    )]) @ moves  # fmt: skip
    finer = np.array(_steps(tuning.START_YAW_STEP, tuning.START_YAW_FINER))

    def refined(index: int) -> tuple[F64, F64]:
        some = rates[index] + finer
        about = best[index] + near
        return some, _sharpest(posts, now, frame, some, about, along, tuning.START_CELLS)[0]

    fine, logs = refined(other)
    if better < tuning.START_YAW_BETTER:
        # the coarse cells do not tell the two apart
        better = logs.max() - refined(unchanged)[1].max()
        if better < tuning.START_YAW_BETTER:
            return None
    weights = np.exp(logs - logs.max())
    mean = float(np.average(fine, weights=weights))
    variance = float(np.average((fine - mean) ** 2, weights=weights))
    return mean, float(np.sqrt(variance + tuning.START_YAW_NOISE**2))


def _sharpest(
    posts: Seen,
    now: int,
    frame: F64,
    rates: F64,
    errors: F64,
    velocity: F64,
    cells: tuple[float, ...],
) -> tuple[F64, F64]:
    """Return how likely errors of the yaw rate are (M,), as logarithms, each with its velocity.

    Parameters
    ----------
    posts : ndarray, shape (N,), dtype SEEN
    now : int
    frame : ndarray, shape (3, 3)
        Its rows are the axes that places are counted along.
    rates : ndarray, shape (M,)
        [rad/s]
    errors : ndarray, shape (L, 3)
        Of the velocity, along the axes of the frame [m/s]: one of them comes with each rate.
    velocity : ndarray, shape (3,)
        To which they are added, as far as it may be wrong.
    cells : tuple of float
        Their sizes [m].
    """
    ages, sights = (posts["stamp"] - now) * 1e-9, posts["sight"] @ frame.T
    moves = ages[:, None] * errors[:, None]
    # posts at even distances look alike at several velocities, and carriers are not fast
    speeds = ((velocity + errors) ** 2).sum(axis=1)
    prior = -0.5 * speeds / tuning.START_VELOCITY_SIGMA[1] ** 2
    logs, best = np.zeros(len(rates)), np.zeros((len(rates), 3))
    scale = tuning.START_SCALE * np.sqrt(len(posts))
    for number, rate in enumerate(rates.tolist()):
        turned = _yawed(sights, rate * ages) + (posts["place"] @ frame.T - sights)
        counts = np.array([_occupied(turned + move, cells) for move in moves])
        found = prior - counts / scale
        best[number], logs[number] = errors[np.argmax(found)], found.max()
    return logs, best


def _yawed(points: F64, angles: F64) -> F64:
    """Return points (N, 3) turned about the third axis by angles (N,) [rad]."""
    cosines, sines = np.cos(angles), np.sin(angles)
    x, y, z = points.T
    return np.column_stack((cosines * x - sines * y, sines * x + cosines * y, z))


def wall_spots(seen: Seen, axes: F64, gravity: F64) -> Spots | None:
    """Return the spots of bare walls along the only level axis, None where there are none.

    Beside them the rims of the view are what is sharpest, and the profile of the walls counts.

    Parameters
    ----------
    seen : ndarray, shape (N,), dtype SEEN
    axes : ndarray, shape (K, 3)
        Level, orthonormal. With two of them, no walls fix the place across.
    gravity : ndarray, shape (3,)
        [m/s^2]
    """
    if len(axes) != 1:
        return None
    frame = level_axes(axes[0], gravity)
    spots = _spots(seen, frame)
    return spots if are_walls(spots, frame) else None


def _spots(seen: Seen, axes: F64) -> Spots:
    """Return the spots of upright faces beside the sensor, of each sweep."""
    near = (seen["sight"] ** 2).sum(axis=1) < tuning.PROFILE_RANGE**2
    has_intensity = bool(seen["intensity"].any())
    parts = []
    for number in np.unique(seen["sweep"]):
        some = seen[near & (seen["sweep"] == number)]
        bright = some["intensity"] if has_intensity else None
        parts.append(extract_spots(some["place"], some["stamp"], bright, some["sight"], axes))
    return records.joined(parts)


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


def _occupied(places: F64, cells: tuple[float, ...]) -> int:
    """Return how many cells of some sizes [m] places (N, 3) occupy; along, across and up."""
    found = 0
    for size in cells:
        edges = size, max(size, tuning.START_ACROSS), tuning.START_ROW
        keys = np.sort(_keys(*np.floor(places / edges).astype(np.int64).T))
        found += int(np.count_nonzero(keys[1:] != keys[:-1])) + 1
    return found


def _keys(*parts: I64) -> I64:
    """Return one number for each combination of numbers (N,); neighbors differ in the last one."""
    keys = np.zeros(len(parts[0]), np.int64)
    for part in parts:
        lowest = int(part.min())
        # four more, so that two steps beyond the last do not meet the next combination
        keys = keys * (int(part.max()) - lowest + 5) + (part - lowest + 2)
    return keys
