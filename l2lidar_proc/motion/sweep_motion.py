"""Sweep motion: the filter's state at a sweep's reference and the samples around it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState, Noise
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.motion.preintegration import ImuSegment, Preintegration, integrate, segment
from l2lidar_proc.motion.sweep_trajectory import SweepTrajectory

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SweepMotion:
    """The motion around the reference of a sweep.

    Attributes
    ----------
    imu : ImuSegment
        Covers the sweep and the time since the previous reference.
    preintegrated : Preintegration
        Of the segment, anchored at the reference.
    state : InertialState
        At the reference.
    covariance : ndarray, shape (18, 18)
    use_forces : bool
        Whether the accelerometer is used.
    """

    imu: ImuSegment
    preintegrated: Preintegration
    state: InertialState
    covariance: F64
    use_forces: bool

    @property
    def rate(self) -> F64:
        """Angular velocity about the reference without bias [rad/s], shape (3,)."""
        near = np.abs(self.preintegrated.stamps - self.state.stamp) <= tuning.RATE_SMOOTHING_NS
        return np.asarray(self.preintegrated.rates[near].mean(axis=0))

    def with_state(self, state: InertialState, covariance: F64) -> SweepMotion:
        """Return the motion through another state at the reference."""
        preintegrated = integrate(
            self.imu,
            self.preintegrated.anchor,
            gyro_bias=state.gyro_bias,
            accel_bias=state.accel_bias,
            rest_force=state.rest_force,
            use_forces=self.use_forces,
        )
        return dataclasses.replace(
            self, preintegrated=preintegrated, state=state, covariance=covariance
        )

    def at_rest(self, state: InertialState, covariance: F64) -> SweepMotion:
        """Return the motion of a sensor that stands still instead, whatever the IMU measured.

        Parameters
        ----------
        state : InertialState
            Of any time; its velocity does not count.
        covariance : ndarray, shape (18, 18)
        """
        state = dataclasses.replace(state, stamp=self.state.stamp, velocity=np.zeros(3))
        nothing = np.zeros_like(self.imu.rates)
        forces = nothing + state.accel_bias + state.rest_force
        imu = dataclasses.replace(self.imu, rates=nothing + state.gyro_bias, forces=forces)
        return dataclasses.replace(self, imu=imu).with_state(state, covariance)

    def state_at(self, stamp: HostNs) -> InertialState:
        """Return the state at the knot nearest after an instant."""
        return self.state.at(self.preintegrated, self.imu.knot(stamp))

    def anchored_at(self, stamp: HostNs) -> SweepMotion:
        """Return the same motion with its reference at the knot nearest after an instant."""
        knot = self.imu.knot(stamp)
        state = self.state.at(self.preintegrated, knot)
        preintegrated = self.preintegrated.anchored_at(knot)
        return dataclasses.replace(self, preintegrated=preintegrated, state=state)

    def trajectory(self, lever: F64) -> SweepTrajectory:
        """Return the trajectory of the cloud frame, seen from it at the reference.

        Parameters
        ----------
        lever : ndarray, shape (3,)
            Place of the IMU in the cloud frame [m].
        """
        return SweepTrajectory.of(self.preintegrated, self.state, lever)


def predict_sweep(
    state: InertialState,
    covariance: F64,
    samples: Samples,
    span: tuple[HostNs, HostNs],
    reference: HostNs,
    *,
    noise: Noise,
    gap_ns: int,
    steady_rate: F64,
    use_forces: bool,
) -> SweepMotion:
    """Return the motion that the IMU predicts for a sweep.

    Parameters
    ----------
    state : InertialState
        Not later than the reference.
    covariance : ndarray, shape (18, 18)
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        From before state and span to after them, as far as there are; cloud axes.
    span : tuple of HostNs
        Start and end of the sweep.
    reference : HostNs
    noise : Noise
    gap_ns : int
        A longer stretch without a sample is a gap.
    steady_rate : ndarray, shape (3,)
        Rate where nothing is measured [rad/s], gyro bias included.
    use_forces : bool
    """
    start, end = span
    last = HostNs(max(end, reference, min(start, state.stamp) + 1))
    imu = segment(samples, [state.stamp, reference, start, last], gap_ns, steady_rate)
    preintegrated = integrate(
        imu,
        imu.knot(state.stamp),
        gyro_bias=state.gyro_bias,
        accel_bias=state.accel_bias,
        rest_force=state.rest_force,
        use_forces=use_forces,
    )
    knot = imu.knot(reference)
    state, covariance = eskf.predict(
        state, covariance, imu, preintegrated, knot, noise, not use_forces
    )
    return SweepMotion(imu, preintegrated.anchored_at(knot), state, covariance, use_forces)
