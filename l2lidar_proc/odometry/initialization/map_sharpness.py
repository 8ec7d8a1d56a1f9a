"""Sharpness of a map: the errors of the motion with which some seconds of points fit together.

Points of several sweeps are placed as a motion says. An error of its velocity shears them along
the way, one of its yaw rate winds them up, and either smears every post. The errors with which
they occupy the fewest cells are the most likely ones: autofocus, as of a synthetic aperture. Only
upright things count (:mod:`~l2lidar_proc.odometry.initialization.posts_and_walls`): floors and
ceilings look the same at any velocity.

Beside bare walls the fewest cells are those of a sensor at rest, since the rims of the view move
along with it. There the profile of the walls tells the velocity, and the acceleration
(:mod:`~l2lidar_proc.odometry.walls.wall_profile`).
"""

from __future__ import annotations

import itertools
from typing import Final

import numpy as np

from l2lidar_node import records
from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.initialization.posts_and_walls import Seen, Upright, posts_and_walls
from l2lidar_proc.odometry.walls.wall_profile import (
    Spots,
    are_walls,
    error_grid,
    extract_spots,
    log_likelihood,
)
from l2lidar_proc.odometry.walls.wall_velocity import level_axes

_LEAST_STEPS: Final = 2  # of a grid of errors, to either side


def candidates(sigma: float, step: float) -> F64:
    """Return the errors (M,) of the velocity to compare along one axis [m/s].

    Parameters
    ----------
    sigma : float
        Of the velocity along it [m/s].
    step : float
        They are no farther apart [m/s].
    """
    reach = min(tuning.START_SIGMAS * sigma, tuning.START_REACH)
    return error_grid(reach, step, _LEAST_STEPS)


def velocity_log_likelihoods(
    seen: Seen, now: int, axes: F64, errors: F64, gravity: F64
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
    """
    things = posts_and_walls(seen, level_axes(axes[0], gravity))
    if sum(len(one.points) for one in things) < tuning.START_POSTS:
        return None
    counts = _cells(things, now, errors @ axes, tuning.START_CELLS)
    return np.asarray(counts.min() - counts)


def motion_along_walls(
    walls: Spots, now: int, axes: F64, age: float, prior: F64
) -> tuple[F64, F64] | None:
    """Return what to add to the velocity along walls and to the acceleration, and its covariance.

    A carrier that speeds up as it starts looks like one that leans, so gravity is wrong by its
    acceleration. Both errors are searched together: on a coarse grid, and on a finer one about the
    likeliest errors of that.

    Parameters
    ----------
    walls : ndarray, dtype SPOT
        As :func:`wall_spots` returns them.
    now : int
        Instant of the state that has placed them [ns].
    axes : ndarray, shape (3, 3)
        As :func:`~l2lidar_proc.odometry.walls.wall_velocity.level_axes` returns them.
    age : float
        How long before that instant the velocity is asked for [s].
    prior : ndarray, shape (2, 2)
        Covariance of that velocity [m/s] and the acceleration since [m/s^2].

    Returns
    -------
    tuple of (ndarray, shape (2,), ndarray, shape (2, 2)), or None
        None where the walls have no edges that tell.
    """
    weight = np.linalg.inv(prior)

    def searched(errors: F64) -> tuple[F64, F64]:
        """Return logarithms (M,) for errors (M, 2): of what walls say, and with the prior."""
        speeds, accelerations = errors.T
        logs = log_likelihood(walls, now, axes, speeds + age * accelerations, accelerations)
        unlikely = 0.5 * np.einsum("ni,ij,nj->n", errors, weight, errors)
        return logs, logs / tuning.PROFILE_DEPENDENT - unlikely

    sigmas = np.sqrt(np.diag(prior)).tolist()
    lines = [candidates(*one) for one in zip(sigmas, tuning.START_WALL_STEPS, strict=True)]
    coarse = np.array([*itertools.product(*lines)])
    logs, likely = searched(coarse)
    if np.ptp(logs) < tuning.START_PROFILE:
        return None
    best = np.argsort(-likely)[: tuning.START_WALL_REFINED]
    best = best[likely[best] > likely.max() - tuning.START_WALL_LIKELY]
    parts = [
        ((np.arange(count) + 0.5) / count - 0.5) * (line[1] - line[0])
        for line, count in zip(lines, tuning.START_WALL_FINER, strict=True)
    ]
    fine = (coarse[best, None] + np.array([*itertools.product(*parts)])).reshape(-1, 2)
    return moments(fine, searched(fine)[1])


def moments(errors: F64, logs: F64) -> tuple[F64, F64]:
    """Return mean (K,) and covariance (K, K) of errors (M, K), so likely by logarithms (M,)."""
    weights = np.exp(logs - logs.max())
    mean = np.average(errors, axis=0, weights=weights)
    return mean, np.atleast_2d(np.cov(errors.T, aweights=weights, bias=True))


def yaw_rate_error(
    seen: Seen, now: int, axes: F64, gravity: F64, velocity: F64
) -> tuple[float, float] | None:
    """Return what has to be added to the yaw rate, and its sigma [rad/s]; None where nothing is.

    It is the one with which upright points occupy the fewest cells, at the velocity with which
    they then do so. A slow one is likelier, and one near the present rate: another one has to be
    far better.

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
    things = posts_and_walls(seen, level_axes(axes[0], gravity))
    count = sum(len(one.points) for one in things)
    if count < tuning.START_POSTS:
        return None
    along = velocity @ axes.T @ axes
    steps = candidates(tuning.START_PRIOR, tuning.START_YAW_VELOCITY_STEP)
    errors = np.array([*itertools.product(steps, repeat=len(axes))]) @ axes
    rates = error_grid(tuning.START_YAW_REACH, tuning.START_YAW_STEP, _LEAST_STEPS)
    some = [one.decimated(tuning.START_YAW_MOST / count) for one in things]
    logs, best = _sharpest(some, now, rates, errors, along, tuning.START_CELLS[:2])
    logs -= 0.5 * (rates / tuning.START_YAW_SIGMA) ** 2
    unchanged = len(rates) // 2
    others = np.delete(np.arange(len(rates)), unchanged)
    other = others[np.argmax(logs[others])]
    better = logs[other] - logs[unchanged]
    steps = error_grid(tuning.START_YAW_VELOCITY_STEP, tuning.START_STEP, _LEAST_STEPS)
    near = np.array([*itertools.product(steps, repeat=len(axes))]) @ axes
    finer = error_grid(tuning.START_YAW_STEP, tuning.START_YAW_FINER, _LEAST_STEPS)

    def refined(index: int) -> tuple[F64, F64]:
        some = rates[index] + finer
        about = best[index] + near
        return some, _sharpest(things, now, some, about, along, tuning.START_CELLS)[0]

    fine, logs = refined(unchanged)
    if better > -tuning.START_YAW_BETTER:  # the coarse cells do not tell the two apart
        fine_there, logs_there = refined(other)
        if max(better, logs_there.max() - logs.max()) > tuning.START_YAW_BETTER:
            fine, logs = fine_there, logs_there
    weights = np.exp(logs - logs.max())
    mean = float(np.average(fine, weights=weights))
    variance = float(np.average((fine - mean) ** 2, weights=weights))
    sigma = float(np.sqrt(variance + tuning.START_YAW_NOISE**2))
    return None if abs(mean) < tuning.START_YAW_SIGNIFICANT * sigma else (mean, sigma)


def _sharpest(
    things: list[Upright],
    now: int,
    rates: F64,
    errors: F64,
    velocity: F64,
    cells: tuple[float, ...],
) -> tuple[F64, F64]:
    """Return how likely errors of the yaw rate are (M,), as logarithms, each with its velocity.

    Parameters
    ----------
    things : list of Upright
    now : int
    rates : ndarray, shape (M,)
        [rad/s]
    errors : ndarray, shape (L, 3)
        Of the velocity, map axes [m/s]: one of them comes with each rate.
    velocity : ndarray, shape (3,)
        To which they are added, as far as it may be wrong.
    cells : tuple of float
        Their sizes [m].
    """
    # posts at even distances look alike at several velocities, and carriers are not fast
    speeds = ((velocity + errors) ** 2).sum(axis=1)
    prior = -0.5 * speeds / tuning.CARRIER_SPEED_SIGMA**2
    logs, best = np.zeros(len(rates)), np.zeros((len(rates), 3))
    for number, rate in enumerate(rates.tolist()):
        found = prior - _cells(things, now, errors, cells, rate)
        best[number], logs[number] = errors[np.argmax(found)], found.max()
    return logs, best


def _cells(
    things: list[Upright], now: int, errors: F64, cells: tuple[float, ...], yaw_rate: float = 0.0
) -> F64:
    """Return how many cells are occupied at errors of the velocity (M, 3), as a logarithm.

    Its parameters are those of :meth:`Upright.occupied`.
    """
    counts = np.sum([one.occupied(now, errors, cells, yaw_rate) for one in things], axis=0)
    posts = sum(len(one.points) for one in things if not one.is_wall)
    return np.asarray(counts / (tuning.START_SCALE * np.sqrt(max(posts, tuning.START_FEW_POSTS))))


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
