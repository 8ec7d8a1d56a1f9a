"""Velocity of a start in motion, found from the first seconds after it.

Two sweeps in a hall or a corridor fit together at many velocities, and a map that begins with a
wrong one confirms it. Over two seconds a wrong one smears every post. So the sweeps since the
start are placed as the IMU carries the sensor through them, and the velocity with which they make
the sharpest map is searched (:mod:`~l2lidar_proc.odometry.initialization.map_sharpness`).

Between walls, the acceleration since is searched with it, as it passes for a tilt until then.

In a hall, a wrong velocity moves what is far ahead to the side, as a turn does. So the first
sweeps may have learned a wrong yaw rate with it, of 4 degrees per second. That smears the map at
any velocity, so the yaw rate is searched first.
"""

from __future__ import annotations

import dataclasses
import itertools
from enum import Enum
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
from l2lidar_proc.odometry.initialization.map_sharpness import (
    candidates,
    moments,
    motion_along_walls,
    velocity_log_likelihoods,
    wall_spots,
    yaw_rate_error,
)
from l2lidar_proc.odometry.initialization.posts_and_walls import SEEN, Seen
from l2lidar_proc.odometry.initialization.vertical_direction import Vertical
from l2lidar_proc.odometry.intrinsics.lidar_intrinsics import LidarIntrinsics
from l2lidar_proc.odometry.matcher import xyz
from l2lidar_proc.odometry.registration.pose_hypotheses import level_basis
from l2lidar_proc.odometry.walls.wall_profile import (
    Spots,
    acceleration_jacobian,
    velocity_jacobian,
)
from l2lidar_proc.odometry.walls.wall_velocity import level_axes


class Passed(NamedTuple):
    """A sweep of the last seconds.

    Attributes
    ----------
    sweep : Sweep
        As the unit reports it.
    stamp : HostNs
        Its reference.
    position : ndarray, shape (3,)
        Of the cloud frame then, as estimated [m], map frame.
    """

    sweep: Sweep
    stamp: HostNs
    position: F64


class SearchPhase(Enum):
    """How far the search for the velocity of a start has come."""

    NO_START = "no start"  # nothing is searched
    FIRST = "first"  # the first search is yet to be made
    REPEATED = "repeated"  # none has found the velocity so far: the next is made as the first
    FOLLOWING = "following"  # one has, or it is known by other means: the next correct the state


class ShownBy(Enum):
    """What has shown the velocity in a search."""

    NOTHING = "nothing"
    POSTS = "posts"
    WALLS = "walls"  # bare ones, between which the acceleration is found as well


class FoundVelocity(NamedTuple):
    """Another state than before, or a more certain one, that some seconds of points show.

    Attributes
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    is_open : bool
        Whether the sweeps leave some of the velocity open; else only gravity may have changed.
    """

    state: InertialState
    covariance: F64
    is_open: bool = True


class Beginning(NamedTuple):
    """State at the first of the sweeps with which a map is to begin again.

    Attributes
    ----------
    state : InertialState
        At its reference.
    covariance : ndarray, shape (18, 18)
        Not that of its pose.
    first : InertialState
        At the first pose of all: that of the same sweep, or an earlier one.
    way_covariance : ndarray, shape (6, 6)
        Of the motion between the two, place and turn about the map's axes [m, rad].
    """

    state: InertialState
    covariance: F64
    first: InertialState
    way_covariance: F64


class FittedStart(NamedTuple):
    """Beginning of a start as the poses since then show it.

    Attributes
    ----------
    state : InertialState
        At the reference of the first sweep; its pose is that of the estimate.
    velocity_sigma : float
        [m/s]
    begins_again : bool
        Whether the map is to begin again: it began with another velocity, as far as either is
        known, or the unit is known better by now.
    shift : ndarray, shape (3,)
        From where the first sweep was to where it was estimated [m], map axes.
    """

    state: InertialState
    velocity_sigma: float
    begins_again: bool
    shift: F64


class StartVelocity:
    """The sweeps since a start in motion, which tell its velocity again and again.

    With the first search that finds it, the map begins again. Later ones correct the state, as
    long as the map is young: what a wrong velocity has put there holds it.

    Parameters
    ----------
    lever : ndarray, shape (3,)
        Place of the IMU in the cloud frame [m].
    intrinsics : LidarIntrinsics

    Attributes
    ----------
    phase : SearchPhase
    since : HostNs
        What the sweeps reach back to.
    is_open : bool
        Whether the velocity was open at the start, and has not become known since.
    """

    def __init__(self, lever: F64, intrinsics: LidarIntrinsics) -> None:
        self._lever = lever
        self._intrinsics = intrinsics
        self.clear()

    def clear(self) -> None:
        """Forget all sweeps, and search no more."""
        self._passed: list[Passed] = []
        self._open_axes: F64 = np.zeros((0, 3))
        self._begun_with: SweepMotion | None = None  # motion of the first sweep, as far as known
        self._next = self._last = 0
        self._begun = HostNs(0)  # reference of the first sweep of all
        self._mapped_with = self._intrinsics.corrections  # the first sweeps
        self._shown_by = ShownBy.NOTHING  # in the latest search
        self.phase = SearchPhase.NO_START
        self.since = HostNs(0)
        self.is_open = False

    @property
    def is_awaited(self) -> bool:
        """Whether the first search is yet to tell a velocity that is open until then."""
        return self.phase is SearchPhase.FIRST and self.is_open

    @property
    def may_begin_again(self) -> bool:
        """Whether the map may begin again with what the next search finds."""
        return self.phase in (SearchPhase.FIRST, SearchPhase.REPEATED)

    def __len__(self) -> int:
        """Return the number of sweeps since :attr:`since`."""
        return len(self._passed)

    def sweeps(self) -> list[Sweep]:
        """Return these sweeps, as the unit would have measured them with what is known now."""
        return [one.sweep for one in self._corrected()]

    def _corrected(self) -> list[Passed]:
        applied = self._intrinsics.applied_to
        return [one._replace(sweep=applied(one.sweep)) for one in self._passed]

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
            As the unit reports them.
        motions : list of SweepMotion
        since : HostNs
            The first motion reaches back to it.
        open_axes : ndarray, shape (K, 3)
            Directions along which they leave the velocity open.
        """
        self.clear()
        self.since, self.phase = since, SearchPhase.FIRST
        self._begun = motions[0].state.stamp
        self.is_open = len(open_axes) > 0
        # the first motion has the prior's covariance
        self._begun_with = motions[0].with_state(motions[0].state, motions[1].covariance)
        self._open_axes = open_axes
        self._next, self._last = since + tuning.START_NS, since + tuning.START_WATCHED_NS
        for sweep, motion in zip(sweeps, motions, strict=True):
            self.note(sweep, motion)

    def replace(self, motions: list[SweepMotion]) -> None:
        """Take other motions for the sweeps so far."""
        passed, self._passed = self._passed, []
        for one, motion in zip(passed, motions, strict=True):
            self.note(one.sweep, motion)

    def note(self, sweep: Sweep, motion: SweepMotion) -> None:
        """Take a sweep with its motion; clear all if a search is overdue by START_NS."""
        if sweep.end - self._next > tuning.START_NS:
            self.clear()
            return
        state = motion.state
        self._passed.append(Passed(sweep, state.stamp, state.cloud_origin(self._lever)))

    def note_velocity(self, covariance: F64) -> None:
        """Take how well the velocity is known by now, covariance (3, 3) [m^2/s^2]."""
        worst = float(np.linalg.eigvalsh(covariance)[-1])
        self.is_open &= worst > tuning.PRIOR_LEARN_SIGMA**2
        if self.phase is SearchPhase.REPEATED and not self.is_open:
            self.phase = SearchPhase.FOLLOWING

    def is_due(self, end: HostNs) -> bool:
        """Return whether it is time for a search, at the end of a sweep."""
        return len(self._passed) > 0 and end >= self._next

    def search(
        self, motion: SweepMotion, information: F64, vertical: Vertical | None
    ) -> FoundVelocity | None:
        """Return the state with the velocity that the sweeps show; None where it is not news.

        Parameters
        ----------
        motion : SweepMotion
            Of the latest sweep, reaching back to :attr:`since`.
        information : ndarray, shape (3, 3)
            About the place, of its alignment.
        vertical : Vertical or None
            That the map shows, map axes.
        """
        before, first = motion, self.may_begin_again
        self._shown_by = ShownBy.NOTHING
        lasted = 1e-9 * (tuning.START_NS if first else tuning.START_PAUSE_NS)
        strengths, directions = np.linalg.eigh(information)
        weak = directions[:, strengths < tuning.START_SHARE * strengths[-1]]
        if first and self.is_open:
            others = self._open_axes.T - weak @ (weak.T @ self._open_axes.T)
            weak = np.column_stack((weak, others))
        if vertical is not None and vertical.is_certain:
            free = level_span(weak, motion.state.gravity)
            motion = with_level_gravity(motion, vertical.direction, lasted, free)
        axes = level_span(weak, motion.state.gravity)
        if not len(axes):
            if motion is before:
                return None
            return FoundVelocity(motion.state, motion.covariance, is_open=False)
        passed = self._corrected()
        seen = placed(passed, motion, self._lever, axes)
        turned = with_yaw_rate(motion, seen, axes) if first else motion
        if turned is not motion:
            motion, seen = turned, placed(passed, turned, self._lever, axes)
        is_news = motion is not before
        covariance = doubted(motion.covariance, axes, lasted, first=first)
        walls = wall_spots(seen, axes, motion.state.gravity)
        found = _measured(seen, walls, motion.state, covariance, axes, first=first)
        if found is None:
            return FoundVelocity(motion.state, covariance) if is_news else None
        self._shown_by = ShownBy.POSTS if walls is None else ShownBy.WALLS
        state, posterior, sigmas = found
        change = float(np.linalg.norm(state.velocity - motion.state.velocity))
        prior = axes @ motion.covariance[VELOCITY, VELOCITY] @ axes.T
        is_other = change > tuning.START_CHANGE and sigmas > tuning.START_SIGNIFICANT
        if not first:
            # the sweeps since have told much more
            is_other &= change < tuning.START_MOST_CHANGE
        was_open = float(np.linalg.eigvalsh(prior)[-1]) > tuning.START_OPEN**2
        is_news = is_news or is_other or was_open
        return FoundVelocity(state, posterior) if is_news else None

    def beginning(self, motion: SweepMotion) -> Beginning:
        """Return how the sweeps here began.

        What gravity and the accelerometer's bias may be wrong by has accelerated it since; how its
        attitude and place were known then, is not asked for.

        Parameters
        ----------
        motion : SweepMotion
            Of the latest sweep, reaching back to :attr:`since`.
        """
        first, state = motion.state_at(self._begun), motion.state_at(self.reference)
        covariance = motion.covariance
        if self._shown_by is ShownBy.WALLS:
            covariance = _with_open_turns(motion.state, covariance)
        else:  # the sweeps have fixed the attitude, then and now
            assert self._begun_with is not None
            turn = self._begun_with.state.rotation @ first.rotation.T
            first = dataclasses.replace(first, rotation=turn @ first.rotation)
            state = dataclasses.replace(state, rotation=turn @ state.rotation)
        age = 1e-9 * (motion.state.stamp - self.reference)
        back = np.eye(ERRORS)
        back[VELOCITY] = [velocity_jacobian(motion.state, age, axis) for axis in np.eye(3)]
        covariance = back @ covariance @ back.T
        lead = 1e-9 * (self.reference - self._begun)
        way = np.zeros((6, ERRORS))
        way[:3] = [lead * velocity_jacobian(state, 0.5 * lead, axis) for axis in np.eye(3)]
        way[3:, GYRO_BIAS] = lead * state.rotation
        return Beginning(state, covariance, first, way @ covariance @ way.T)

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
        is_other = bool(
            float(np.linalg.norm(change)) > tuning.START_FITTED_CHANGE
            and change @ np.linalg.solve(unknown, change) > tuning.START_SIGNIFICANT**2
        )
        # halves of the fan that are apart have turned the sweeps
        is_known_better = self._intrinsics.corrections.differ_from(self._mapped_with)
        return FittedStart(state, sigma, is_other or is_known_better, off[0] - design[0] @ fit)

    def end_search(self, end: HostNs) -> None:
        """Wait until the next search, with the sweeps that it will need."""
        is_late = end - self.since > tuning.START_AWAITED_NS
        is_sought = self.is_open and self._shown_by is ShownBy.NOTHING and not is_late
        is_repeated = self.may_begin_again and is_sought
        self.phase = SearchPhase.REPEATED if is_repeated else SearchPhase.FOLLOWING
        self._next = end + tuning.START_PAUSE_NS
        self._passed = [] if end > self._last else self._since(self._next - tuning.START_NS)
        if self._passed and not is_repeated:
            self.since = self._passed[0].sweep.start

    def _since(self, oldest: int) -> list[Passed]:
        """Return the sweeps that do not begin before an instant [ns]."""
        return [one for one in self._passed if one.sweep.start >= oldest]


def level_span(directions: F64, gravity: F64) -> F64:
    """Return orthonormal axes (K, 3) within the span of directions, as far as it is about level.

    They lie in it exactly: what the sweeps leave free is along a floor, not along the level that
    the IMU believes in.

    Parameters
    ----------
    directions : ndarray, shape (3, M)
    gravity : ndarray, shape (3,)
        [m/s^2]
    """
    basis, sizes, _ = np.linalg.svd(directions, full_matrices=False)
    basis = basis[:, sizes > tuning.START_LEVEL]
    up = gravity / np.linalg.norm(gravity)
    flat = basis - np.outer(up, up @ basis)
    _, lengths, combined = np.linalg.svd(flat, full_matrices=False)
    return np.asarray((combined @ basis.T)[lengths > tuning.START_LEVEL])


def with_level_gravity(
    motion: SweepMotion, vertical: F64, seconds: float, free: F64
) -> SweepMotion:
    """Return a motion whose gravity is along the vertical; unchanged if it agrees with it.

    The filter may have tilted gravity, in two ways. A young map confirms a wrong velocity, and an
    error that grows with time looks like a tilt. Or the carrier accelerated while gravity was
    initialized. The vertical that the surfaces of the place show is better than either.

    Wrong gravity has also accelerated the state, so its pose and velocity become less certain:
    only along axes that the sweeps left free, since along the others they have corrected the
    velocity.

    Parameters
    ----------
    motion : SweepMotion
    vertical : ndarray, shape (3,)
        That the sweeps show, unit vector, map axes.
    seconds : float
        For how long wrong gravity may have accelerated the state.
    free : ndarray, shape (K, 3)
        Level axes that the sweeps leave free, orthonormal, map axes.
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


def _with_open_turns(state: InertialState, covariance: F64) -> F64:
    """Return a covariance (18, 18) with roll and pitch rates as little known as at the start.

    What registrations have told about them is the echo of a wrong velocity: between walls, floors
    and ceilings fit together at it with another rate.
    """
    up = state.rotation.T @ (state.gravity / np.linalg.norm(state.gravity))
    yaw = np.outer(up, up)
    kept = np.eye(ERRORS)
    kept[GYRO_BIAS, GYRO_BIAS] = yaw
    out = kept @ covariance @ kept.T
    out[GYRO_BIAS, GYRO_BIAS] += tuning.INITIAL_IN_MOTION.gyro_bias**2 * (np.eye(3) - yaw)
    return np.asarray(out)


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
    return places - state.cloud_origin(lever) - carried


def _measured(
    seen: Seen,
    walls: Spots | None,
    state: InertialState,
    covariance: F64,
    axes: F64,
    *,
    first: bool,
) -> tuple[InertialState, F64, float] | None:
    """Return the posterior of the velocity along axes, and by how many sigmas it was off.

    Beside walls, the acceleration along them is found as well. It is computed on a grid; mean and
    variance become those of the state (assumed density filtering). None if that tells little more
    of the velocity than the prior.
    """
    now = int(state.stamp)
    age = 0.5e-9 * (now - int(seen["stamp"].min()))
    if walls is None:
        h = np.stack([velocity_jacobian(state, age, axis) for axis in axes])
        prior = h @ covariance @ h.T
        found = _sharpest_velocity(seen, state, covariance, axes, first=first)
        noise = np.full(len(axes), tuning.START_NOISE**2)
    else:
        along = axes[0]
        h = np.stack((velocity_jacobian(state, age, along), acceleration_jacobian(state, along)))
        prior = h @ covariance @ h.T
        frame = level_axes(along, state.gravity)
        found = motion_along_walls(walls, now, frame, age, prior)
        noise = np.array([tuning.START_NOISE, tuning.START_ACCELERATION_NOISE]) ** 2
    if found is None:
        return None
    mean, left = found[0], found[1] + np.diag(noise)
    of_velocity = slice(0, len(axes))
    before = np.trace(prior[of_velocity, of_velocity])
    if np.trace(left[of_velocity, of_velocity]) > tuning.START_BETTER * before:
        return None
    gain = np.linalg.solve(prior, h @ covariance).T
    after = state.boxplus(np.asarray(gain @ mean, np.float64))
    posterior = covariance + gain @ (left - prior) @ gain.T
    return after, posterior, float(np.sqrt(mean @ np.linalg.solve(left, mean)))


def _sharpest_velocity(
    seen: Seen, state: InertialState, covariance: F64, axes: F64, *, first: bool
) -> tuple[F64, F64] | None:
    """Return the error of the velocity along axes (K,) and its covariance (K, K), by posts.

    None where there are too few.
    """
    strengths, turn = np.linalg.eigh(axes @ covariance[VELOCITY, VELOCITY] @ axes.T)
    sigmas = np.sqrt(strengths)
    steps = (candidates(sigma, tuning.START_STEP) for sigma in sigmas.tolist())
    errors = np.array([*itertools.product(*steps)])
    principal = turn.T @ axes
    logs = velocity_log_likelihoods(seen, int(state.stamp), principal, errors, state.gravity)
    if logs is None:
        return None
    logs = logs - 0.5 * ((errors / sigmas) ** 2).sum(axis=1)
    if first:
        # posts at even distances look alike at several velocities, and carriers are not fast
        speeds = principal @ state.velocity + errors
        logs = logs - 0.5 * ((speeds / tuning.CARRIER_SPEED_SIGMA) ** 2).sum(axis=1)
    mean, left = moments(errors, logs)
    return turn @ mean, turn @ left @ turn.T
