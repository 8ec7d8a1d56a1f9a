"""Motion of a sweep: poses at knots of time, filter state and IMU samples.

A trajectory is continuous between its knots: poses of the cloud frame within the sweep.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState, Noise
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.motion.preintegration import ImuSegment, Preintegration, integrate, segment


@dataclass(frozen=True, slots=True, eq=False)
class SweepTrajectory:
    """Poses of the cloud frame at knots, all in one frame.

    Attributes
    ----------
    stamps : ndarray, shape (K,), int64
        Knots [ns], strictly ascending, K >= 2.
    rotations_wxyz : ndarray, shape (K, 4)
        Cloud axes at the knot to the axes of that frame.
    positions : ndarray, shape (K, 3)
        Origin at the knot [m].
    rates : ndarray, shape (K, 3)
        Angular velocity without bias [rad/s], cloud axes; linear in time between knots.
    """

    stamps: NDArray[np.int64]
    rotations_wxyz: F64
    positions: F64
    rates: F64

    @classmethod
    def of(
        cls, preintegrated: Preintegration, state: InertialState, lever: F64
    ) -> SweepTrajectory:
        """Return the trajectory of the cloud frame, seen from it at a state's instant.

        Parameters
        ----------
        preintegrated : Preintegration
            Anchored at the state.
        state : InertialState
        lever : ndarray, shape (3,)
            Place of the IMU in the cloud frame [m], whose axes are the sensor's.
        """
        dt = ((preintegrated.stamps - preintegrated.stamps[preintegrated.anchor]) * 1e-9)[:, None]
        traveled = (dt * state.velocity + 0.5 * dt * dt * state.gravity) @ state.rotation
        q = preintegrated.rotations_wxyz
        arms = lever - rotations.rotate(q, lever)
        positions = traveled + preintegrated.positions + arms
        return cls(preintegrated.stamps, q, positions, preintegrated.rates)

    @property
    def is_still(self) -> bool:
        """Whether nothing moves at all."""
        return not (self.rates.any() or self.positions.any())

    def pose(self, stamp: HostNs) -> tuple[F64, F64]:
        """Return rotation (w, x, y, z), shape (4,), and position [m], shape (3,), at an instant.

        Instants outside the knots take the pose of the nearer end.
        """
        rotations_wxyz, positions = self.poses(np.array([stamp]))
        return rotations_wxyz[0], positions[0]

    def poses(self, stamps: NDArray[np.int64]) -> tuple[F64, F64]:
        """Return rotations (w, x, y, z), (N, 4), and positions [m], (N, 3), at instants."""
        stamps = np.clip(stamps, self.stamps[0], self.stamps[-1])
        knot = np.clip(
            np.searchsorted(self.stamps, stamps, side="right") - 1, 0, len(self.stamps) - 2
        )
        dt = ((stamps - self.stamps[knot]) * 1e-9)[:, None]
        whole = ((self.stamps[knot + 1] - self.stamps[knot]) * 1e-9)[:, None]
        slope = (self.rates[knot + 1] - self.rates[knot]) / whole
        turn = rotations.exp(dt * (self.rates[knot] + 0.5 * dt * slope))
        step = (dt / whole) * (self.positions[knot + 1] - self.positions[knot])
        return rotations.multiply(self.rotations_wxyz[knot], turn), self.positions[knot] + step

    def between(self, start: HostNs, end: HostNs) -> tuple[F64, F64]:
        """Return rotation (4,) and translation [m] (3,) from the frame at ``end`` to ``start``."""
        (q, p), (q_end, p_end) = self.pose(start), self.pose(end)
        back = rotations.conjugate(q)
        return rotations.multiply(back, q_end), rotations.rotate(back, p_end - p)

    def without_translation(self) -> SweepTrajectory:
        """Return the rotations alone."""
        nowhere = np.zeros_like(self.positions)
        return SweepTrajectory(self.stamps, self.rotations_wxyz, nowhere, self.rates)


def still_trajectory(start: HostNs, end: HostNs) -> SweepTrajectory:
    """Return the trajectory of a sensor that does not move."""
    stamps = np.array([start, max(end, start + 1)], dtype=np.int64)
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    return SweepTrajectory(stamps, identity, np.zeros((2, 3)), np.zeros((2, 3)))


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

    @property
    def acceleration(self) -> F64:
        """Acceleration about the reference without bias [m/s^2], shape (3,), cloud axes."""
        pre, state = self.preintegrated, self.state
        near = np.flatnonzero(np.abs(pre.stamps - state.stamp) <= tuning.RATE_SMOOTHING_NS)
        first, last = near[0], near[-1]
        lasted = float(pre.stamps[last] - pre.stamps[first]) * 1e-9
        if lasted == 0.0:
            return np.zeros(3)
        gained = (pre.velocities[last] - pre.velocities[first]) / lasted
        return np.asarray(gained + state.gravity @ state.rotation)

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
        """Return the motion of a sensor at rest, regardless of the IMU.

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
        state, covariance, imu, preintegrated, knot, noise, use_forces=use_forces
    )
    return SweepMotion(imu, preintegrated.anchored_at(knot), state, covariance, use_forces)
