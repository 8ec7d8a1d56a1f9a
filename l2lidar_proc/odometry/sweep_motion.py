"""Holds the motion during one sweep, as IMU and filter see it, and deskews along it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs, Sweep
from l2lidar_proc import rotations
from l2lidar_proc.deskew.deskew import deskew
from l2lidar_proc.motion import preintegration
from l2lidar_proc.motion.filter import InertialState, Noise, predicted
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.motion.preintegration import Increments, Track
from l2lidar_proc.motion.sweep_trajectory import Path

F64 = NDArray[np.float64]

_SMOOTHING_NS = 20_000_000  # around the reference, over which the reported rate is averaged


@dataclass(frozen=True, slots=True, eq=False)
class SweepMotion:
    """The motion around the reference of a sweep.

    Attributes
    ----------
    felt : Track
        Covers the sweep and the time since the previous reference.
    seen : Increments
        Of the track, seen from the reference.
    state : InertialState
        At the reference.
    covariance : ndarray, shape (18, 18)
    uses_forces : bool
        Whether the accelerometer has a say.
    """

    felt: Track
    seen: Increments
    state: InertialState
    covariance: F64
    uses_forces: bool

    @property
    def rate(self) -> F64:
        """Angular velocity about the reference without bias [rad/s], shape (3,)."""
        near = np.abs(self.seen.stamps - self.state.stamp) <= _SMOOTHING_NS
        return np.asarray(self.seen.rates[near].mean(axis=0))

    def corrected(self, state: InertialState, covariance: F64) -> SweepMotion:
        """Return the motion through another state at the reference."""
        seen = preintegration.integrate(
            self.felt,
            self.seen.anchor,
            state.gyro_bias,
            state.accel_bias,
            at_rest(state),
            self.uses_forces,
        )
        return dataclasses.replace(self, seen=seen, state=state, covariance=covariance)

    def at_rest(self, state: InertialState, covariance: F64) -> SweepMotion:
        """Return the motion of a sensor that stands still instead, whatever the IMU felt.

        Parameters
        ----------
        state : InertialState
            Of any time; its velocity does not count.
        covariance : ndarray, shape (18, 18)
        """
        state = dataclasses.replace(state, stamp=self.state.stamp, velocity=np.zeros(3))
        nothing = np.zeros_like(self.felt.rates)
        forces = nothing + state.accel_bias + at_rest(state)
        felt = dataclasses.replace(self.felt, rates=nothing + state.gyro_bias, forces=forces)
        return dataclasses.replace(self, felt=felt).corrected(state, covariance)

    def state_at(self, stamp: HostNs) -> InertialState:
        """Return the state at the track's knot nearest after an instant."""
        return self.state.at(self.seen, self.felt.knot(stamp))

    def seen_from(self, stamp: HostNs) -> SweepMotion:
        """Return the same motion, its reference at the track's knot nearest after an instant."""
        knot = self.felt.knot(stamp)
        state = self.state.at(self.seen, knot)
        return dataclasses.replace(self, seen=self.seen.seen_from(knot), state=state)

    def deskewed(self, sweep: Sweep, lever: F64) -> NDArray[np.void]:
        """Return the sweep's points as seen from the reference.

        Parameters
        ----------
        sweep : Sweep
        lever : ndarray, shape (3,)
            Place of the IMU in the cloud frame [m].
        """
        state, seen = self.state, self.seen
        dt = ((seen.stamps - state.stamp) * 1e-9)[:, None]
        travelled = (dt * state.velocity + 0.5 * dt * dt * state.gravity) @ state.rotation
        arms = lever - rotations.rotate(seen.rotations_wxyz, lever)
        positions = travelled + seen.positions + arms
        path = Path(seen.stamps, seen.rotations_wxyz, positions, seen.rates)
        return deskew(sweep.points, sweep.start, path, state.stamp)


def predict(
    state: InertialState,
    covariance: F64,
    samples: Samples,
    span: tuple[HostNs, HostNs],
    reference: HostNs,
    *,
    noise: Noise,
    gap_ns: int,
    steady_rate: F64,
    uses_forces: bool,
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
        A longer stretch without sample is a gap.
    steady_rate : ndarray, shape (3,)
        Rate in gaps [rad/s], gyro bias included.
    uses_forces : bool
    """
    start, end = span
    last = HostNs(max(end, reference, min(start, state.stamp) + 1))
    felt = preintegration.track(
        samples, [state.stamp, reference, start, last], gap_ns, steady_rate
    )
    seen = preintegration.integrate(
        felt,
        felt.knot(state.stamp),
        state.gyro_bias,
        state.accel_bias,
        at_rest(state),
        uses_forces,
    )
    knot = felt.knot(reference)
    state, covariance = predicted(state, covariance, felt, seen, knot, noise, not uses_forces)
    return SweepMotion(felt, seen.seen_from(knot), state, covariance, uses_forces)


def at_rest(state: InertialState) -> F64:
    """Return the specific force of a sensor at rest in a state's attitude [m/s^2], shape (3,)."""
    return np.asarray(-state.rotation.T @ state.gravity)
