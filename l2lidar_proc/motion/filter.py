"""Carries pose, velocity, IMU biases and gravity through time: an error-state Kalman filter.

The errors are ordered turn (3, sensor axes), position, velocity (map frame), gyro bias,
accelerometer bias (sensor axes) and gravity (map frame): 18 numbers. The map's frame is fixed by
the first pose, so gravity is estimated in it like a bias instead of being its axis (as Xu et al.
2022, FAST-LIO2).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import numpy as np
from filterpy.kalman import predict, update
from numpy.typing import NDArray

from l2lidar_node.types import HostNs
from l2lidar_proc import rotations
from l2lidar_proc.motion.preintegration import Increments, Track

F64 = NDArray[np.float64]

TURN: Final = slice(0, 3)
POSITION: Final = slice(3, 6)
VELOCITY: Final = slice(6, 9)
GYRO_BIAS: Final = slice(9, 12)
ACCEL_BIAS: Final = slice(12, 15)
GRAVITY: Final = slice(15, 18)
ERRORS: Final = 18

_STRIDES: Final = 6  # steps of the covariance per prediction; the mean takes every sample


@dataclass(frozen=True, slots=True, eq=False)
class InertialState:
    """Where the IMU is, how it moves and what is wrong with it.

    Attributes
    ----------
    stamp : HostNs
    rotation : ndarray, shape (3, 3)
        Sensor axes to map axes.
    position, velocity : ndarray, shape (3,)
        Of the IMU's origin in the map [m, m/s].
    gyro_bias, accel_bias : ndarray, shape (3,)
        Sensor axes [rad/s, m/s^2].
    gravity : ndarray, shape (3,)
        Acceleration of a falling body in the map [m/s^2].
    """

    stamp: HostNs
    rotation: F64
    position: F64
    velocity: F64
    gyro_bias: F64
    accel_bias: F64
    gravity: F64

    def moved(self, error: F64) -> InertialState:
        """Return the state that is off by an error, shape (18,)."""
        return InertialState(
            self.stamp,
            self.rotation @ rotations.matrices(rotations.exp(error[TURN])),
            self.position + error[POSITION],
            self.velocity + error[VELOCITY],
            self.gyro_bias + error[GYRO_BIAS],
            self.accel_bias + error[ACCEL_BIAS],
            self.gravity + error[GRAVITY],
        )

    def minus(self, other: InertialState) -> F64:
        """Return the error by which the other state is off this one, shape (18,)."""
        turn = rotations.log(rotations.from_matrix(other.rotation.T @ self.rotation))
        return np.concatenate(
            (
                turn,
                self.position - other.position,
                self.velocity - other.velocity,
                self.gyro_bias - other.gyro_bias,
                self.accel_bias - other.accel_bias,
                self.gravity - other.gravity,
            )
        )

    def at(self, seen: Increments, knot: int) -> InertialState:
        """Return the state at a knot; this one belongs to the anchor of the increments."""
        dt = float(seen.stamps[knot] - seen.stamps[seen.anchor]) * 1e-9
        return dataclasses.replace(
            self,
            stamp=HostNs(int(seen.stamps[knot])),
            rotation=self.rotation @ rotations.matrices(seen.rotations_wxyz[knot]),
            position=self.position
            + dt * self.velocity
            + 0.5 * dt * dt * self.gravity
            + self.rotation @ seen.positions[knot],
            velocity=self.velocity + dt * self.gravity + self.rotation @ seen.velocities[knot],
        )


@dataclass(frozen=True, slots=True)
class Noise:
    """How much a prediction is worth; densities of white noise, per axis.

    Attributes
    ----------
    gyro : float
        [rad/s/sqrt(Hz)]
    accel : float
        [m/s^2/sqrt(Hz)]
    gyro_walk : float
        [rad/s^2/sqrt(Hz)]
    accel_walk : float
        [m/s^3/sqrt(Hz)]
    """

    gyro: float
    accel: float
    gyro_walk: float
    accel_walk: float


# where nothing is measured a carrier may turn and speed up like this: per sqrt(Hz), as densities
BLIND_GYRO: Final = 0.5
BLIND_ACCEL: Final = 1.0
BLIND_TURN: Final = (
    0.6  # [sqrt(s)] and by this part of the rate that is held: what shakes turns back
)

# a velocity less certain than the first is drawn towards rest, as if that were measured with an
# error of the second once a second [m/s]
SLOW_FROM: Final = 0.2
SLOW_SPEED: Final = 1.0

_OWN_POSE: Final = 1e-3  # [m, rad] of the pose with which a new map begins


def predicted(
    state: InertialState,
    covariance: F64,
    felt: Track,
    seen: Increments,
    knot: int,
    noise: Noise,
    blind_forces: bool = False,
) -> tuple[InertialState, F64]:
    """Return state and covariance (18, 18) at a later knot.

    Parameters
    ----------
    state : InertialState
        At the anchor of ``seen``.
    covariance : ndarray, shape (18, 18)
    felt : Track
    seen : Increments
        Of the same track.
    knot : int
        Not before the anchor.
    noise : Noise
    blind_forces : bool
        The forces were not used.
    """
    edges = np.unique(np.linspace(seen.anchor, knot, _STRIDES + 1).astype(int))
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        at = state.at(seen, first)
        dt = float(seen.stamps[last] - seen.stamps[first]) * 1e-9
        spans = np.diff(felt.stamps[first : last + 1])
        blind = float(spans[felt.missing[first:last]].sum()) / float(spans.sum())
        held = float(np.abs(seen.rates[first : last + 1]).max())
        gyro2 = (1.0 - blind) * noise.gyro**2 + blind * (BLIND_GYRO**2 + (BLIND_TURN * held) ** 2)
        blind = 1.0 if blind_forces else blind
        accel2 = (1.0 - blind) * noise.accel**2 + blind * BLIND_ACCEL**2
        turn = rotations.matrices(seen.rotations_wxyz[[first, last]])
        force = turn[0].T @ (seen.velocities[last] - seen.velocities[first]) / dt
        transition = _transition(at.rotation, turn[0].T @ turn[1], force, dt)
        walk = _process(gyro2, accel2, noise, dt)
        _, covariance = predict(np.zeros(ERRORS), covariance, transition, walk)
    return state.at(seen, knot), covariance


def _transition(rotation: F64, turn: F64, force: F64, dt: float) -> F64:
    """Return how errors at one instant become errors ``dt`` later, shape (18, 18)."""
    lean = -rotation @ skew(force)
    eye = np.eye(3)
    f = np.eye(ERRORS)
    f[TURN, TURN] = turn.T
    f[TURN, GYRO_BIAS] = -dt * eye
    f[VELOCITY, TURN] = dt * lean
    f[VELOCITY, ACCEL_BIAS] = -dt * rotation
    f[VELOCITY, GRAVITY] = dt * eye
    f[POSITION, TURN] = 0.5 * dt * dt * lean
    f[POSITION, VELOCITY] = dt * eye
    f[POSITION, ACCEL_BIAS] = -0.5 * dt * dt * rotation
    f[POSITION, GRAVITY] = 0.5 * dt * dt * eye
    return f


def _process(gyro2: float, accel2: float, noise: Noise, dt: float) -> F64:
    """Return the covariance that a step adds, shape (18, 18)."""
    q = np.zeros((ERRORS, ERRORS))
    eye = np.eye(3)
    q[TURN, TURN] = gyro2 * dt * eye
    q[VELOCITY, VELOCITY] = accel2 * dt * eye
    q[POSITION, POSITION] = accel2 * dt**3 / 3.0 * eye
    q[POSITION, VELOCITY] = q[VELOCITY, POSITION] = accel2 * dt * dt / 2.0 * eye
    q[GYRO_BIAS, GYRO_BIAS] = noise.gyro_walk**2 * dt * eye
    q[ACCEL_BIAS, ACCEL_BIAS] = noise.accel_walk**2 * dt * eye
    return q


def corrected(
    prior: InertialState, covariance: F64, at: InertialState, information: F64, pull: F64
) -> tuple[InertialState, F64]:
    """Return the posterior of one iteration of the iterated Kalman update.

    Parameters
    ----------
    prior : InertialState
    covariance : ndarray, shape (18, 18)
        Of the prior.
    at : InertialState
        Where the measurement was linearised.
    information : ndarray, shape (18, 18)
        Sum of h^T w h over all residuals, h their derivatives by the errors of ``at``.
    pull : ndarray, shape (18,)
        Sum of -h^T w r over all residuals r.
    """
    # thousands of residuals say no more than these 18 with unit noise (a square root of the
    # information)
    strength, directions = np.linalg.eigh(information)
    known = strength > 1e-9 * max(float(strength[-1]), 1e-300)
    root = np.sqrt(strength[known])
    h = root[:, None] * directions[:, known].T
    z = (directions[:, known].T @ pull) / root
    error, posterior = update(-at.minus(prior), covariance, z, np.eye(len(z)), h)
    return at.moved(np.asarray(error)), 0.5 * (posterior + posterior.T)


def slowed(state: InertialState, covariance: F64, seconds: float) -> tuple[InertialState, F64]:
    """Return state and covariance with the velocity, where hardly known, drawn towards rest.

    Carriers are slow: it is as if a velocity of zero were measured all the time, but so coarsely
    that it counts only where nothing else tells the velocity.

    Parameters
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    seconds : float
        How much time has passed since this was done last.
    """
    if np.linalg.eigvalsh(covariance[VELOCITY, VELOCITY])[-1] < SLOW_FROM**2:
        return state, covariance
    information = np.zeros_like(covariance)
    information[VELOCITY, VELOCITY] = seconds / SLOW_SPEED**2 * np.eye(3)
    return corrected(
        state, covariance, state, information, -information[:, VELOCITY] @ state.velocity
    )


def loosened(covariance: F64, errors: slice, sigma: float) -> F64:
    """Return a covariance (18, 18) in which three errors are independent of all others."""
    out = covariance.copy()
    out[errors, :] = 0.0
    out[:, errors] = 0.0
    out[errors, errors] = sigma**2 * np.eye(3)
    return out


def at_origin(covariance: F64) -> F64:
    """Return a covariance (18, 18) in which the pose is known: a new map begins with it."""
    for errors in (TURN, POSITION):
        covariance = loosened(covariance, errors, _OWN_POSE)
    return covariance


def same_bias(
    state: InertialState, covariance: F64, before: InertialState, covariance_before: F64
) -> tuple[InertialState, F64]:
    """Return state and covariance (18, 18) with the gyro's bias as it was known before.

    Without samples it stood for what the rate had changed by.
    """
    covariance = loosened(covariance, GYRO_BIAS, 0.0)
    covariance[GYRO_BIAS, GYRO_BIAS] = covariance_before[GYRO_BIAS, GYRO_BIAS]
    return dataclasses.replace(state, gyro_bias=before.gyro_bias), covariance


def interrupted(state: InertialState, covariance: F64, stamp: HostNs) -> tuple[InertialState, F64]:
    """Return state and covariance (18, 18) at an instant about which no more is known than before.

    The sensor may have been moved meanwhile, but hardly far; how it moves now is not known.
    """
    for errors, sigma in ((TURN, 0.1), (POSITION, 0.5), (VELOCITY, 1.0)):
        covariance = loosened(covariance, errors, sigma)
    return dataclasses.replace(state, stamp=stamp, velocity=np.zeros(3)), covariance


def skew(v: F64) -> F64:
    """Return the matrix of the cross product, shape (3, 3)."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
