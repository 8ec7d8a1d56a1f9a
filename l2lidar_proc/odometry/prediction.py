"""Predicts how the sensor moves during sweeps from the IMU samples that have come."""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs, Sweep
from l2lidar_proc.config import OdometryConfig
from l2lidar_proc.motion import initialization
from l2lidar_proc.motion.filter import GYRO_BIAS, VELOCITY, InertialState, Noise, loosened
from l2lidar_proc.motion.imu_buffer import ImuWindow, Samples
from l2lidar_proc.odometry import sweep_motion, zero_velocity
from l2lidar_proc.odometry.sweep_motion import SweepMotion

F64 = NDArray[np.float64]

LONG_GAP_NS: Final = 1_000_000_000  # after that much silence the old velocity says nothing
_WINDOW_S: Final = 12.0  # more than a held-up node has waiting
_PERIOD_S: Final = 0.004  # of the IMU, for which the noise settings are stated
_STEADY_SIGMA: Final = 0.5  # [rad/s] of the assumption that the rate stays, where there is no gyro


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
    steady : ndarray, shape (3,)
        Rate without bias where there is no gyro [rad/s], cloud axes.
    """

    def __init__(self, config: OdometryConfig, T_cloud_imu: F64) -> None:
        self.config = config
        self._turn: F64 = T_cloud_imu[:3, :3]
        self._imu = ImuWindow(_WINDOW_S)
        self.reset()

    def reset(self) -> None:
        """Forget what was found out about the motion; the samples stay."""
        self.trusts_gravity = False
        self.steady: F64 = np.zeros(3)

    def imu(self, samples: Samples) -> None:
        """Take IMU samples (N,), dtype IMU_SAMPLE, in any order and state."""
        if not np.array_equal(self._turn, np.eye(3)):
            samples = samples.copy()
            for name in ("angular_velocity", "linear_acceleration"):
                samples[name] = samples[name] @ self._turn.T
        self._imu.push(samples)

    def felt(self, start: int, end: int) -> Samples:
        """Return the samples of a span with a neighbour on either side, cloud axes."""
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
        samples = self.felt(min(span[0], state.stamp), max(span[1], reference))
        inside = (samples["stamp"] >= state.stamp) & (samples["stamp"] <= max(span[1], reference))
        if not inside.any():
            # the bias stands for what the rate has changed by: the sweep itself will tell
            covariance = loosened(covariance, GYRO_BIAS, _STEADY_SIGMA)
        gap = reference - state.stamp
        if gap > LONG_GAP_NS and len(samples) * _PERIOD_S * 1e9 < 0.5 * gap:
            speed = float(np.linalg.norm(state.velocity))
            covariance = loosened(covariance, VELOCITY, max(1.0, speed))
            state = dataclasses.replace(state, velocity=np.zeros(3))
        return sweep_motion.predict(
            state,
            covariance,
            samples,
            span,
            reference,
            noise=self._noise(samples),
            gap_ns=round(self.config.inertial.imu_gap_ms * 1e6),
            steady_rate=self.steady + state.gyro_bias,
            uses_forces=self._uses_forces,
        )

    def at_rest(
        self, state: InertialState, covariance: F64, until: HostNs
    ) -> tuple[InertialState, F64]:
        """Return state and covariance of a sensor that has stood still since, up to an instant."""
        samples = self.felt(state.stamp, until)
        noise = self._noise(samples)
        return zero_velocity.rested(state, covariance, samples, noise, self._uses_forces)

    @property
    def _uses_forces(self) -> bool:
        return self.trusts_gravity and self.config.inertial.use_accelerometer

    def _noise(self, samples: Samples) -> Noise:
        """Return the noise of samples: what is set, or more where more is seen."""
        settings = self.config.inertial
        scale = float(np.sqrt(_PERIOD_S))
        return Noise(
            max(settings.gyro_noise, initialization.white_noise(samples["angular_velocity"]))
            * scale,
            max(settings.accel_noise, initialization.white_noise(samples["linear_acceleration"]))
            * scale,
            settings.gyro_bias_walk,
            settings.accel_bias_walk,
        )
