"""Prediction: carries the filter along the IMU samples that have come."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import GYRO_BIAS, VELOCITY, InertialState, Noise
from l2lidar_proc.motion.imu_buffer import ImuBuffer, Samples
from l2lidar_proc.motion.static import white_noise
from l2lidar_proc.motion.sweep_motion import SweepMotion, predict_sweep
from l2lidar_proc.motion.tracker import turned
from l2lidar_proc.odometry.config import OdometryConfig

F64 = NDArray[np.float64]


class Predictor:
    """Holds the latest IMU samples and carries states along them.

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
    excess : float
        By how much larger the variances of the IMU's noise are than they look.
    """

    def __init__(self, config: OdometryConfig, T_cloud_imu: F64) -> None:
        self.config = config
        self._turn: F64 = T_cloud_imu[:3, :3]
        self._imu = ImuBuffer(tuning.ODOMETRY_MEMORY_S)
        self.reset()

    def reset(self) -> None:
        """Forget what was found out about the motion; the samples stay."""
        self.trusts_gravity = False
        self.steady_rate: F64 = np.zeros(3)
        self.excess = 1.0

    def imu(self, samples: Samples) -> None:
        """Take IMU samples (N,), dtype IMU_SAMPLE, in any order and state."""
        self._imu.push(turned(samples, self._turn))

    def samples(self, start: int, end: int) -> Samples:
        """Return the samples of a span with a neighbor on either side, cloud axes."""
        return self._imu.between(HostNs(start), HostNs(end))

    def reference(self, sweep: Sweep) -> HostNs:
        """Return the instant of a sweep whose pose is estimated."""
        if self.config.reference == "start":
            return sweep.start
        if self.config.reference == "end":
            return sweep.end
        return HostNs((sweep.start + sweep.end) // 2)

    def over_sweep(
        self, sweep: Sweep, state: InertialState, covariance: F64, since: HostNs | None = None
    ) -> SweepMotion:
        """Return the motion of a sweep that follows from an earlier state, as :meth:`over`."""
        span = (sweep.start if since is None else since, sweep.end)
        return self.over(state, covariance, span, self.reference(sweep))

    def over(
        self, state: InertialState, covariance: F64, span: tuple[HostNs, HostNs], reference: HostNs
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
        """
        until = max(span[1], reference)
        samples = self.samples(min(span[0], state.stamp), until)
        inside = (samples["stamp"] >= state.stamp) & (samples["stamp"] <= until)
        if not inside.any():
            # the bias stands for the change of the rate: the sweep itself will show it
            covariance = eskf.decorrelated(covariance, GYRO_BIAS, tuning.STEADY_RATE_SIGMA)
        gap = reference - state.stamp
        if gap > tuning.LONG_GAP_NS and len(samples) * tuning.IMU_PERIOD_S * 1e9 < 0.5 * gap:
            speed = float(np.linalg.norm(state.velocity))
            covariance = eskf.decorrelated(covariance, VELOCITY, max(1.0, speed))
            state = dataclasses.replace(state, velocity=np.zeros(3))
        return predict_sweep(
            state,
            covariance,
            samples,
            span,
            reference,
            noise=self._noise(samples),
            gap_ns=round(self.config.inertial.imu_gap_ms * 1e6),
            steady_rate=self.steady_rate + state.gyro_bias,
            use_forces=self._use_forces,
        )

    def static_update(
        self, state: InertialState, covariance: F64, until: HostNs
    ) -> tuple[InertialState, F64]:
        """Return state and covariance of a sensor at rest since, up to an instant."""
        samples = self.samples(state.stamp, until)
        noise = self._noise(samples)
        return eskf.update_static(state, covariance, samples, noise, self._use_forces)

    @property
    def _use_forces(self) -> bool:
        return self.trusts_gravity and self.config.inertial.use_accelerometer

    def _noise(self, samples: Samples) -> Noise:
        """Return the noise of samples: the parameter, or more where more shows."""
        settings = self.config.inertial
        scale = float(np.sqrt(tuning.IMU_PERIOD_S * self.excess))
        return Noise(
            max(settings.gyro_noise, white_noise(samples["angular_velocity"])) * scale,
            max(settings.accel_noise, white_noise(samples["linear_acceleration"])) * scale,
            settings.gyro_bias_walk,
            settings.accel_bias_walk,
        )
