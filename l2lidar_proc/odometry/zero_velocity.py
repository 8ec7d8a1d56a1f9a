"""Keeps a sensor that stands still where it is, until IMU or clouds tell that it moves.

The clouds of a still sensor do not agree to the last millimetre: what the head's angle or the
unit's calibration is off by is common to half a turn, and each turn samples other lines. Odometry
that follows every sweep wanders with that, and its map with it. So rest is a hypothesis with a
pose, the anchor. As long as it stands, sweeps are not deskewed, the map is extended at the anchor,
and the IMU measures its own biases. The registration of each sweep is a test of it: how far the
last ones deviate from the anchor *together*, against how much they differ from one to the next.
Noise averages out, slow motion adds up.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc.motion.filter import (
    ACCEL_BIAS,
    ERRORS,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    TURN,
    VELOCITY,
    InertialState,
    Noise,
    corrected,
)
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.motion.static import Rest, at_rest, still_like
from l2lidar_proc.odometry.alignment import WEAK, Alignment
from l2lidar_proc.odometry.estimate import weakest

F64 = NDArray[np.float64]

_POSE: Final = slice(TURN.start, POSITION.stop)

PATIENCE_NS: Final = 2_000_000_000  # so long it has to look like rest; twice, where it was none
_PATIENCE_MOST_NS: Final = 64_000_000_000
_NEAR: Final = (0.005, 0.02)  # [rad, m] within which poses have to stay meanwhile
_SLOW: Final = 0.03  # [m/s]
_KNOWN: Final = 0.05  # [m/s] uncertainty of a velocity that may be called zero
_BIAS_MARGIN: Final = 0.02  # [rad/s] by which the gyro's mean may differ from the known bias
_ZERO: Final = 0.003  # [m/s] what a velocity of zero is worth

_REACH: Final = (0.02, 0.05)  # [rad, m] how far a sweep may deviate, a priori
_LEAST: Final = (1e-4, 5e-4)  # [rad, m] deviations that never count
_FAR: Final = (0.035, 0.1)  # [rad, m] and how far it may ever
_TURN_NS: Final = 200_000_000  # the fastest head's turn is not shorter, but for jitter
_COMPARED: Final = 40  # sweeps whose deviations are compared,
_TESTED: Final = 12  # of these up to so many of the latest with all before
_SURPRISE: Final = 160.0  # square of a drift in sigmas, six of them, that is no chance
_DRIFTED_S: Final = 0.5  # how quickly a drift may have come about


class Standstill:
    """The hypothesis that the sensor stands still, and what speaks for and against it.

    Attributes
    ----------
    anchor : InertialState or None
        Where it stands; None while it moves.
    """

    def __init__(self) -> None:
        self.anchor: InertialState | None = None
        self._turned = 0  # the instant of the last sweep of a turn
        self.clear()

    def clear(self) -> None:
        """Know nothing: the sensor may move."""
        self._drift: F64 = np.zeros(6)
        self._patience_ns = PATIENCE_NS
        self._recent: deque[InertialState] = deque()
        self._rest: Rest | None = None
        self._release()

    @property
    def drifted(self) -> bool:
        """Whether the last anchor was given up since sweeps deviated from it."""
        return bool(self._drift.any())

    def anchored(self, state: InertialState, samples: Samples) -> bool:
        """Begin with the hypothesis at a state; return whether the IMU allows it.

        Parameters
        ----------
        state : InertialState
        samples : ndarray, shape (N,), dtype IMU_SAMPLE
            Of the last moments, cloud axes; may be empty.
        """
        self._release()
        self._rest = at_rest(samples, state.gyro_bias, _BIAS_MARGIN)
        if self._rest is not None or not len(samples):
            self.anchor = dataclasses.replace(state, velocity=np.zeros(3))
            self._turned = state.stamp
        return self.anchor is not None

    def watch(self, state: InertialState, covariance: F64, samples: Samples) -> bool:
        """Look at a state in motion; return whether it turned out to be at rest, anchored now.

        Parameters
        ----------
        state : InertialState
        covariance : ndarray, shape (18, 18)
        samples : ndarray, shape (N,), dtype IMU_SAMPLE
            Of the last :data:`PATIENCE_NS`.
        """
        recent = self._recent
        recent.append(state)
        since = state.stamp - self._patience_ns
        while len(recent) > 1 and recent[1].stamp <= since:
            recent.popleft()
        known = np.linalg.eigvalsh(covariance[VELOCITY, VELOCITY])[-1] < _KNOWN**2
        if recent[0].stamp > since or not known or np.linalg.norm(state.velocity) > _SLOW:
            return False
        way = np.array([state.minus(other)[_POSE] for other in recent])
        if not (np.abs(way) < _both(*_NEAR)).all():
            return False
        return self.anchored(state, samples)

    def holds(self, samples: Samples) -> bool:
        """Return whether there is an anchor and the IMU does not object; if it does, let go.

        Parameters
        ----------
        samples : ndarray, shape (N,), dtype IMU_SAMPLE
            Of the sweep, a quarter of a second or more; may be empty.
        """
        if self.anchor is None:
            return False
        if not len(samples) or (self._rest is not None and still_like(samples, self._rest)):
            return True
        self.clear()
        return False

    def stays(self, found: Alignment) -> bool:
        """Return whether the hypothesis stands the test of a sweep; if not, let go.

        Parameters
        ----------
        found : Alignment
            Of a sweep as it was seen from the anchor, begun with :func:`free_to_differ`.
        """
        assert self.anchor is not None
        deviation = found.state.minus(self.anchor)[_POSE]
        if weakest(found.information[POSITION, POSITION]) < WEAK:
            # along a bare corridor rest looks like motion
            self.clear()
            return False
        if (np.abs(deviation) > _both(*_FAR)).any():
            self._drift = deviation
            self._doubt()
            return False
        # parts of a turn see, and err, each in their own way: only whole turns are compared
        self._turn.append(deviation)
        if found.state.stamp - self._turned < _TURN_NS:
            return True
        self._turned = found.state.stamp
        self._deviations.append(np.mean(self._turn, axis=0))
        self._turn.clear()
        values = np.array(self._deviations)
        # in second differences steady motion does not show, and noise has six times its variance
        bends = np.diff(values, 2, axis=0)
        scatter = found.covariance[_POSE, _POSE] + bends.T @ bends / 6.0
        scatter = scatter / (1.0 + len(bends)) + np.diag(_both(*_LEAST) ** 2)
        # whatever time it began to move: the mean of the latest against that of those before
        newer = np.arange(1, min(_TESTED, len(values) - 1) + 1)
        total = np.cumsum(values[::-1], axis=0)
        older = len(values) - newer
        drifts = (
            total[newer - 1] / newer[:, None] - (total[-1] - total[newer - 1]) / older[:, None]
        )
        surprise = np.einsum("ni,ij,nj->n", drifts, np.linalg.inv(scatter), drifts)
        surprise /= 1.0 / newer + 1.0 / older
        worst = int(surprise.argmax())
        if surprise[worst] < _SURPRISE:
            return True
        self._drift = drifts[worst]
        self._doubt()
        return False

    def loosened(self, covariance: F64) -> F64:
        """Return a covariance (18, 18) that allows for what went unnoticed before the release."""
        out = covariance.copy()
        out[_POSE, _POSE] += np.outer(self._drift, self._drift)
        turned, moved = self._drift[:3] @ self._drift[:3], self._drift[3:] @ self._drift[3:]
        out[VELOCITY, VELOCITY] += moved / _DRIFTED_S**2 * np.eye(3)
        out[GYRO_BIAS, GYRO_BIAS] += turned / _DRIFTED_S**2 * np.eye(3)
        return out

    def _doubt(self) -> None:
        self._patience_ns = min(2 * self._patience_ns, _PATIENCE_MOST_NS)
        self._recent.clear()
        self._release()

    def _release(self) -> None:
        self.anchor = None
        self._turned = 0
        self._turn: list[F64] = []
        # the first sweep at the anchor made the map
        self._deviations: deque[F64] = deque([np.zeros(6)], maxlen=_COMPARED)


def free_to_differ() -> F64:
    """Return the covariance (18, 18) of an anchor under test: nothing but its pose may differ."""
    covariance = 1e-12 * np.eye(ERRORS)
    covariance[_POSE, _POSE] = np.diag(_both(*_REACH) ** 2)
    return covariance


def rested(
    state: InertialState, covariance: F64, samples: Samples, noise: Noise, uses_forces: bool
) -> tuple[InertialState, F64]:
    """Return state and covariance after samples at rest, which measure biases and gravity.

    Parameters
    ----------
    state : InertialState
        Its pose and velocity stay.
    covariance : ndarray, shape (18, 18)
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        Since this was done last.
    noise : Noise
    uses_forces : bool
    """
    if len(samples) < 2:
        return state, covariance
    seconds = float(samples["stamp"][-1] - samples["stamp"][0]) * 1e-9
    covariance = covariance.copy()
    covariance[GYRO_BIAS, GYRO_BIAS] += noise.gyro_walk**2 * seconds * np.eye(3)
    covariance[ACCEL_BIAS, ACCEL_BIAS] += noise.accel_walk**2 * seconds * np.eye(3)
    observed = np.zeros((9, ERRORS))
    observed[:3, GYRO_BIAS] = np.eye(3)
    observed[3:6, VELOCITY] = np.eye(3)
    worth = np.repeat((seconds / noise.gyro**2, 1.0 / _ZERO**2, 0.0), 3)
    off = np.zeros(9)
    off[:3] = samples["angular_velocity"].mean(axis=0) - state.gyro_bias
    off[3:6] = -state.velocity
    if uses_forces:
        observed[6:, ACCEL_BIAS] = np.eye(3)
        observed[6:, GRAVITY] = -state.rotation.T
        worth[6:] = seconds / noise.accel**2
        force = samples["linear_acceleration"].mean(axis=0)
        off[6:] = force - state.accel_bias + state.rotation.T @ state.gravity
    weighted = observed.T * worth
    better, covariance = corrected(state, covariance, state, weighted @ observed, weighted @ off)
    return (
        dataclasses.replace(
            state,
            velocity=np.zeros(3),
            gyro_bias=better.gyro_bias,
            accel_bias=better.accel_bias,
            gravity=better.gravity,
        ),
        covariance,
    )


def _both(turn: float, way: float) -> F64:
    return np.repeat((turn, way), 3)
