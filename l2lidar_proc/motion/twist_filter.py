"""Twist filter: the error-state filter run on IMU samples, rest and measured velocities.

It serves the deskew where no odometry runs in the same process. The filter stays a little behind
the newest sample, so that a velocity that arrives late still finds its instant; from there the
samples are integrated through the sweep.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from l2lidar_node import rotations
from l2lidar_node.types import F64, STANDARD_GRAVITY, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion import carrier_priors, filter as eskf
from l2lidar_proc.motion.filter import ACCEL_BIAS, GRAVITY, GYRO_BIAS, POSITION, ROTATION, VELOCITY
from l2lidar_proc.motion.imu_buffer import ImuBuffer, Samples
from l2lidar_proc.motion.preintegration import ImuSegment, Preintegration, integrate, segment
from l2lidar_proc.motion.static import (
    StaticReference,
    gravity_is_plausible,
    initial_state,
    sample_period_s,
    static_reference,
    white_noise,
)
from l2lidar_proc.motion.sweep_motion import SweepTrajectory

_PENDING = 400  # velocities that wait for their IMU samples: two seconds at IMU rate


class Twist(NamedTuple):
    """A measured velocity of the cloud frame's origin, cloud axes."""

    stamp: HostNs
    velocity: F64
    covariance: F64


class TwistFilter:
    """Attitude, velocity and biases from IMU samples and twists.

    Parameters
    ----------
    buffer : ImuBuffer
        Samples in cloud axes; the owner fills it and calls :meth:`follow`.
    lever : ndarray, shape (3,)
        Place of the IMU in the cloud frame [m].
    max_bias : float
        Largest gyro bias [rad/s] to believe in at the first rest.

    Attributes
    ----------
    uses_accelerometer : bool
    source : str
        Where the velocities come from.
    newest_twist : HostNs or None
        Stamp of the newest velocity.
    is_faulty : bool
        The size of the measured gravity is impossible, as after a start on its side.
    """

    def __init__(self, buffer: ImuBuffer, lever: F64, max_bias: float) -> None:
        self._buffer = buffer
        self._lever = lever
        self._max_bias = max_bias
        self.uses_accelerometer = True
        self.reset()

    def reset(self) -> None:
        """Forget everything, as after a jump of the clock."""
        self._state: eskf.InertialState | None = None
        self._covariance: F64 = np.zeros((eskf.ERRORS, eskf.ERRORS))
        self._reference: StaticReference | None = None
        self._stepped: int | None = None
        self._steps = 0
        self._lag_ns = tuning.TRACKER_LAG_NS
        self.is_faulty = False
        self._forget_twists()

    def _forget_twists(self) -> None:
        self.source = ""
        self.newest_twist: HostNs | None = None
        self._speed = 0.0
        self._pending: deque[Twist] = deque(maxlen=_PENDING)

    # ---- what is known

    @property
    def gyro_bias(self) -> F64:
        """Gyro bias [rad/s], cloud axes, shape (3,); zero while nothing is known."""
        return np.zeros(3) if self._state is None else self._state.gyro_bias

    @property
    def gyro_bias_sigma(self) -> float:
        """Standard deviation of the gyro bias about the worst axis [rad/s]."""
        if self._state is None:
            return tuning.INITIAL_IN_MOTION.gyro_bias
        return float(np.sqrt(np.diag(self._covariance)[GYRO_BIAS].max()))

    @property
    def gravity(self) -> float:
        """Size of gravity as this accelerometer reads it [m/s^2]."""
        if self._state is None:
            return STANDARD_GRAVITY
        return float(np.linalg.norm(self._state.rest_force + self._state.accel_bias))

    @property
    def up(self) -> F64:
        """Direction of the vertical, cloud axes, unit, shape (3,); zero while unknown."""
        if self._state is None or not self._state.gravity.any():
            return np.zeros(3)
        return np.asarray(self._state.rest_force / np.linalg.norm(self._state.rest_force))

    def up_at(self, stamp: HostNs) -> F64:
        """Return :attr:`up` at an instant in the buffer; zero where it is not known."""
        up, state = self.up, self._state
        if state is None or abs(state.stamp - stamp) > tuning.TIME_JUMP_NS:
            return np.zeros(3)
        first, last = min(stamp, state.stamp), max(stamp, state.stamp)
        found = self.trajectory(first, last, tuning.TRACKER_LAG_NS, translates=False)
        turn, _ = found.between(stamp, state.stamp)
        return rotations.rotate(turn, up)

    @property
    def is_trusted(self) -> bool:
        """Whether gravity is known well enough to integrate forces."""
        if self._state is None or self.is_faulty or not self._state.gravity.any():
            return False
        jacobian = np.zeros((3, eskf.ERRORS))
        jacobian[:, ROTATION] = eskf.skew(self._state.rest_force)
        jacobian[:, ACCEL_BIAS] = np.eye(3)
        jacobian[:, GRAVITY] = -self._state.rotation.T
        spread = jacobian @ self._covariance @ jacobian.T
        return bool(np.linalg.eigvalsh(spread)[-1] < tuning.TRUSTED_ACCELERATION**2)

    def speed_near(self, stamp: HostNs, age_ns: int) -> float | None:
        """Return the size of the newest velocity [m/s], None if it is older than an age."""
        if self.newest_twist is None or stamp - self.newest_twist > age_ns:
            return None
        return self._speed

    def is_still(self, samples: Samples) -> bool:
        """Return whether the sensor stood still during these samples.

        Judged by the rest it is in; in its first second, before any is known, by the samples
        alone.
        """
        if self._reference is not None:
            return self._reference.matches(samples)
        if self._steps >= tuning.TRACKER_WINDOW:
            return False
        least_s = tuning.STATIC_BLOCK_S
        return static_reference(samples, np.zeros(3), self._max_bias, least_s=least_s) is not None

    # ---- what arrives

    def take(
        self, stamp: HostNs, velocity: ArrayLike, source: str, covariance: F64 | None = None
    ) -> bool:
        """Take a velocity; see :meth:`l2lidar_proc.motion.tracker.MotionTracker.velocity`."""
        vector = np.array(velocity, dtype=np.float64)
        if vector.shape != (3,) or not (np.abs(vector) <= tuning.MAX_SPEED).all():
            return False
        latest = self._latest_credible
        if latest is not None and stamp > latest:
            return False
        if source != self.source or (
            # it came before the samples that show it to be of another time
            latest is not None and self.newest_twist is not None and self.newest_twist > latest
        ):
            self._forget_twists()
            self.source = source
        if self.newest_twist is not None and stamp <= self.newest_twist:
            return False
        self.newest_twist = stamp
        self._speed = float(np.linalg.norm(vector))
        self._pending.append(Twist(stamp, vector, _believed(covariance)))
        self._update()
        return True

    @property
    def _latest_credible(self) -> int | None:
        """Latest stamp that a velocity can have by now, None before the first sample."""
        newest = self._buffer.newest
        return None if newest is None else newest + tuning.TWIST_AHEAD_NS

    @property
    def behind_ns(self) -> int:
        """How far the newest sample is ahead of those that were followed."""
        newest = self._buffer.newest
        if newest is None:
            return 0
        first = int(self._buffer.samples["stamp"][0])
        return newest - (self._stepped if self._stepped is not None else first)

    def follow(self) -> None:
        """Follow the samples that have come into the buffer."""
        newest = self._buffer.newest
        if newest is None:
            return
        if self._stepped is None:
            self._stepped = int(self._buffer.samples["stamp"][0])
        step = tuning.TRACKER_STEP_NS
        while newest - self._stepped >= step:
            stamps = self._buffer.samples["stamp"]
            following = int(stamps[np.searchsorted(stamps, self._stepped, side="right")])
            if following - self._stepped > tuning.TRACKER_BREAK_NS:
                self._interrupt(HostNs(following))
                continue
            self._stepped += step
            self._steps += 1
            self._judge(self._stepped)
        self._update()

    # ---- steps

    def _judge(self, end: int) -> None:
        """Judge the last second: rest or motion, and whether the accelerometer is sound."""
        begin = end - tuning.TRACKER_WINDOW * tuning.TRACKER_STEP_NS
        if self._steps < tuning.TRACKER_WINDOW:
            if self._state is None:
                self._begin(end)
            return
        second = self._buffer.between(HostNs(begin), HostNs(end))
        speed = self.speed_near(HostNs(end), tuning.TRACKER_LAG_NS)
        found = None
        if speed is None or speed < tuning.TWIST_STILL_SPEED:
            # a wrong rest teaches a wrong bias: entering takes more than staying
            stays = self._reference is not None
            sigmas = tuning.STATIC_SIGMAS if stays else tuning.STATIC_ENTRY_SIGMAS
            margin = min(self._max_bias, 3.0 * self.gyro_bias_sigma)
            found = static_reference(second, self.gyro_bias, margin, sigmas=sigmas)
        turn = -(-len(second) * tuning.TRACKER_TURN // tuning.TRACKER_WINDOW)
        # a slow IMU has fewer in a turn than it takes to match
        newest = second[-max(turn, tuning.STATIC_BLOCK_LEAST) :]
        if self._reference is not None and not self._reference.matches(newest):
            found = None
        if found is not None and self._reference is not None:
            found = self._reference.blended(found, tuning.STATIC_BLEND)
        self._reference = found
        faulty = not gravity_is_plausible(second, at_rest=found is not None)
        unknown = self._state is None or not self._state.gravity.any()
        if faulty != self.is_faulty or (unknown and not faulty):
            self.is_faulty = faulty
            self._begin(end)

    def _begin(self, end: int) -> None:
        """Take attitude and gravity from the samples before an instant; biases stay."""
        samples = self._buffer.between(HostNs(end - tuning.TRACKER_START_NS), HostNs(end))
        begun = initial_state(samples, HostNs(int(samples["stamp"][-1])), may_rest=False)
        before, covariance = self._state, begun.covariance
        state = begun.state
        if before is not None:
            state = dataclasses.replace(
                state,
                velocity=state.rotation @ before.rotation.T @ before.velocity,
                gyro_bias=before.gyro_bias,
                accel_bias=before.accel_bias,
            )
            for errors in (VELOCITY, GYRO_BIAS, ACCEL_BIAS):
                covariance[errors, errors] = self._covariance[errors, errors]
            worst = float(np.linalg.eigvalsh(covariance[VELOCITY, VELOCITY])[-1])
            covariance[VELOCITY, VELOCITY] = worst * np.eye(3)
        self._state, self._covariance = state, covariance

    def _interrupt(self, stamp: HostNs) -> None:
        """Go on after a gap in the samples: attitude and rest are unknown again."""
        self._stepped, self._reference, self._steps = int(stamp), None, 0
        if self._state is not None:
            known = self._covariance[GYRO_BIAS, GYRO_BIAS]
            self._covariance = np.diag(np.full(eskf.ERRORS, 1.0))
            self._covariance[GYRO_BIAS, GYRO_BIAS] = known
            self._state = dataclasses.replace(self._state, stamp=stamp, velocity=np.zeros(3))

    def _update(self) -> None:
        """Bring the filter up to date with velocities and rest."""
        newest = self._buffer.newest
        if self._state is None or newest is None:
            return
        while self._pending and self._pending[0].stamp <= newest:
            self._use(self._pending.popleft(), newest)
        due = newest - self._lag_ns
        if due - self._state.stamp < tuning.TRACKER_STEP_NS:
            return
        if self._reference is not None:
            self._rest(HostNs(due))
        else:
            seconds = (due - self._state.stamp) * 1e-9
            self._predict(HostNs(due))
            # no peak speed: a source that is silent for seconds may have stopped with the carrier
            self._state, self._covariance = carrier_priors.apply_zero_velocity_prior(
                self._state, self._covariance, seconds, 0.0
            )

    def _use(self, twist: Twist, newest: int) -> None:
        """Update the filter with a velocity."""
        assert self._state is not None
        late = self._state.stamp - twist.stamp
        if late > 0:
            # the next ones of this source shall find their instant
            lag = newest - twist.stamp + tuning.TRACKER_STEP_NS
            self._lag_ns = min(max(self._lag_ns, lag), tuning.TRACKER_LAG_MAX_NS)
            return
        if -late < tuning.TWIST_STEP_NS and self._pending:
            return
        if self._reference is not None and np.linalg.norm(twist.velocity) < tuning.STILL_SPEED:
            self._rest(twist.stamp)
            return
        rate = self._predict(twist.stamp)
        found = eskf.update_twist(
            self._state, self._covariance, twist.velocity, twist.covariance, rate, self._lever
        )
        if found.nis > tuning.TWIST_NIS:
            # the filter was wrong, or the source jumped: follow the source
            speed = float(np.linalg.norm(self._state.velocity)) + self._speed
            sigma = max(tuning.CARRIER_SPEED_SIGMA, speed)
            self._covariance = eskf.decorrelated(self._covariance, VELOCITY, sigma)
            found = eskf.update_twist(
                self._state, self._covariance, twist.velocity, twist.covariance, rate, self._lever
            )
        self._state, self._covariance = found.state, found.covariance

    def _rest(self, stamp: HostNs) -> None:
        """Carry the filter to an instant through which the sensor was at rest."""
        assert self._state is not None
        samples = self._buffer.between(self._state.stamp, stamp)
        self._state, self._covariance = eskf.update_static(
            self._state,
            self._covariance,
            samples,
            self._noise(samples),
            self._uses_forces,
            levels=True,
        )
        self._state = dataclasses.replace(self._state, stamp=stamp)

    def _predict(self, stamp: HostNs) -> F64:
        """Carry the filter to an instant; return the measured rate there [rad/s], shape (3,)."""
        assert self._state is not None
        state = self._state
        if stamp > state.stamp:
            imu, preintegrated = self._integrated(
                state, state.stamp, stamp, tuning.TRACKER_GAP_NS, self._uses_forces
            )
            self._state, self._covariance = eskf.predict(
                state,
                self._covariance,
                imu,
                preintegrated,
                len(imu.stamps) - 1,
                self._noise(self._buffer.between(state.stamp, stamp)),
                use_forces=self._uses_forces,
            )
            # places are of no interest, and would grow without bound
            self._state = dataclasses.replace(self._state, position=np.zeros(3))
            self._covariance = eskf.decorrelated(
                self._covariance, POSITION, tuning.START_POSE_SIGMA
            )
        near = self._buffer.between(
            HostNs(stamp - tuning.GAP_STEP_NS), HostNs(stamp + tuning.GAP_STEP_NS)
        )
        return np.asarray(near["angular_velocity"].mean(axis=0))

    @property
    def _uses_forces(self) -> bool:
        known = self._state is not None and bool(self._state.gravity.any())
        return self.uses_accelerometer and known and not self.is_faulty

    def _noise(self, samples: Samples) -> eskf.Noise:
        # densities: what is known is stated for 250 Hz, what is measured has the IMU's own rate,
        # which a few samples between two velocities do not show
        stated = float(np.sqrt(tuning.IMU_PERIOD_S))
        recent = self._buffer.samples[-round(1.0 / tuning.IMU_PERIOD_S) :]
        measured = float(np.sqrt(sample_period_s(recent)))
        rates, forces = samples["angular_velocity"], samples["linear_acceleration"]
        return eskf.Noise(
            max(tuning.TRACKER_GYRO_NOISE * stated, white_noise(rates) * measured),
            max(tuning.TRACKER_ACCEL_NOISE * stated, white_noise(forces) * measured),
            tuning.TRACKER_GYRO_WALK,
            tuning.TRACKER_ACCEL_WALK,
        )

    def knows_velocity(self, start: HostNs, age_ns: int) -> bool:
        """Return whether a velocity not older than an age [ns] serves a sweep's start."""
        newest = self.newest_twist
        return self._state is not None and newest is not None and start - newest <= age_ns

    def trajectory(
        self, start: HostNs, end: HostNs, hold_ns: int, translates: bool
    ) -> SweepTrajectory:
        """Return the trajectory of the cloud frame from ``start`` (or earlier) to ``end``.

        Parameters
        ----------
        start, end : HostNs
        hold_ns : int
            Beyond the samples the last rate is held for this long.
        translates : bool
            A velocity is known; otherwise rotations alone are returned.
        """
        state = self._state
        if not translates or state is None or abs(state.stamp - start) > tuning.TIME_JUMP_NS:
            nowhere = np.zeros(3)
            state = eskf.InertialState(
                start, np.eye(3), nowhere, nowhere, self.gyro_bias, nowhere, nowhere
            )
        first = HostNs(min(start, state.stamp))
        last = HostNs(max(end, state.stamp, first + 1))
        use_forces = translates and self._uses_forces and self.is_trusted
        _, preintegrated = self._integrated(state, first, last, hold_ns, use_forces)
        found = SweepTrajectory.of(preintegrated, state, self._lever)
        return found if translates else found.without_translation()

    def _integrated(
        self, state: eskf.InertialState, start: HostNs, end: HostNs, hold_ns: int, use_forces: bool
    ) -> tuple[ImuSegment, Preintegration]:
        """Return the samples of a span that contains a state, integrated from there."""
        imu = segment(
            self._buffer.between(start, end),
            [start, state.stamp, end],
            tuning.TRACKER_GAP_NS,
            state.gyro_bias,
            hold_ns,
        )
        return imu, integrate(
            imu,
            imu.knot(state.stamp),
            gyro_bias=state.gyro_bias,
            accel_bias=state.accel_bias,
            rest_force=state.rest_force,
            use_forces=use_forces,
            body_velocity=state.rotation.T @ state.velocity,
        )


def _believed(covariance: F64 | None) -> F64:
    """Return the covariance of a velocity, that of an ordinary source where it makes no sense."""
    if covariance is None or covariance.shape != (3, 3) or not np.isfinite(covariance).all():
        return tuning.TWIST_SIGMA**2 * np.eye(3)
    strength = np.linalg.eigvalsh(covariance)
    if strength[0] < 0.0 or strength[-1] <= 0.0 or strength[-1] > tuning.MAX_SPEED**2:
        return tuning.TWIST_SIGMA**2 * np.eye(3)
    return np.asarray(covariance + tuning.TWIST_SIGMA_LEAST**2 * np.eye(3))
