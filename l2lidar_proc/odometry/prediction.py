"""Prediction by the IMU: over a sweep with full covariance, and between sweeps without.

:class:`Predictor` carries the filter over each sweep. A sweep is estimated 0.1 to 0.2 s after its
reference, but controllers want 20 to 50 poses a second, and RViz drops a cloud whose transform has
not come yet. :class:`DeadReckoning` therefore moves the latest estimate by the mean rate and the
mean specific force of the samples of each step. At every sweep its state is replaced by
:meth:`~l2lidar_proc.odometry.odometry.Odometry.extrapolated`, whose full covariance takes much
longer. For a step of 20 ms the mean is as good as every sample by itself; docs/odometry.md says by
how much the two differ.
"""

from __future__ import annotations

import dataclasses
from enum import Enum
from itertools import pairwise
from typing import Final

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.types import F64, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import GYRO_BIAS, ROTATION, VELOCITY, InertialState, Noise
from l2lidar_proc.motion.head_line import HeadAngle, HeadLine, LineRates
from l2lidar_proc.motion.imu_buffer import ImuBuffer, Samples
from l2lidar_proc.motion.static import noise_spectrum, sample_period_s
from l2lidar_proc.motion.sweep_motion import SweepMotion, predict_sweep
from l2lidar_proc.motion.tracker import turned
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import OdometryEstimate

LONGEST_NS: Final = 1_000_000_000
"""Without a sweep for this long the pose is not carried on: the speed drifts by 0.1 m/s."""


class ImuUse(Enum):
    """Part of the IMU that a motion is predicted from."""

    ALL = "all"  # as far as it can be trusted
    GYRO = "gyro"  # the velocity is held instead of using the accelerometer
    NOTHING = "nothing"  # the rate is held as well


class Predictor:
    """Holds the latest IMU samples and propagates states along them.

    Parameters
    ----------
    config : OdometryConfig
    T_cloud_imu : ndarray, shape (4, 4)
        IMU coordinates to cloud coordinates.

    Attributes
    ----------
    config : OdometryConfig
        May be replaced.
    trusts_gravity : bool
        Whether the accelerometer is sound.
    steady_rate : ndarray, shape (3,)
        Rate without bias where there is no gyro [rad/s], cloud axes.
    gyro_noise : float
        Of the samples that were used last [rad/s], each axis.
    may_have_head_lines : bool
        Whether the gyro may have lines of a head that its samples do not show.
    """

    def __init__(self, config: OdometryConfig, T_cloud_imu: F64) -> None:
        self.config = config
        self._turn: F64 = T_cloud_imu[:3, :3]
        self._imu = ImuBuffer(tuning.ODOMETRY_MEMORY_S)
        self.reset()

    def reset(self) -> None:
        """Forget what was found out about the motion; the samples stay."""
        self.trusts_gravity = False
        self.may_have_head_lines = True
        self.steady_rate: F64 = np.zeros(3)
        self.gyro_noise = self.config.inertial.gyro_noise
        self._period_s = tuning.IMU_PERIOD_S  # of the samples that were used last
        self._rest: tuple[F64, int] = np.zeros(3), 0  # mean squares of the gyro at rest, samples
        self._line = HeadLine()

    def imu(self, samples: Samples) -> None:
        """Take IMU samples (N,), dtype IMU_SAMPLE, in any order and state."""
        self._imu.push(turned(samples, self._turn))

    @property
    def newest_imu(self) -> HostNs | None:
        """Stamp of the newest sample, None before the first."""
        return self._imu.newest

    def samples(self, start: int, end: int) -> Samples:
        """Return the samples of a span with a neighbor on either side, cloud axes.

        Without the line of the head, as far as it is known.
        """
        return self._line.removed(self._imu.between(HostNs(start), HostNs(end)))

    @property
    def gyro_line(self) -> LineRates | None:
        """The line of the head in the gyro; None before it is known."""
        return self._line.rates

    def note_head(self, head: HeadAngle, end: HostNs) -> None:
        """Take the angle of the head, and learn its line from the turn that ends at an instant."""
        self._line.head = head
        if self._line.is_due(end):
            self._line.learn(self._imu.between(HostNs(end - head.turn_ns), end))

    def reference(self, sweep: Sweep) -> HostNs:
        """Return the instant of a sweep whose pose is estimated."""
        if self.config.reference == "start":
            return sweep.start
        if self.config.reference == "end":
            return sweep.end
        return HostNs((sweep.start + sweep.end) // 2)

    def attitude_variance(self, sweep: Sweep) -> float:
        """Return the variance of the attitude at the reference of an aligned sweep [rad^2].

        Alignment tells the mean attitude over a sweep. Between that and the attitude at one
        instant lies what the gyro's white noise adds up to, a random walk: its mean over a time T
        differs from its value after a share a of it by ``density^2 T (1/3 - a (1 - a))``.
        """
        lasted = sweep.end - sweep.start
        if lasted <= 0:
            return 0.0
        before = (self.reference(sweep) - sweep.start) / lasted
        share = 1.0 / 3.0 - before * (1.0 - before)
        return self.gyro_density**2 * lasted * 1e-9 * share

    def over_sweep(
        self,
        sweep: Sweep,
        state: InertialState,
        covariance: F64,
        since: HostNs | None = None,
        *,
        use: ImuUse = ImuUse.ALL,
    ) -> SweepMotion:
        """Return the motion of a sweep that follows from an earlier state, as :meth:`over`."""
        span = (sweep.start if since is None else since, sweep.end)
        reference = self.reference(sweep)
        return self.over(state, covariance, span, reference, use=use)

    def over(
        self,
        state: InertialState,
        covariance: F64,
        span: tuple[HostNs, HostNs],
        reference: HostNs,
        *,
        use: ImuUse = ImuUse.ALL,
    ) -> SweepMotion:
        """Return the motion that follows from a state.

        Parameters
        ----------
        state : InertialState
            Not later than the reference.
        covariance : ndarray, shape (18, 18)
        span : tuple of HostNs
            Start and end of what the motion has to cover.
        reference : HostNs
        use : ImuUse
        """
        until = max(span[1], reference)
        samples = self.samples(min(span[0], state.stamp), until)
        noise = self._noise(samples)
        if use is ImuUse.NOTHING:
            samples = samples[:0]
        inside = (samples["stamp"] >= state.stamp) & (samples["stamp"] <= until)
        if not inside.any():
            # the bias stands for the change of the rate: the sweep itself will show it
            covariance = eskf.decorrelated(covariance, GYRO_BIAS, tuning.STEADY_RATE_SIGMA)
        gap = reference - state.stamp
        covered = len(samples) * sample_period_s(samples) * 1e9
        if gap > tuning.LONG_GAP_NS and covered < 0.5 * gap:
            speed = float(np.linalg.norm(state.velocity))
            covariance = eskf.decorrelated(covariance, VELOCITY, max(1.0, speed))
            state = dataclasses.replace(state, velocity=np.zeros(3))
        return predict_sweep(
            state,
            covariance,
            samples,
            span,
            reference,
            noise=noise,
            gap_ns=round(self.config.inertial.imu_gap_ms * 1e6),
            steady_rate=self.steady_rate + state.gyro_bias,
            use_forces=use is ImuUse.ALL and self._use_forces,
        )

    def static_update(
        self, state: InertialState, covariance: F64, until: HostNs
    ) -> tuple[InertialState, F64]:
        """Return state and covariance of a sensor at rest since, up to an instant."""
        samples = self.samples(state.stamp, until)
        self._note_rest(samples, state.gyro_bias)
        noise = self._noise(samples)
        return eskf.update_static(state, covariance, samples, noise, self._use_forces)

    @property
    def _use_forces(self) -> bool:
        return self.trusts_gravity and self.config.inertial.use_accelerometer

    def _note_rest(self, samples: Samples, bias: F64) -> None:
        """Take samples of a sensor at rest, which show all of the gyro's noise.

        The lines of the head are in it, which differ tenfold between units and do not show while
        the sensor moves.
        """
        if not len(samples):
            return
        known, count = self._rest
        squared = np.square(samples["angular_velocity"] - bias).mean(axis=0)
        count = min(count + len(samples), tuning.GYRO_REST_MEMORY)
        known = known + min(len(samples) / count, 1.0) * (squared - known)
        self._rest = known, count

    @property
    def gyro_density(self) -> float:
        """The gyro's noise as a density [rad/s/sqrt(Hz)]."""
        return self.gyro_noise * float(np.sqrt(self._period_s))

    @property
    def _least_gyro_noise(self) -> float | None:
        """The gyro's noise as measured at rest [rad/s], None before that."""
        known, count = self._rest
        if count < tuning.GYRO_REST_SAMPLES:
            return None
        return max(float(np.sqrt(known.max())), tuning.LEAST_GYRO_NOISE)

    def _noise(self, samples: Samples) -> Noise:
        """Return the noise at the end of samples: as known, or more where a second shows more."""
        settings = self.config.inertial
        if len(samples):
            latest = HostNs(int(samples["stamp"][-1]))
            samples = self.samples(HostNs(latest - tuning.NOISE_WINDOW_NS), latest)
        period = sample_period_s(samples)
        stated = float(np.sqrt(tuning.IMU_PERIOD_S / period))  # a density, as white noise has
        gyro = noise_spectrum(samples["angular_velocity"], period)
        accel = noise_spectrum(samples["linear_acceleration"], period)
        least = self._least_gyro_noise
        if least is None:
            least = (
                settings.gyro_noise * stated
                if self.may_have_head_lines
                else tuning.LEAST_GYRO_NOISE
            )
        self.gyro_noise = max(least, tuning.GYRO_NOISE_FACTOR * gyro.floor)
        self._period_s = period
        return Noise(
            self.gyro_density,
            max(settings.accel_noise * stated, accel.floor) * float(np.sqrt(period)),
            settings.gyro_bias_walk,
            settings.accel_bias_walk,
            tuning.GYRO_SHARE,
            tuning.ACCEL_SHARE,
            gyro.vibration,
            accel.vibration,
        )


def blur_of(predicted: SweepMotion, before: F64) -> F64 | None:
    """Return the covariance that the IMU leaves open within a sweep, if it is large.

    After a hit, or in a gap of its samples, attitude and velocity become uncertain all at once,
    and the parts of the sweep before and after do not fit together. The sweep then tells the
    motion of one part, or a mean of both.

    Parameters
    ----------
    predicted : SweepMotion
    before : ndarray, shape (18, 18)
        Covariance of the state from which it was predicted.

    Returns
    -------
    ndarray, shape (18, 18), or None
        Covariance of attitude and velocity; None without an IMU, where the sweep alone tells.
    """
    if predicted.imu.missing.all():
        return None
    added = predicted.covariance - before
    turn, speed = (
        float(np.linalg.eigvalsh(added[errors, errors])[-1]) for errors in (ROTATION, VELOCITY)
    )
    if speed <= tuning.BLUR_SPEED**2:
        return None
    blur = np.zeros_like(added)
    blur[ROTATION, ROTATION] = tuning.BLUR_SHARE * max(turn, 0.0) * np.eye(3)
    blur[VELOCITY, VELOCITY] = tuning.BLUR_SHARE * speed * np.eye(3)
    return blur


class DeadReckoning:
    """The latest estimate, and the IMU samples since.

    Parameters
    ----------
    T_cloud_imu : ndarray, shape (4, 4)
        IMU coordinates to cloud coordinates.
    gap_ns : int
        Beyond a gap so long between samples the rate is not known.

    Attributes
    ----------
    stamp : HostNs
        Instant of the latest pose.
    """

    def __init__(self, T_cloud_imu: F64, gap_ns: int) -> None:
        self._gap_ns = gap_ns
        self._period_s = tuning.IMU_PERIOD_S
        self._turn: F64 = T_cloud_imu[:3, :3].T
        self._lever: F64 = T_cloud_imu[:3, 3]
        self._anchor: OdometryEstimate | None = None
        self.stamp = HostNs(0)
        self._rotation: F64 = np.eye(3)  # cloud axes to map axes
        self._place: F64 = np.zeros(3)  # of the IMU, map axes
        self._velocity: F64 = np.zeros(3)  # of the IMU, map axes
        self._rate: F64 = np.zeros(3)  # cloud axes
        # integral of the rotation over time since the estimate [s]: what a rate adds to turns
        self._by_rate: F64 = np.zeros((3, 3))
        self._of_map: F64 = np.zeros((6, 6))  # what the map added to the estimate's covariance
        self._sample: tuple[HostNs, F64] | None = None  # that the state belongs to

    def reset(self, estimate: OdometryEstimate | None) -> None:
        """Go on from an estimate at the newest sample, or from none."""
        self._anchor = estimate
        if estimate is None:
            return
        if self._sample is not None and self._sample[0] != estimate.stamp:
            self._sample = None
        self.stamp = estimate.stamp
        self._rotation = estimate.T_map_lidar[:3, :3]
        self._place = estimate.T_map_lidar[:3, 3] + self._rotation @ self._lever
        self._of_map = estimate.map_covariance(self._place)
        swing = rotations.cross(estimate.angular_velocity, self._lever)
        self._velocity = self._rotation @ (estimate.velocity + swing)
        self._rate = estimate.angular_velocity
        self._by_rate = np.zeros((3, 3))

    def carry(self, samples: Samples) -> F64 | None:
        """Return the pose of the cloud frame in the map, (4, 4), at the last of some samples.

        Parameters
        ----------
        samples : ndarray, shape (N,), dtype IMU_SAMPLE
            In the order in which they came. Those that are not finite or not later than the one
            before are left out.

        Returns
        -------
        ndarray or None
            None without an estimate to begin with, after a gap between samples, and
            :data:`LONGEST_NS` after the latest sweep.
        """
        stamps, measured = self._usable(samples)
        if not stamps:
            return None
        before, self._sample = self._sample, (stamps[-1], measured[-1])
        anchor = self._anchor
        if anchor is None:
            return None
        if before is None or before[0] != self.stamp:
            before = (self.stamp, measured[0])
        at = (before[0], *stamps)
        steps = [later - earlier for earlier, later in pairwise(at)]
        if stamps[-1] - anchor.stamp > LONGEST_NS or max(steps) > self._gap_ns:
            self._anchor = None
            return None
        self._period_s = float(np.median(steps)) * 1e-9
        knots = np.vstack((before[1], measured))
        if anchor.gyro_line is not None:
            knots[:, :3] -= anchor.gyro_line.at(np.array(at))
        # the mean over time of what is linear between the samples
        mean = np.array(steps) / sum(steps) @ (0.5 * (knots[1:] + knots[:-1]))
        rate, force = mean[:3] - anchor.gyro_bias, mean[3:] - anchor.accel_bias
        self._move(stamps[-1], rate, force, anchor.gravity)
        return self._pose()

    @property
    def estimate(self) -> OdometryEstimate:
        """The estimate at the last sample that was carried to, without points.

        Raises
        ------
        ValueError
            If there is none to carry on from.
        """
        if self._anchor is None:
            raise ValueError("no estimate to carry on from")
        rotation, seconds = self._rotation, (self.stamp - self._anchor.stamp) * 1e-9
        turned = rotation.T @ self._anchor.T_map_lidar[:3, :3]  # cloud axes then to those now
        twist = np.kron(np.eye(2), turned)
        of_bias = self._anchor.gyro_bias_covariance.copy()
        of_bias[3:6] -= self._by_rate @ of_bias[6:]
        # the map errs the more, the farther away from where it was begun
        more = self._anchor.map_covariance(self._place) - self._of_map
        return dataclasses.replace(
            self._anchor,
            stamp=self.stamp,
            T_map_lidar=self._pose(),
            covariance=more
            + _grown(self._anchor, rotation, self._rate, self._by_rate, seconds, self._period_s),
            velocity=rotation.T @ self._velocity - rotations.cross(self._rate, self._lever),
            angular_velocity=self._rate,
            twist_covariance=twist @ self._anchor.twist_covariance @ twist.T,
            stamp_velocity_error=turned @ self._anchor.stamp_velocity_error,
            gyro_bias_covariance=of_bias,
        )

    def _pose(self) -> F64:
        pose = np.eye(4)
        pose[:3, :3] = self._rotation
        pose[:3, 3] = self._place - self._rotation @ self._lever
        return pose

    def _usable(self, samples: Samples) -> tuple[list[HostNs], F64]:
        """Return stamps and, in cloud axes, rates and forces (N, 6) of samples that are sound."""
        measured = np.hstack((samples["angular_velocity"], samples["linear_acceleration"]))
        stamps = samples["stamp"].tolist()
        newest = self._sample[0] if self._sample is not None else np.iinfo(np.int64).min
        if self._anchor is not None:
            newest = max(newest, self.stamp)
        is_ordered = all(earlier < later for earlier, later in pairwise((newest, *stamps)))
        if not (is_ordered and np.isfinite(measured).all()):
            kept = []
            for number, is_finite in enumerate(np.isfinite(measured).all(axis=1).tolist()):
                if is_finite and stamps[number] > newest:
                    newest = stamps[number]
                    kept.append(number)
            stamps, measured = [stamps[number] for number in kept], measured[kept]
        return stamps, (measured.reshape(-1, 2, 3) @ self._turn).reshape(-1, 6)

    def _move(self, stamp: HostNs, rate: F64, force: F64, gravity: F64) -> None:
        """Carry the state on by a step with its mean rate and force [rad/s, m/s^2]."""
        dt = (stamp - self.stamp) * 1e-9
        half = rotations.matrix_exp(0.5 * dt * rate)
        middle = self._rotation @ half
        # Without trusted gravity the force says nothing, and the speed is held.
        acceleration = middle @ force + gravity if gravity.any() else np.zeros(3)
        self._place = self._place + dt * self._velocity + 0.5 * dt * dt * acceleration
        self._velocity = self._velocity + dt * acceleration
        self._rotation = middle @ half
        self._by_rate = self._by_rate + dt * middle
        self.stamp, self._rate = stamp, rate


def _grown(
    anchor: OdometryEstimate,
    rotation: F64,
    rate: F64,
    by_rate: F64,
    seconds: float,
    period_s: float,
) -> F64:
    """Return the covariance (6, 6) of a pose so long after an estimate.

    How far the errors of place and speed go together is not known here, so the bound for any
    correlation counts: (1 + a) P + (1 + 1/a) Q with the ratio a of the two (covariance
    intersection; Julier and Uhlmann 1997). The error of the gyro bias stays the same, so turns by
    it grow with the time and their variance with its square, and goes together with that of the
    attitude as the filter knows. The other errors of the rate are those of single samples, white,
    and a share of the rate itself, as in the filter; their variance grows with the time. It is as
    much less than assumed as the innovations show of all else.

    Parameters
    ----------
    anchor : OdometryEstimate
    rotation : ndarray, shape (3, 3)
        Cloud axes to map axes now.
    rate : ndarray, shape (3,)
        Now, cloud axes [rad/s].
    by_rate : ndarray, shape (3, 3)
        Derivatives of turns about the map's axes by a constant rate about the cloud's [s].
    seconds : float
        Since the estimate.
    period_s : float
        Of the IMU's samples.
    """
    found = anchor.covariance.copy()
    place = found[:3, :3]
    lasting = anchor.twist_covariance[:3, :3] - np.outer(
        anchor.stamp_velocity_error, anchor.stamp_velocity_error
    )
    then = anchor.T_map_lidar[:3, :3]
    speed = then @ lasting @ then.T * seconds**2
    ratio = np.sqrt(max(float(np.trace(speed)), 0.0) / max(float(np.trace(place)), 1e-12))
    if ratio > 0.0:
        found[:3, :3] = (1.0 + ratio) * place + (1.0 + 1.0 / ratio) * speed
    with_bias, bias = anchor.gyro_bias_covariance[:6], anchor.gyro_bias_covariance[6:]
    by_bias = np.vstack((np.zeros((3, 3)), -by_rate))  # one that is too large turns too little
    together = with_bias @ by_bias.T
    found += by_bias @ bias @ by_bias.T + together + together.T
    samples = anchor.twist_covariance[3:, 3:] - bias
    white = period_s * rotation @ samples @ rotation.T
    share = tuning.GYRO_SHARE * float(np.abs(rate).max())
    grown = (white + share**2 * np.eye(3)) * seconds
    found[3:, 3:] += anchor.quality.variance_factor * grown
    return found
