"""Gravity for a map that began without it.

A map may begin before the first IMU samples come, and forces cannot be integrated without gravity.
Sweeps alone show the velocity, so a second of samples shows gravity: it is what the forces leave
unexplained of the change of the velocity.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import (
    ACCEL_BIAS,
    ERRORS,
    GRAVITY,
    VELOCITY,
    InertialState,
    decorrelated,
)
from l2lidar_proc.motion.preintegration import coverage, integrate, segment
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.prediction import Predictor


class LateGravity:
    """Looks for gravity in the forces of the latest second.

    Parameters
    ----------
    predictor : Predictor
        Trusts gravity as soon as it is found.
    """

    def __init__(self, predictor: Predictor) -> None:
        self._predictor = predictor
        self._passed: deque[tuple[InertialState, F64]] = deque()

    def clear(self) -> None:
        """Forget the velocities so far, as where the map's axes change."""
        self._passed.clear()

    def estimated(self, motion: SweepMotion) -> SweepMotion:
        """Return the motion of an aligned sweep, with gravity where the samples show it.

        It is the same where gravity is trusted already, where samples are missing, and where what
        is found does not have the size of gravity, as with a faulty accelerometer.
        """
        if self._predictor.trusts_gravity:
            return motion
        state, passed = motion.state, self._passed
        passed.append((state, motion.covariance[VELOCITY, VELOCITY]))
        while len(passed) > 1 and state.stamp - passed[1][0].stamp >= tuning.INITIAL_IMU_NS:
            passed.popleft()
        before, covariance = passed[0]
        seconds = 1e-9 * (state.stamp - before.stamp)
        if state.stamp - before.stamp < tuning.INITIAL_IMU_NS:
            return motion
        force = self._mean_force(before.stamp, state)
        if force is None:
            return motion
        gravity = (state.velocity - before.velocity) / seconds - force
        low, high = tuning.GRAVITY_AT_REST
        if not low < float(np.linalg.norm(gravity)) < high:
            return motion
        self._predictor.trusts_gravity = True
        self.clear()
        noise = (covariance + motion.covariance[VELOCITY, VELOCITY]) / seconds**2
        return motion.with_state(*with_gravity(state, motion.covariance, gravity, noise))

    def _mean_force(self, since: HostNs, state: InertialState) -> F64 | None:
        """Return the mean force until a state, (3,), map axes; None where samples are missing."""
        samples = self._predictor.samples(since, state.stamp)
        gap_ns = round(self._predictor.config.inertial.imu_gap_ms * 1e6)
        share, longest_ns = coverage(samples["stamp"], since, state.stamp)
        if share < 1.0 or longest_ns > gap_ns:
            return None
        imu = segment(samples, [since, state.stamp], gap_ns, np.zeros(3))
        sums = integrate(
            imu,
            len(imu.stamps) - 1,
            gyro_bias=state.gyro_bias,
            accel_bias=state.accel_bias,
            rest_force=np.zeros(3),
        )
        gained = -sums.velocities[0] @ state.rotation.T
        return np.asarray(gained / (1e-9 * (state.stamp - since)))


def with_gravity(
    state: InertialState, covariance: F64, gravity: F64, noise: F64
) -> tuple[InertialState, F64]:
    """Return a state that had no gravity, and its covariance, with one that was measured.

    Bias and tilt are not separable: the bias of the accelerometer is in what was measured.

    Parameters
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    gravity : ndarray, shape (3,)
        Map axes [m/s^2].
    noise : ndarray, shape (3, 3)
        Covariance of the measurement.
    """
    covariance = decorrelated(decorrelated(covariance, GRAVITY, 0.0), ACCEL_BIAS, 0.0)
    both = np.zeros((ERRORS, 3))
    both[GRAVITY] = np.eye(3)
    both[ACCEL_BIAS] = state.rotation.T
    covariance += tuning.ACCEL_BIAS_SIGMA**2 * both @ both.T
    covariance[GRAVITY, GRAVITY] += noise
    error = np.zeros(ERRORS)
    error[GRAVITY] = gravity - state.gravity
    return state.boxplus(error), covariance
