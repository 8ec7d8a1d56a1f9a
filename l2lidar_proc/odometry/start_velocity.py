"""Velocity of a start in motion: the one with which some seconds of points make the sharpest map.

Two sweeps in a hall or a corridor fit together at many velocities, and a map that begins with a
wrong one confirms it. Over two seconds a wrong one smears every post. So points are placed as the
IMU carries the sensor through these seconds, which the error of the velocity shears along the
way. The shear with which they occupy the fewest cells is the most likely one: autofocus, as of a
synthetic aperture. Only upright things count: floors and ceilings look the same at any velocity.

Beside bare walls the fewest cells are those of a sensor at rest, since the rims of the view move
along with it. There the profile of the walls tells the velocity
(:mod:`~l2lidar_proc.odometry.wall_profile`).

In a hall, a wrong velocity moves what is far ahead to the side, as a turn does. So the first
sweeps may have learned a wrong yaw rate with it, of 4 degrees per second. That smears the map at
any velocity, so the yaw rate is searched first.
"""

from __future__ import annotations

import itertools
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records, rotations
from l2lidar_node.types import F64, I64, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import (
    ERRORS,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    VELOCITY,
    InertialState,
)
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.matcher import xyz
from l2lidar_proc.odometry.wall_profile import (
    Spots,
    are_walls,
    extract_spots,
    likelihood_of,
    log_likelihood,
    velocity_jacobian,
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


class Passed(NamedTuple):
    """A sweep of the last seconds.

    Attributes
    ----------
    sweep : Sweep
    stamp : HostNs
        Its reference.
    position : ndarray, shape (3,)
        Of the cloud frame then, as estimated [m], map frame.
    """

    sweep: Sweep
    stamp: HostNs
    position: F64


class FoundVelocity(NamedTuple):
    """State with the velocity that some seconds of points show.

    Attributes
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    is_news : bool
        Whether the state before was another one, or less certain.
    """

    state: InertialState
    covariance: F64
    is_news: bool


class StartVelocity:
    """The sweeps since a start in motion, which tell its velocity again and again.

    A first search has the whole start; the map then begins again if it was wrong. Later ones
    correct the state, as long as the map is young: what a wrong velocity has put there holds it.

    Parameters
    ----------
    lever : ndarray, shape (3,)
        Place of the IMU in the cloud frame [m].

    Attributes
    ----------
    since : HostNs
        What the sweeps reach back to.
    is_first : bool
        Whether nothing has been searched so far.
    is_open : bool
        Whether the velocity was open at the start, and has not become known since.
    """

    def __init__(self, lever: F64) -> None:
        self._lever = lever
        self.clear()

    def clear(self) -> None:
        """Forget all sweeps, and search no more."""
        self._passed: list[Passed] = []
        self._open_axes: F64 = np.zeros((0, 3))
        self._next = self._last = 0
        self.since = HostNs(0)
        self.is_first = False
        self.is_open = False

    @property
    def is_awaited(self) -> bool:
        """Whether the first search will tell a velocity that is open until then."""
        return self.is_first and self.is_open

    @property
    def sweeps(self) -> list[Sweep]:
        """The sweeps since :attr:`since`."""
        return [one.sweep for one in self._passed]

    @property
    def reference(self) -> HostNs:
        """Reference of the first of these sweeps."""
        return self._passed[0].stamp

    def begin(
        self, sweeps: list[Sweep], motions: list[SweepMotion], since: HostNs, open_axes: F64
    ) -> None:
        """Begin with the sweeps with which a map in motion has begun.

        Parameters
        ----------
        sweeps : list of Sweep
        motions : list of SweepMotion
        since : HostNs
            The first motion reaches back to it.
        open_axes : ndarray, shape (K, 3)
            Directions along which they leave the velocity open.
        """
        self.clear()
        self.since, self.is_first, self.is_open = since, True, len(open_axes) > 0
        self._open_axes = open_axes
        self._next, self._last = since + tuning.START_NS, since + tuning.START_WATCHED_NS
        self.replace(sweeps, motions)

    def replace(self, sweeps: list[Sweep], motions: list[SweepMotion]) -> None:
        """Take other motions for the sweeps so far."""
        self._passed = []
        for sweep, motion in zip(sweeps, motions, strict=True):
            self.note(sweep, motion)

    def note(self, sweep: Sweep, motion: SweepMotion) -> None:
        """Take a sweep with its motion; where none has been searched for long, begin no more."""
        if sweep.end - self.since > 2 * tuning.START_NS:
            self.clear()
            return
        state = motion.state
        position = state.position - state.rotation @ self._lever
        self._passed.append(Passed(sweep, state.stamp, position))

    def note_velocity(self, sigma: float) -> None:
        """Take how well the velocity is known by now, at worst [m/s]."""
        self.is_open &= sigma > tuning.PRIOR_LEARN_SIGMA

    def is_due(self, end: HostNs) -> bool:
        """Return whether it is time for a search, at the end of a sweep."""
        return len(self._passed) > 0 and end >= self._next

    def search(self, motion: SweepMotion, information: F64) -> FoundVelocity | None:
        """Return the state with the velocity that the sweeps show; None where they show none.

        Parameters
        ----------
        motion : SweepMotion
            Of the latest sweep, reaching back to :attr:`since`.
        information : ndarray, shape (3, 3)
            About the place, of its alignment.
        """
        strengths, directions = np.linalg.eigh(information)
        weak = directions[:, strengths < tuning.START_SHARE * strengths[-1]]
        if self.is_awaited:
            weak = np.column_stack((weak, self._open_axes.T))
        axes = level_span(weak, motion.state.gravity)
        if not len(axes):
            return None
        turned = self._with_yaw_rate(motion, axes) if self.is_first else None
        motion = turned or motion
        lasted = 1e-9 * (tuning.START_NS if self.is_first else tuning.START_PAUSE_NS)
        covariance = doubted(motion.covariance, axes, lasted, first=self.is_first)
        seen = placed(self._passed, motion, self._lever, axes)
        found = _measured(seen, motion.state, covariance, axes)
        if found is None:
            return FoundVelocity(motion.state, covariance, is_news=True) if turned else None
        state, posterior, sigmas = found
        change = float(np.linalg.norm(state.velocity - motion.state.velocity))
        before = axes @ motion.covariance[VELOCITY, VELOCITY] @ axes.T
        is_news = change > tuning.START_CHANGE and sigmas > tuning.START_SIGNIFICANT
        if not self.is_first:
            # the sweeps since have told much more
            is_news &= change < tuning.START_MOST_CHANGE
        is_news |= float(np.linalg.eigvalsh(before)[-1]) > tuning.START_OPEN**2
        return FoundVelocity(state, posterior, is_news or turned is not None)

    def _with_yaw_rate(self, motion: SweepMotion, axes: F64) -> SweepMotion | None:
        """Return the motion with the yaw rate that the sweeps show; None where it shows before."""
        state = motion.state
        found = yaw_rate_error(
            placed(self._passed, motion, self._lever, axes), int(state.stamp), axes, state.gravity
        )
        if found is None:
            return None
        error, sigma = found
        # the rate is faster by what the bias is smaller
        h = np.zeros(ERRORS)
        h[GYRO_BIAS] = state.rotation.T @ (state.gravity / np.linalg.norm(state.gravity))
        covariance = motion.covariance.copy()
        # what the registrations have told about it is the echo of a wrong velocity
        more = max(tuning.START_YAW_SIGMA**2 - float(h @ covariance @ h), 0.0)
        covariance += more * np.outer(h, h)
        prior = float(h @ covariance @ h)
        gain = covariance @ h / prior
        after = state.boxplus(gain * error)
        return motion.with_state(after, covariance - (prior - sigma**2) * np.outer(gain, gain))

    def end_search(self, end: HostNs) -> None:
        """Wait until the next search, with the sweeps that it will need."""
        self.is_first = False
        self._next = end + tuning.START_PAUSE_NS
        if end > self._last:
            self._passed = []
        oldest = self._next - tuning.START_NS
        self._passed = [one for one in self._passed if one.sweep.start >= oldest]
        if self._passed:
            self.since = self._passed[0].sweep.start


def level_span(directions: F64, gravity: F64) -> F64:
    """Return orthonormal level axes (K, 3) along directions (3, M), as far as these are level."""
    up = gravity / np.linalg.norm(gravity)
    flat = directions - np.outer(up, up @ directions)
    axes, lengths, _ = np.linalg.svd(flat, full_matrices=False)
    return np.asarray(axes[:, lengths > tuning.START_LEVEL].T)


def doubted(covariance: F64, axes: F64, seconds: float, *, first: bool) -> F64:
    """Return a covariance with velocity and acceleration along axes less known.

    What surfaces of a young map have told about them may be the echo of what was assumed.

    Parameters
    ----------
    covariance : ndarray, shape (18, 18)
    axes : ndarray, shape (K, 3)
        Orthonormal, map axes.
    seconds : float
        For how long an error of the acceleration has not been noticed.
    first : bool
        The velocity has been assumed since the start.
    """
    out = covariance.copy()
    for axis in axes:
        error = np.zeros(ERRORS)
        error[POSITION], error[VELOCITY] = 0.5 * seconds**2 * axis, seconds * axis
        error[GRAVITY] = axis
        out += tuning.START_ACCELERATION**2 * np.outer(error, error)
    strengths, turn = np.linalg.eigh(axes @ out[VELOCITY, VELOCITY] @ axes.T)
    along = turn.T @ axes
    least = tuning.START_PRIOR if first else tuning.START_LATER
    more = np.maximum(least**2 - strengths, 0.0)
    out[VELOCITY, VELOCITY] += (along.T * more) @ along
    return out


def placed(passed: list[Passed], motion: SweepMotion, lever: F64, axes: F64) -> Seen:
    """Return the points of some sweeps as the IMU carries the sensor to the latest one.

    Across the given axes the sweeps have measured the way better than the IMU.

    Parameters
    ----------
    passed : list of Passed
    motion : SweepMotion
        Of the latest one, reaching back to the first.
    lever : ndarray, shape (3,)
        Place of the IMU in the cloud frame [m].
    axes : ndarray, shape (K, 3)
        Orthonormal, map axes.
    """
    trajectory, state = motion.trajectory(lever), motion.state
    stamps = np.array([one.stamp for one in passed])
    off = np.array([one.position for one in passed])
    off -= state.position - state.rotation @ lever
    off -= trajectory.poses(stamps)[1] @ state.rotation.T
    off -= off @ axes.T @ axes
    parts = []
    for number, (sweep, *_) in enumerate(passed):
        points = records.decimated(sweep.points, tuning.WALL_POINTS)
        found = np.zeros(len(points), SEEN)
        found["stamp"] = sweep.start + np.round(points["time"] * 1e9).astype(np.int64)
        turns, places = trajectory.poses(found["stamp"])
        found["sight"] = rotations.rotate(turns, xyz(points)) @ state.rotation.T
        found["place"] = found["sight"] + places @ state.rotation.T
        for k in range(3):
            found["place"][:, k] += np.interp(found["stamp"], stamps, off[:, k])
        if "intensity" in (points.dtype.names or ()):
            found["intensity"] = points["intensity"]
        found["sweep"] = number
        parts.append(found)
    return records.joined(parts)


def _measured(
    seen: Seen, state: InertialState, covariance: F64, axes: F64
) -> tuple[InertialState, F64, float] | None:
    """Return the posterior of the velocity along axes, and by how many sigmas it was off.

    It is computed on a grid; mean and variance become those of the state (assumed density
    filtering). None if that tells little more than the prior.
    """
    strengths, turn = np.linalg.eigh(axes @ covariance[VELOCITY, VELOCITY] @ axes.T)
    axes, sigmas = turn.T @ axes, np.sqrt(strengths)
    errors = np.array([*itertools.product(*(_candidates(sigma) for sigma in sigmas.tolist()))])
    now = int(state.stamp)
    logs = log_likelihoods(seen, now, axes, errors, state.gravity)
    if logs is None:
        return None
    logs = logs - 0.5 * ((errors / sigmas) ** 2).sum(axis=1)
    weights = np.exp(logs - logs.max())
    mean = np.average(errors, axis=0, weights=weights)
    left = np.atleast_2d(np.cov(errors.T, aweights=weights, bias=True))
    left += tuning.START_NOISE**2 * np.eye(len(axes))
    age = 0.5e-9 * (now - int(seen["stamp"].min()))
    h = np.stack([velocity_jacobian(state, age, axis) for axis in axes])
    cross = covariance @ h.T
    prior = h @ cross
    if np.trace(left) > tuning.START_BETTER * np.trace(prior):
        return None
    gain = np.linalg.solve(prior, cross.T).T
    after = state.boxplus(np.asarray(gain @ mean, np.float64))
    posterior = covariance + gain @ (left - prior) @ gain.T
    return after, posterior, float(np.sqrt(mean @ np.linalg.solve(left, mean)))


def _candidates(sigma: float, step: float = tuning.START_STEP) -> list[float]:
    """Return the errors of the velocity to compare along one axis [m/s]."""
    reach = min(tuning.START_SIGMAS * sigma, tuning.START_REACH)
    return _steps(reach, step)


def _steps(reach: float, step: float) -> list[float]:
    """Return values from -reach to reach, no farther apart than a step, and 0 among them."""
    count = max(int(np.ceil(reach / step)), 2)
    return [float(value) for value in np.linspace(-reach, reach, 2 * count + 1)]


def yaw_rate_error(seen: Seen, now: int, axes: F64, gravity: F64) -> tuple[float, float] | None:
    """Return what has to be added to the yaw rate, and its sigma [rad/s]; None where nothing is.

    It is the one with which upright points occupy the fewest cells, at the velocity with which
    they then do so.

    Parameters
    ----------
    seen : ndarray, shape (N,), dtype SEEN
    now : int
        Instant at which the heading is right [ns].
    axes : ndarray, shape (K, 3)
        Level, orthonormal, along which the velocity may be wrong; K is 1 or 2.
    gravity : ndarray, shape (3,)
        [m/s^2]
    """
    frame = level_axes(axes[0], gravity)
    if len(axes) == 1 and are_walls(_spots(seen, frame), frame):
        return None  # they show the heading
    posts = upright(seen, gravity)
    if len(posts) < tuning.START_POSTS:
        return None
    moves = axes @ frame.T
    steps = _candidates(tuning.START_PRIOR, tuning.START_YAW_VELOCITY_STEP)
    errors = np.array([*itertools.product(steps, repeat=len(axes))]) @ moves
    rates = np.array(_steps(tuning.START_YAW_REACH, tuning.START_YAW_STEP))
    some = records.decimated(posts, tuning.START_YAW_MOST)
    logs, best = _sharpest(some, now, frame, rates, errors, tuning.START_CELLS[:2])
    chosen, unchanged = int(np.argmax(logs)), len(rates) // 2
    if logs[chosen] - logs[unchanged] < tuning.START_YAW_BETTER:
        return None
    near = _steps(tuning.START_YAW_VELOCITY_STEP, tuning.START_STEP)
    errors = best[chosen] + np.array([*itertools.product(near, repeat=len(axes))]) @ moves
    finer = _steps(tuning.START_YAW_STEP, tuning.START_YAW_FINER)
    rates = rates[chosen] + np.array(finer)
    logs, _ = _sharpest(posts, now, frame, rates, errors, tuning.START_CELLS)
    weights = np.exp(logs - logs.max())
    mean = float(np.average(rates, weights=weights))
    variance = float(np.average((rates - mean) ** 2, weights=weights))
    return mean, float(np.sqrt(variance + tuning.START_YAW_NOISE**2))


def _sharpest(
    posts: Seen, now: int, frame: F64, rates: F64, errors: F64, cells: tuple[float, ...]
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
    cells : tuple of float
        Their sizes [m].
    """
    ages, sights = (posts["stamp"] - now) * 1e-9, posts["sight"] @ frame.T
    moves = ages[:, None] * errors[:, None]
    counts, best = np.zeros(len(rates)), np.zeros((len(rates), 3))
    for number, rate in enumerate(rates.tolist()):
        turned = _yawed(sights, rate * ages) + (posts["place"] @ frame.T - sights)
        found = [_occupied(turned + move, cells) for move in moves]
        best[number], counts[number] = errors[np.argmin(found)], min(found)
    return (counts.min() - counts) / (tuning.START_SCALE * np.sqrt(len(posts))), best


def _yawed(points: F64, angles: F64) -> F64:
    """Return points (N, 3) turned about the third axis by angles (N,) [rad]."""
    cosines, sines = np.cos(angles), np.sin(angles)
    x, y, z = points.T
    return np.column_stack((cosines * x - sines * y, sines * x + cosines * y, z))


def log_likelihoods(seen: Seen, now: int, axes: F64, errors: F64, gravity: F64) -> F64 | None:
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
    along = level_axes(axes[0], gravity)
    if len(axes) == 1:  # walls fix the place across them
        spots = _spots(seen, along)
        if are_walls(spots, along):
            logs = log_likelihood(spots, now, along, errors[:, 0])
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
