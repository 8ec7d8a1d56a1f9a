"""Tracks the gyro's bias and the direction of gravity through rest and motion.

At rest the mean rate is the bias and the mean force is gravity. In motion the force, turned into
one frame and averaged over a second, is gravity plus the change of velocity in that second: known
when a velocity source says so, otherwise a larger uncertainty. That ties roll and pitch, and with
them the bias across the vertical, to gravity; about the vertical the bias rests on what was
learned at rest. Yaw is of no interest here.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs
from l2lidar_proc import rotations
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.motion.static import Rest, at_rest, blended, still_like
from l2lidar_proc.motion.sweep_trajectory import Gravity
from l2lidar_proc.motion.velocity import VelocityHistory
from l2lidar_proc.motion.vertical import VerticalFilter
from l2lidar_proc.rotations import F64

STANDARD_GRAVITY: Final = 9.80665  # [m/s^2]

_STEP_S: Final = 0.1  # the filter's step
_WINDOW: Final = 10  # steps that one measurement of gravity or rest spans
_TURN: Final = 3  # steps that the head needs for a turn, over which its shaking averages out
_LAG: Final = 5  # steps that the newest velocity may be behind
_HISTORY: Final = 80  # states remembered, so that a late sweep finds its own
_BREAK_NS: Final = 500_000_000  # a gap in the samples after which the vertical is unknown again
_PLAUSIBLE: Final = (8.8, 10.8)  # [m/s^2] what |a| at rest may be
_PLAUSIBLE_MOVING: Final = (7.5, 12.5)  # its mean over a second of motion

_TRUSTED_TILT: Final = 0.06  # [rad] largest deviation with which gravity is of use
_FORCE_AT_REST: Final = 0.05  # [m/s^2]
_FORCE_MOVING: Final = (0.25, 1.5)  # [m/s^2] with and without known velocities


@dataclass(frozen=True, slots=True, eq=False)
class Attitude:
    """What is known about vertical and bias at one instant.

    Attributes
    ----------
    stamp : HostNs
    up : ndarray, shape (3,)
        Vertical, unit, IMU axes.
    gravity : float
        What the accelerometer says of gravity's size [m/s^2].
    bias : ndarray, shape (3,)
        Of the gyro [rad/s], IMU axes.
    bias_sigma : float
        Its standard deviation about the worst axis [rad/s].
    is_still : bool
        Whether the sensor stands still.
    is_trusted : bool
        Whether vertical and accelerometer can be relied on.
    is_faulty : bool
        Whether the size of the measured gravity is impossible, as after a start on its side.
    """

    stamp: HostNs
    up: F64
    gravity: float
    bias: F64
    bias_sigma: float
    is_still: bool
    is_trusted: bool
    is_faulty: bool


class AttitudeFilter:
    """Follows the IMU samples in order of time.

    Parameters
    ----------
    T_cloud_imu : ndarray, shape (4, 4)
        IMU coordinates to cloud coordinates.
    max_bias : float
        Largest bias [rad/s] to believe in at the first rest.
    """

    def __init__(self, T_cloud_imu: F64, max_bias: float = 0.1) -> None:
        self._R_cloud_imu = np.asarray(T_cloud_imu, dtype=np.float64)[:3, :3]
        self._max_bias = max_bias
        self.reset()

    def reset(self) -> None:
        """Forget everything, as after a jump of the clock."""
        self._vertical = VerticalFilter()
        self._bias_known = False
        self._gravity = STANDARD_GRAVITY
        self._rest: Rest | None = None
        self._faulty = False
        self._pending: list[Samples] = []
        self._recent: deque[Samples] = deque(maxlen=_WINDOW + _LAG)
        self._steps = 0
        self._states: deque[Attitude] = deque(maxlen=_HISTORY)

    @property
    def latest(self) -> Attitude | None:
        """The newest state, None before the first tenth of a second."""
        return self._states[-1] if self._states else None

    @property
    def bias(self) -> F64:
        """The newest bias [rad/s], IMU axes, shape (3,); zero while nothing is known."""
        return self._vertical.bias.copy()

    def at(self, stamp: HostNs) -> Attitude | None:
        """Return the last state not later than an instant, else the first one, if any."""
        for state in reversed(self._states):
            if state.stamp <= stamp:
                return state
        return self._states[0] if self._states else None

    def gravity_before(self, stamp: HostNs) -> Gravity | None:
        """Return gravity in cloud axes as last known at an instant, None if not trusted."""
        state = self.at(stamp)
        if state is None or not state.is_trusted:
            return None
        return Gravity(state.stamp, self._R_cloud_imu @ state.up * state.gravity)

    def is_still(self, samples: Samples) -> bool:
        """Return whether the sensor stood still during these samples.

        Judged by the rest it is in; in its first second, before any rest is known, by the samples
        alone.
        """
        if self._rest is not None:
            return still_like(samples, self._rest)
        if self._steps >= _WINDOW:
            return False
        return at_rest(samples, np.zeros(3), self._max_bias, least=25) is not None

    def push(self, samples: Samples, velocities: VelocityHistory | None = None) -> None:
        """Follow samples.

        Parameters
        ----------
        samples : ndarray, shape (N,), dtype IMU_SAMPLE
            Later than those before, ascending.
        velocities : VelocityHistory, optional
            How the sensor moves, as far as known.
        """
        self._pending.append(samples)
        first = int(self._pending[0]["stamp"][0]) if len(self._pending[0]) else 0
        if not len(samples) or (int(samples["stamp"][-1]) - first) < _STEP_S * 1e9:
            if not len(samples):
                self._pending.pop()
            return
        joined = np.concatenate(self._pending)
        step = np.int64(_STEP_S * 1e9)
        cuts = np.flatnonzero(np.diff((joined["stamp"] - first) // step)) + 1
        *whole, rest = np.split(joined, cuts)
        self._pending = [rest]
        for part in whole:
            self._follow(part, velocities)

    def measure_bias(self, bias: F64, sigma: float) -> None:
        """Take a bias [rad/s] that was found elsewhere, as by matching sweeps.

        Parameters
        ----------
        bias : ndarray, shape (3,)
            IMU axes.
        sigma : float
            Its standard deviation [rad/s].
        """
        self._vertical.measure_bias(bias, np.full(3, sigma**2))

    def _follow(self, step: Samples, velocities: VelocityHistory | None) -> None:
        """Take one step of about a tenth of a second."""
        before = self._recent[-1] if self._recent else None
        if before is not None and int(step["stamp"][0] - before["stamp"][-1]) > _BREAK_NS:
            self._recent.clear()
            self._rest, before = None, None
        if before is None:
            self._vertical.begin(step["linear_acceleration"].mean(axis=0))
        else:
            self._vertical.predict(np.concatenate((before[-1:], step)))
        self._recent.append(step)
        self._steps += 1
        if len(self._recent) >= _WINDOW:
            self._look_back(velocities)
        self._states.append(self._state(HostNs(int(step["stamp"][-1]))))

    def _state(self, stamp: HostNs) -> Attitude:
        vertical = self._vertical
        assert vertical.up is not None
        return Attitude(
            stamp=stamp,
            up=vertical.up,
            gravity=self._gravity,
            bias=vertical.bias.copy(),
            bias_sigma=vertical.bias_sigma,
            is_still=self._rest is not None,
            is_trusted=not self._faulty and vertical.tilt_sigma < _TRUSTED_TILT,
            is_faulty=self._faulty,
        )

    def _look_back(self, velocities: VelocityHistory | None) -> None:
        """Judge the last second: rest or motion, and what follows from it."""
        second = np.concatenate(list(self._recent)[-_WINDOW:])
        moving = (
            velocities.at(HostNs(int(second["stamp"][-1]))) if velocities is not None else None
        )
        slow = moving is None or float(np.linalg.norm(moving)) < 0.1
        # to miss a rest costs little, but what is taken for one teaches the bias
        sigmas = 3.0 if self._rest is None else 5.0
        margin = 3.0 * self._vertical.bias_sigma if self._bias_known else self._max_bias
        found = at_rest(second, self._vertical.bias, margin, sigmas=sigmas) if slow else None
        newest = second[-len(second) * _TURN // _WINDOW :]
        if self._rest is not None and not still_like(newest, self._rest):
            found = None
        if found is None:
            self._rest = None
        elif self._rest is None:
            self._rest = found
        else:
            self._rest = blended(self._rest, found, 0.1)
        if self._steps % _WINDOW and not (found is not None and not self._bias_known):
            return
        if found is not None:
            self._measure_rest(found, len(second))
        else:
            self._measure_motion(velocities)

    def _measure_rest(self, rest: Rest, count: int) -> None:
        size = float(np.linalg.norm(rest.force))
        self._faulty = not _PLAUSIBLE[0] <= size <= _PLAUSIBLE[1]
        self._vertical.measure_bias(rest.rate, 1.5 * rest.rate_spread**2 / count + 1e-8)
        self._bias_known = True
        if not self._faulty:
            share = 1.0 if self._gravity == STANDARD_GRAVITY else 0.2
            self._gravity += share * (size - self._gravity)
            self._vertical.measure_force(rest.force, self._gravity, _FORCE_AT_REST)

    def _measure_motion(self, velocities: VelocityHistory | None) -> None:
        """Take the mean force of a second for gravity, less what the velocity gained in it.

        Velocities come late, so the second is the one before the newest of them; what the sensor
        turned since is known from the gyro.
        """
        samples = np.concatenate(list(self._recent))
        stamps, forces = samples["stamp"], samples["linear_acceleration"]
        size = float(np.linalg.norm(forces, axis=1).mean())
        self._faulty = not _PLAUSIBLE_MOVING[0] <= size <= _PLAUSIBLE_MOVING[1]
        if self._faulty:
            return
        span = round(_WINDOW * _STEP_S * 1e9)
        end = int(stamps[-1])
        newest = velocities.newest if velocities is not None else None
        if newest is not None and stamps[0] + span <= newest < end:
            end = newest
        second = slice(*np.searchsorted(stamps, [end - span, end]))
        to_now = self._vertical.turned_to_last(samples)
        force = rotations.rotate(to_now, forces)[second].mean(axis=0)
        ends = [second.start, second.stop - 1]
        gained = self._gained(stamps[ends], to_now[ends], velocities)
        known, unknown = _FORCE_MOVING
        if gained is None:
            self._vertical.measure_force(force, self._gravity, unknown)
        else:
            self._vertical.measure_force(force - gained, self._gravity, known)

    def _gained(
        self, stamps: NDArray[np.int64], to_now: F64, velocities: VelocityHistory | None
    ) -> F64 | None:
        """Return the mean acceleration between two instants [m/s^2] if it is known."""
        if velocities is None:
            return None
        before, after = (velocities.at(HostNs(int(stamp))) for stamp in stamps)
        if before is None or after is None:
            return None
        v = rotations.rotate(to_now, np.stack((before, after)) @ self._R_cloud_imu)
        return np.asarray((v[1] - v[0]) / ((stamps[1] - stamps[0]) * 1e-9))
