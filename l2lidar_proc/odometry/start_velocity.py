"""Velocity of a start in motion, found from the first seconds after it.

Two sweeps in a hall or a corridor fit together at many velocities, and a map that begins with a
wrong one confirms it. Over two seconds a wrong one smears every post. So the sweeps since the
start are placed as the IMU carries the sensor through them, and the velocity with which they make
the sharpest map is searched (:mod:`~l2lidar_proc.odometry.map_sharpness`).

In a hall, a wrong velocity moves what is far ahead to the side, as a turn does. So the first
sweeps may have learned a wrong yaw rate with it, of 4 degrees per second. That smears the map at
any velocity, so the yaw rate is searched first.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np

from l2lidar_node import records, rotations
from l2lidar_node.types import F64, HostNs, Sweep
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
from l2lidar_proc.odometry.map_sharpness import (
    candidates,
    velocity_log_likelihoods,
    wall_spots,
    yaw_rate_error,
)
from l2lidar_proc.odometry.matcher import xyz
from l2lidar_proc.odometry.pose_hypotheses import level_basis
from l2lidar_proc.odometry.posts_and_walls import SEEN, Seen
from l2lidar_proc.odometry.vertical_direction import Vertical
from l2lidar_proc.odometry.wall_profile import velocity_jacobian


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
    is_open : bool
        Whether the sweeps leave some of the velocity open; else only gravity may have changed.
    """

    state: InertialState
    covariance: F64
    is_news: bool
    is_open: bool = True


class FittedStart(NamedTuple):
    """Beginning of a start as the poses since then show it.

    Attributes
    ----------
    state : InertialState
        At the reference of the first sweep; its pose is that of the estimate.
    velocity_sigma : float
        [m/s]
    is_other : bool
        Whether the map began with another velocity, as far as either is known.
    shift : ndarray, shape (3,)
        From where the first sweep was to where it was estimated [m], map axes.
    """

    state: InertialState
    velocity_sigma: float
    is_other: bool
    shift: F64


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
        self._begun_with: SweepMotion | None = None  # motion of the first sweep, as far as known
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
        self.since, self.is_first = since, True
        self.is_open = len(open_axes) > 0
        # the first motion has the prior's covariance
        self._begun_with = motions[0].with_state(motions[0].state, motions[1].covariance)
        self._open_axes = open_axes
        self._next, self._last = since + tuning.START_NS, since + tuning.START_WATCHED_NS
        self.replace(sweeps, motions)

    def replace(self, sweeps: list[Sweep], motions: list[SweepMotion]) -> None:
        """Take other motions for the sweeps so far."""
        self._passed = []
        for sweep, motion in zip(sweeps, motions, strict=True):
            self.note(sweep, motion)

    def note(self, sweep: Sweep, motion: SweepMotion) -> None:
        """Take a sweep with its motion; clear all if no search ran for twice START_NS."""
        if sweep.end - self.since > 2 * tuning.START_NS:
            self.clear()
            return
        state = motion.state
        position = state.position - state.rotation @ self._lever
        self._passed.append(Passed(sweep, state.stamp, position))

    def note_velocity(self, covariance: F64) -> None:
        """Take how well the velocity is known by now, covariance (3, 3) [m^2/s^2]."""
        worst = float(np.linalg.eigvalsh(covariance)[-1])
        self.is_open &= worst > tuning.PRIOR_LEARN_SIGMA**2

    def is_due(self, end: HostNs) -> bool:
        """Return whether it is time for a search, at the end of a sweep."""
        return len(self._passed) > 0 and end >= self._next

    def search(
        self, motion: SweepMotion, information: F64, vertical: Vertical | None
    ) -> FoundVelocity | None:
        """Return the state with the velocity that the sweeps show; None where they show none.

        Parameters
        ----------
        motion : SweepMotion
            Of the latest sweep, reaching back to :attr:`since`.
        information : ndarray, shape (3, 3)
            About the place, of its alignment.
        vertical : Vertical or None
            That the map shows, map axes.
        """
        before = motion
        lasted = 1e-9 * (tuning.START_NS if self.is_first else tuning.START_PAUSE_NS)
        strengths, directions = np.linalg.eigh(information)
        weak = directions[:, strengths < tuning.START_SHARE * strengths[-1]]
        if self.is_awaited:
            weak = np.column_stack((weak, self._open_axes.T))
        if vertical is not None and vertical.is_certain:
            free = level_span(weak, motion.state.gravity)
            motion = with_level_gravity(motion, vertical.direction, lasted, free)
        axes = level_span(weak, motion.state.gravity)
        if not len(axes):
            if motion is before:
                return None
            return FoundVelocity(motion.state, motion.covariance, is_news=True, is_open=False)
        seen = placed(self._passed, motion, self._lever, axes)
        turned = with_yaw_rate(motion, seen, axes) if self.is_first else motion
        if turned is not motion:
            motion, seen = turned, placed(self._passed, turned, self._lever, axes)
        is_news = motion is not before
        covariance = doubted(motion.covariance, axes, lasted, first=self.is_first)
        found = _measured(seen, motion.state, covariance, axes, first=self.is_first)
        if found is None:
            return FoundVelocity(motion.state, covariance, True) if is_news else None
        state, posterior, sigmas = found
        change = float(np.linalg.norm(state.velocity - motion.state.velocity))
        prior = axes @ motion.covariance[VELOCITY, VELOCITY] @ axes.T
        is_other = change > tuning.START_CHANGE and sigmas > tuning.START_SIGNIFICANT
        if not self.is_first:
            # the sweeps since have told much more
            is_other &= change < tuning.START_MOST_CHANGE
        was_open = float(np.linalg.eigvalsh(prior)[-1]) > tuning.START_OPEN**2
        return FoundVelocity(state, posterior, is_news or is_other or was_open)

    def beginning(self, motion: SweepMotion) -> tuple[InertialState, F64]:
        """Return the state (and its covariance, (18, 18)) at :attr:`reference`.

        What gravity and the accelerometer's bias may be wrong by has accelerated it since; how its
        attitude and place were known then, is not asked for.

        Parameters
        ----------
        motion : SweepMotion
            Of the latest sweep, reaching back to :attr:`since`.
        """
        age = 1e-9 * (motion.state.stamp - self.reference)
        back = np.eye(ERRORS)
        back[VELOCITY] = [velocity_jacobian(motion.state, age, axis) for axis in np.eye(3)]
        return motion.state_at(self.reference), back @ motion.covariance @ back.T

    def fitted(self, motion: SweepMotion) -> FittedStart | None:
        """Return how the start began, as the poses after the first ones show it; None if too few.

        The velocity with which the first sweeps fit together may be wrong although nothing leaves
        it open: half turns that see a wall twice fit at two velocities. The sweeps after them then
        show the right one, but the map holds the first ones where they were put. So the way of the
        IMU is fitted to the later poses, with an error of the velocity and of the acceleration.

        Parameters
        ----------
        motion : SweepMotion
            Of the latest sweep, reaching back to :attr:`since`.
        """
        assert self._begun_with is not None
        stamps = np.array([one.stamp for one in self._passed])
        later = stamps >= stamps[0] + tuning.START_FITTED_NS
        if np.count_nonzero(later) < tuning.START_FITTED_LEAST:
            return None
        off = _deviations(self._passed, motion, self._lever)
        ages = (stamps - motion.state.stamp) * 1e-9
        design = np.column_stack((np.ones_like(ages), ages, 0.5 * ages**2))
        fit, *_ = np.linalg.lstsq(design[later], off[later], rcond=None)
        left = off[later] - design[later] @ fit
        variance = (left**2).sum() / (3 * (len(left) - 3))
        slope = np.array([0.0, 1.0, ages[0]])
        spread = slope @ np.linalg.solve(design[later].T @ design[later], slope)
        state = motion.state_at(self.reference)
        state = dataclasses.replace(state, velocity=state.velocity + slope @ fit)
        sigma = max(float(np.sqrt(variance * spread)), tuning.START_FITTED_SIGMA)
        change = state.velocity - self._begun_with.state.velocity
        unknown = self._begun_with.covariance[VELOCITY, VELOCITY] + sigma**2 * np.eye(3)
        is_other = (
            float(np.linalg.norm(change)) > tuning.START_FITTED_CHANGE
            and change @ np.linalg.solve(unknown, change) > tuning.START_SIGNIFICANT**2
        )
        return FittedStart(state, sigma, bool(is_other), off[0] - design[0] @ fit)

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


def with_level_gravity(
    motion: SweepMotion, vertical: F64, seconds: float, free: F64
) -> SweepMotion:
    """Return a motion with gravity along the vertical of the place, the same if it is there.

    It leaves it where a young map confirms a velocity that grows: the acceleration passes for a
    tilt. The place is then more certain than what has been learned about gravity. And it was
    never there where the carrier accelerated at the start. Where the sweeps fix the place, they
    have corrected the velocity all the time, whatever gravity was.

    Parameters
    ----------
    motion : SweepMotion
    vertical : ndarray, shape (3,)
        Unit vector, map axes.
    seconds : float
        For how long gravity may have accelerated the state,
    free : ndarray, shape (K, 3)
        and along which level axes, orthonormal, map axes.
    """
    state, covariance = motion.state, motion.covariance
    axes = level_basis(vertical).T
    tilt = axes @ state.gravity
    noise = tuning.START_LEVEL_SIGMA**2 * np.eye(2)
    known = axes @ covariance[GRAVITY, GRAVITY] @ axes.T
    is_known = float(np.linalg.eigvalsh(known)[-1]) < tuning.START_LEVEL_KNOWN**2
    if is_known and tilt @ np.linalg.solve(known + noise, tilt) < tuning.START_LEVEL_SIGMAS**2:
        return motion
    lean = tilt @ axes
    error = _accelerated(free.T @ (free @ lean), seconds)
    error[GRAVITY] = lean
    covariance = covariance + np.outer(error, error)
    h = np.zeros((2, ERRORS))
    h[:, GRAVITY] = axes
    cross = covariance @ h.T
    innovation = h @ cross + noise
    gain = np.linalg.solve(innovation, cross.T).T
    after = state.boxplus(np.asarray(-gain @ tilt, np.float64))
    return motion.with_state(after, covariance - gain @ innovation @ gain.T)


def with_yaw_rate(motion: SweepMotion, seen: Seen, axes: F64) -> SweepMotion:
    """Return a motion with the yaw rate that points show, the same if it has it.

    Parameters
    ----------
    motion : SweepMotion
    seen : ndarray, shape (N,), dtype SEEN
        Placed by it.
    axes : ndarray, shape (K, 3)
        Level, orthonormal, along which the velocity may be wrong; K is 1 or 2.
    """
    state = motion.state
    found = yaw_rate_error(seen, int(state.stamp), axes, state.gravity, state.velocity)
    if found is None:
        return motion
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


def _accelerated(acceleration: F64, seconds: float) -> F64:
    """Return the error of the state (18,) after an error of gravity (3,) [m/s^2]."""
    error = np.zeros(ERRORS)
    error[POSITION], error[VELOCITY] = 0.5 * seconds**2 * acceleration, seconds * acceleration
    error[GRAVITY] = acceleration
    return error


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
        error = _accelerated(tuning.START_ACCELERATION * axis, seconds)
        out += np.outer(error, error)
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
    off = _deviations(passed, motion, lever)
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


def _deviations(passed: list[Passed], motion: SweepMotion, lever: F64) -> F64:
    """Return by how much estimated places deviate from the way of the IMU, (N, 3) [m]."""
    state = motion.state
    stamps = np.array([one.stamp for one in passed])
    places = np.array([one.position for one in passed])
    carried = motion.trajectory(lever).poses(stamps)[1] @ state.rotation.T
    return places - (state.position - state.rotation @ lever) - carried


def _measured(
    seen: Seen, state: InertialState, covariance: F64, axes: F64, *, first: bool
) -> tuple[InertialState, F64, float] | None:
    """Return the posterior of the velocity along axes, and by how many sigmas it was off.

    It is computed on a grid; mean and variance become those of the state (assumed density
    filtering). None if that tells little more than the prior.
    """
    strengths, turn = np.linalg.eigh(axes @ covariance[VELOCITY, VELOCITY] @ axes.T)
    axes, sigmas = turn.T @ axes, np.sqrt(strengths)
    walls = wall_spots(seen, axes, state.gravity)
    step = tuning.START_STEP if walls is None else tuning.PROFILE_STEP
    steps = (candidates(sigma, step) for sigma in sigmas.tolist())
    errors = np.array([*itertools.product(*steps)])
    now = int(state.stamp)
    logs = velocity_log_likelihoods(seen, now, axes, errors, state.gravity, walls)
    if logs is None:
        return None
    logs = logs - 0.5 * ((errors / sigmas) ** 2).sum(axis=1)
    if first and walls is None:
        # posts at even distances look alike at several velocities, and carriers are not fast
        speeds = axes @ state.velocity + errors
        logs = logs - 0.5 * ((speeds / tuning.START_VELOCITY_SIGMA[1]) ** 2).sum(axis=1)
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
