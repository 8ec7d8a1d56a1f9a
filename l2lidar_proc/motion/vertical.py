"""Estimates the vertical and the gyro's bias: an error-state Kalman filter (filterpy), six errors.

The first three errors are a small turn of the estimated vertical, the others the bias. The
vertical is carried along by the gyro; forces that are gravity alone, and rates that are bias
alone, correct both.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from filterpy.kalman import KalmanFilter

from l2lidar_proc import rotations
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.rotations import F64

_GYRO_NOISE: Final = 0.005  # [rad/sqrt(s)]
_BIAS_WALK: Final = 3e-4  # [rad/s/sqrt(s)]
_FIRST_TILT: Final = 0.3  # [rad]
_FIRST_BIAS: Final = 0.05  # [rad/s]


class VerticalFilter:
    """Vertical and bias in IMU axes.

    Attributes
    ----------
    up : ndarray, shape (3,), or None
        The vertical, unit; None until a force has been seen.
    bias : ndarray, shape (3,)
        [rad/s]
    """

    def __init__(self) -> None:
        self.up: F64 | None = None
        self.bias: F64 = np.zeros(3)
        self._kalman = KalmanFilter(dim_x=6, dim_z=3)
        self._kalman.P = np.diag([_FIRST_TILT**2] * 3 + [_FIRST_BIAS**2] * 3)

    @property
    def tilt_sigma(self) -> float:
        """Standard deviation of the vertical's direction [rad]."""
        if self.up is None:
            return _FIRST_TILT
        turn = self._kalman.P[:3, :3]
        across = np.trace(turn) - self.up @ turn @ self.up  # about itself it does not tilt
        return float(np.sqrt(max(across, 0.0)))

    @property
    def bias_sigma(self) -> float:
        """Standard deviation of the bias about the worst axis [rad/s]."""
        return float(np.sqrt(np.diag(self._kalman.P)[3:].max()))

    def begin(self, force: F64) -> None:
        """Take a force for the vertical, roughly; the bias stays as it is known."""
        size = float(np.linalg.norm(force))
        self.up = force / size if size > 1e-3 else np.array([0.0, 0.0, 1.0])
        covariance = self._kalman.P
        covariance[:3, :] = covariance[:, :3] = 0.0
        covariance[:3, :3] = np.eye(3) * _FIRST_TILT**2

    def turned_to_last(self, samples: Samples) -> F64:
        """Return the rotations from each sample's axes to the last one's, shape (N, 4)."""
        dt = np.diff(samples["stamp"])[:, None] * 1e-9
        rates = samples["angular_velocity"] - self.bias
        turns = rotations.exp(0.5 * dt * (rates[:-1] + rates[1:]))
        q = rotations.cumulative(np.concatenate((np.array([[1.0, 0.0, 0.0, 0.0]]), turns)))
        return rotations.multiply(rotations.conjugate(q[-1]), q)

    def predict(self, samples: Samples) -> None:
        """Go from the first of these samples, where the filter is, to the last."""
        to_last = self.turned_to_last(samples)[0]
        span = float(samples["stamp"][-1] - samples["stamp"][0]) * 1e-9
        transition = np.eye(6)
        transition[:3, :3] = rotations.matrices(to_last)
        transition[:3, 3:] = span * np.eye(3)
        growth = np.diag([_GYRO_NOISE**2 * span] * 3 + [_BIAS_WALK**2 * span] * 3)
        self._kalman.predict(F=transition, Q=growth)
        assert self.up is not None
        self.up = rotations.normalised(rotations.rotate(to_last, self.up))

    def measure_bias(self, rate: F64, variance: F64) -> None:
        """Correct with a rate [rad/s] that is bias alone, variance (3,) [(rad/s)^2]."""
        observed = np.hstack((np.zeros((3, 3)), np.eye(3)))
        self._correct(rate - self.bias, observed, np.diag(variance))

    def measure_force(self, force: F64, gravity: float, sigma: float) -> None:
        """Correct with a force [m/s^2] that is gravity of this size alone, but for ``sigma``."""
        assert self.up is not None
        x, y, z = gravity * self.up
        observed = np.zeros((3, 6))
        observed[:, :3] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        bias = self.bias
        self._correct(force - gravity * self.up, observed, sigma**2 * np.eye(3))
        # a force says nothing about turning around the vertical: what it changed there is error
        self.bias = self.bias - ((self.bias - bias) @ self.up) * self.up

    def _correct(self, innovation: F64, observed: F64, noise: F64) -> None:
        """Apply one measurement and fold the errors into vertical and bias."""
        self._kalman.x = np.zeros((6, 1))
        self._kalman.update(innovation[:, None], R=noise, H=observed)
        error = self._kalman.x[:, 0]
        self.bias = self.bias + error[3:]
        if self.up is not None:
            self.up = rotations.normalised(rotations.rotate(rotations.exp(error[:3]), self.up))
