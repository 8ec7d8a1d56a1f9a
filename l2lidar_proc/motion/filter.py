"""Error-state Kalman filter of the IMU's pose, velocity, biases and gravity.

IMU samples are turned to cloud axes before they get here; only the origin is the IMU's. The 18
errors are ordered rotation (3, cloud axes), position, velocity (map axes), gyro bias,
accelerometer bias (cloud axes) and gravity (map axes). The first pose fixes the map frame, so
gravity is a state in it rather than its axis (as in FAST-LIO2, Xu et al. 2022). Measurements are a
twist, a zero velocity, and a scan alignment in information form; notation and error definition
follow Sola (2017), boxplus and boxminus Hertzberg et al. (2013).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from l2lidar_node import rotations
from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.motion.preintegration import ImuSegment, Preintegration

ROTATION: Final = slice(0, 3)
POSITION: Final = slice(3, 6)
VELOCITY: Final = slice(6, 9)
GYRO_BIAS: Final = slice(9, 12)
ACCEL_BIAS: Final = slice(12, 15)
GRAVITY: Final = slice(15, 18)
POSE: Final = slice(ROTATION.start, POSITION.stop)
TWIST: Final = slice(VELOCITY.start, GYRO_BIAS.stop)  # an error of the bias is one of the rate
ERRORS: Final = 18


LIBRARY: Final = "filterpy.kalman"
"""Imported at the first prediction: it brings ``scipy.stats`` along, a second of work."""


@cache
def kalman() -> Any:
    """Return :data:`LIBRARY`, imported when it is first asked for."""
    return import_module(LIBRARY)


@dataclass(frozen=True, slots=True, eq=False)
class InertialState:
    """Pose, velocity, biases and gravity of the IMU at one instant.

    Attributes
    ----------
    stamp : HostNs
    rotation : ndarray, shape (3, 3)
        Cloud axes to map axes.
    position, velocity : ndarray, shape (3,)
        Of the IMU's origin in the map [m, m/s].
    gyro_bias, accel_bias : ndarray, shape (3,)
        Cloud axes [rad/s, m/s^2].
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

    @property
    def pose(self) -> F64:
        """Pose of the IMU's origin in the map, with cloud axes, shape (4, 4)."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.rotation, self.position
        return pose

    def cloud_origin(self, lever: F64) -> F64:
        """Return the place (3,) of the cloud frame's origin, map frame [m].

        ``lever`` (3,) is the place of the IMU in the cloud frame [m].
        """
        return np.asarray(self.position - self.rotation @ lever)

    def boxplus(self, error: F64) -> InertialState:
        """Return ``state boxplus error``, the error of shape (18,)."""
        return InertialState(
            self.stamp,
            self.rotation @ rotations.matrices(rotations.exp(error[ROTATION])),
            self.position + error[POSITION],
            self.velocity + error[VELOCITY],
            self.gyro_bias + error[GYRO_BIAS],
            self.accel_bias + error[ACCEL_BIAS],
            self.gravity + error[GRAVITY],
        )

    def boxminus(self, other: InertialState) -> F64:
        """Return the error (18,) with ``other boxplus error == self``."""
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

    def at(self, preintegrated: Preintegration, knot: int) -> InertialState:
        """Return the state at a knot; this one belongs to the anchor of the preintegration."""
        anchor = preintegrated.stamps[preintegrated.anchor]
        dt = float(preintegrated.stamps[knot] - anchor) * 1e-9
        return dataclasses.replace(
            self,
            stamp=HostNs(int(preintegrated.stamps[knot])),
            rotation=self.rotation @ rotations.matrices(preintegrated.rotations_wxyz[knot]),
            position=self.position
            + dt * self.velocity
            + 0.5 * dt * dt * self.gravity
            + self.rotation @ preintegrated.positions[knot],
            velocity=self.velocity
            + dt * self.gravity
            + self.rotation @ preintegrated.velocities[knot],
        )

    @property
    def rest_force(self) -> F64:
        """Specific force of a sensor at rest in this attitude, without bias [m/s^2], (3,)."""
        return np.asarray(-self.rotation.T @ self.gravity)


@dataclass(frozen=True, slots=True)
class Noise:
    """Process noise: densities of white noise, per axis.

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
    gyro_share : float
        Of the angular velocity that counts as noise besides, for errors of scale and axes
        [sqrt(s)].
    accel_share : float
        Likewise of the acceleration.
    gyro_vibration, accel_vibration : float
        Errors of angle [rad] and velocity [m/s] that vibrations make, 1 sigma, however long they
        last.
    """

    gyro: float
    accel: float
    gyro_walk: float
    accel_walk: float
    gyro_share: float = 0.0
    accel_share: float = 0.0
    gyro_vibration: float = 0.0
    accel_vibration: float = 0.0


class Update(NamedTuple):
    """Outcome of a measurement.

    Attributes
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    nis : float
        Normalized innovation squared before the update, not divided by its degrees of freedom.
    """

    state: InertialState
    covariance: F64
    nis: float


# ---- prediction


def predict(
    state: InertialState,
    covariance: F64,
    imu: ImuSegment,
    preintegrated: Preintegration,
    knot: int,
    noise: Noise,
    *,
    use_forces: bool = True,
) -> tuple[InertialState, F64]:
    """Return state and covariance (18, 18) at a later knot.

    Parameters
    ----------
    state : InertialState
        At the anchor of ``preintegrated``.
    covariance : ndarray, shape (18, 18)
    imu : ImuSegment
    preintegrated : Preintegration
        Of the same segment.
    knot : int
        Not before the anchor.
    noise : Noise
    use_forces : bool
        Whether ``preintegrated`` used the accelerometer; otherwise the velocity is held.
    """
    if knot <= preintegrated.anchor:
        return state.at(preintegrated, knot), covariance
    edges = np.unique(
        np.linspace(preintegrated.anchor, knot, tuning.COVARIANCE_STEPS + 1).astype(int)
    )
    first, last = edges[:-1], edges[1:]
    dt = np.diff(preintegrated.stamps[edges]) * 1e-9
    turns = rotations.matrices(preintegrated.rotations_wxyz[edges])
    back = np.swapaxes(turns[:-1], 1, 2)
    gained = np.diff(preintegrated.velocities[edges], axis=0)
    forces = (back @ (gained / dt[:, None])[..., None])[..., 0]
    f = transition(state.rotation @ turns[:-1], back @ turns[1:], forces, dt)
    spans = np.diff(imu.stamps[: knot + 1])
    lasted = np.add.reduceat(spans, first)
    blind = np.add.reduceat(spans * imu.missing[:knot], first) / lasted
    rates = np.abs(preintegrated.rates[: knot + 1]).max(axis=1)
    held = np.maximum(np.maximum.reduceat(rates[:-1], first), rates[last])
    ways = np.add.reduceat(spans[:, None] * preintegrated.rates[:knot], first, axis=0)
    means = ways / lasted[:, None]
    turning = np.abs(means).max(axis=1)  # a vibration turns nothing
    measured = noise.gyro**2 + (noise.gyro_share * turning) ** 2
    accelerations = np.linalg.norm(forces - back @ state.rest_force, axis=1)
    gaps = imu.missing[:knot]
    around = (
        float(imu.rate_errors[:knot].max(initial=0.0, where=gaps)),
        float(imu.force_errors[:knot].max(initial=0.0, where=gaps)),
    )
    unmeasured = _unmeasured(blind * dt, blind == 0.0, held, means, accelerations, around)
    gyro2 = (1.0 - blind) * measured + blind * unmeasured.gyro2
    measured = noise.accel**2 + (noise.accel_share * accelerations) ** 2
    accel2 = (1.0 - blind) * measured + blind * unmeasured.accel2
    # errors of interpolation do not change sign within their interval: they add up as they are
    sparse = np.where(gaps, 0.0, spans * 1e-9)
    gyro2 = gyro2 + np.add.reduceat(imu.rate_errors[:knot] * sparse, first) ** 2 / dt
    accel2 = accel2 + np.add.reduceat(imu.force_errors[:knot] * sparse, first) ** 2 / dt
    if not use_forces:
        # the velocity is held, whatever attitude, biases and gravity are
        for moved in (VELOCITY, POSITION):
            for cause in (ROTATION, GYRO_BIAS, ACCEL_BIAS, GRAVITY):
                f[..., moved, cause] = 0.0
        accel2 = np.full_like(accel2, tuning.BLIND_ACCEL**2)
    q = process_noise(gyro2, accel2, noise, dt)
    phi, noise_of_all = f[0], q[0]
    for step, more in zip(f[1:], q[1:], strict=True):
        phi, noise_of_all = step @ phi, step @ noise_of_all @ step.T + more
    # the errors of a vibration at the beginning and at the end are independent, and as large
    noise_of_all[ROTATION, ROTATION] += 2.0 * noise.gyro_vibration**2 * np.eye(3)
    noise_of_all[VELOCITY, VELOCITY] += 2.0 * noise.accel_vibration**2 * np.eye(3)
    _, covariance = kalman().predict(np.zeros(ERRORS), covariance, phi, noise_of_all)
    return state.at(preintegrated, knot), covariance


class _Unmeasured(NamedTuple):
    """What a carrier may do while nothing is measured, as squared densities of white noise."""

    gyro2: F64
    accel2: float


def _unmeasured(
    blind: F64,
    is_measured: NDArray[np.bool_],
    held: F64,
    rates: F64,
    accelerations: F64,
    around: tuple[float, float],
) -> _Unmeasured:
    """Return how much the motion may change where samples are missing.

    In a gap of a few samples a carrier goes on as in the steps before and after: rates and
    accelerations spread by what they do there. A blow is shorter than a step, and shows in the
    samples next to the gap.

    Parameters
    ----------
    blind : ndarray, shape (S,)
        Time of each step in which samples are missing [s].
    is_measured : ndarray, shape (S,)
        Steps without a gap.
    held : ndarray, shape (S,)
        Largest rate about any axis [rad/s].
    rates : ndarray, shape (S, 3)
        Mean angular velocity [rad/s].
    accelerations : ndarray, shape (S,)
        Size of the mean acceleration [m/s^2].
    around : tuple of float
        By which rates [rad/s] and forces [m/s^2] spread next to the gaps.
    """
    gyro2 = tuning.BLIND_GYRO**2 + (tuning.BLIND_GYRO_SHARE * held) ** 2
    lasted = float(blind.sum())
    if lasted > tuning.BLIND_SHORT_S or np.count_nonzero(is_measured) < tuning.BLIND_STEPS:
        return _Unmeasured(gyro2, tuning.BLIND_ACCEL**2)
    least_rate, least_acceleration = tuning.BLIND_SHORT_SPREAD
    spread = max(float(rates[is_measured].var(axis=0).max()), around[0] ** 2) + least_rate**2
    change = float(np.square(accelerations[is_measured]).mean())
    change = max(change, around[1] ** 2) + least_acceleration**2
    # a rate that is off throughout the gap errs by spread * lasted, not by its root
    return _Unmeasured(
        np.full_like(gyro2, lasted * spread), min(tuning.BLIND_ACCEL**2, lasted * change)
    )


def transition(rotation: F64, turn: F64, force: F64, dt: ArrayLike) -> F64:
    """Return the derivatives (..., 18, 18) of the errors ``dt`` later by the errors now.

    Parameters
    ----------
    rotation : ndarray, shape (..., 3, 3)
        Attitude at the beginning.
    turn : ndarray, shape (..., 3, 3)
        Axes at the end to axes at the beginning.
    force : ndarray, shape (..., 3)
        Mean specific force without bias, axes of the beginning [m/s^2].
    dt : array-like, shape (...)
        [s]
    """
    h = np.asarray(dt)[..., None, None]
    lean = -rotation @ skew(force)
    eye = np.eye(3)
    f = np.zeros((*h.shape[:-2], ERRORS, ERRORS)) + np.eye(ERRORS)
    f[..., ROTATION, ROTATION] = np.swapaxes(turn, -1, -2)
    f[..., ROTATION, GYRO_BIAS] = -h * eye
    f[..., VELOCITY, ROTATION] = h * lean
    f[..., VELOCITY, GYRO_BIAS] = -0.5 * h * h * lean
    f[..., VELOCITY, ACCEL_BIAS] = -h * rotation
    f[..., VELOCITY, GRAVITY] = h * eye
    f[..., POSITION, ROTATION] = 0.5 * h * h * lean
    f[..., POSITION, VELOCITY] = h * eye
    f[..., POSITION, GYRO_BIAS] = -(h**3) / 6.0 * lean
    f[..., POSITION, ACCEL_BIAS] = -0.5 * h * h * rotation
    f[..., POSITION, GRAVITY] = 0.5 * h * h * eye
    return f


def process_noise(gyro2: ArrayLike, accel2: ArrayLike, noise: Noise, dt: ArrayLike) -> F64:
    """Return the covariances (..., 18, 18) that steps of ``dt`` [s] add.

    Parameters
    ----------
    gyro2, accel2 : array-like, shape (...)
        Squared densities of gyro [(rad/s)^2/Hz] and accelerometer [(m/s^2)^2/Hz] in the step.
    noise : Noise
        Gives the random walks of the biases.
    dt : array-like, shape (...)
    """
    h, gyro, accel = (np.asarray(item)[..., None, None] for item in (dt, gyro2, accel2))
    eye = np.eye(3)
    q = np.zeros((*h.shape[:-2], ERRORS, ERRORS))
    q[..., ROTATION, ROTATION] = gyro * h * eye
    q[..., VELOCITY, VELOCITY] = accel * h * eye
    q[..., POSITION, POSITION] = accel * h**3 / 3.0 * eye
    q[..., POSITION, VELOCITY] = q[..., VELOCITY, POSITION] = accel * h * h / 2.0 * eye
    q[..., GYRO_BIAS, GYRO_BIAS] = noise.gyro_walk**2 * h * eye
    q[..., ACCEL_BIAS, ACCEL_BIAS] = noise.accel_walk**2 * h * eye
    return q


# ---- updates


def update(
    state: InertialState, covariance: F64, innovation: F64, jacobian: F64, noise: F64
) -> Update:
    """Return the posterior of a measurement.

    Parameters
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    innovation : ndarray, shape (M,)
        Measured minus predicted.
    jacobian : ndarray, shape (M, 18)
        Derivatives of the predicted measurement by the errors.
    noise : ndarray, shape (M, M)
        Covariance of the measurement.
    """
    innovation_covariance = jacobian @ covariance @ jacobian.T + noise
    nis = float(innovation @ np.linalg.solve(innovation_covariance, innovation))
    error, posterior = kalman().update(np.zeros(ERRORS), covariance, innovation, noise, jacobian)
    symmetric = 0.5 * (posterior + posterior.T)
    return Update(state.boxplus(np.asarray(error)), symmetric, nis)


def association_probability(innovation: float, variance: float, odds: float) -> float:
    """Return the probability that a scalar measurement is what it was taken for, not clutter.

    Probabilistic data association (Bar-Shalom and Tse 1975) with one candidate.

    Parameters
    ----------
    innovation : float
        Measured minus predicted.
    variance : float
        Of the innovation, if it is the right one.
    odds : float
        How often right measurements come, for each density of false ones; of the innovation's
        unit.
    """
    density = np.exp(-0.5 * innovation**2 / variance) / np.sqrt(2.0 * np.pi * variance)
    return float(odds * density / (1.0 + odds * density))


def square_root(covariance: F64) -> F64:
    """Return a matrix whose product with its transpose is a covariance (N, N), singular or not."""
    variances, directions = np.linalg.eigh(covariance)
    return np.asarray(directions * np.sqrt(np.maximum(variances, 0.0)))


def update_with_information(
    prior: InertialState, root: F64, at: InertialState, information: F64, gradient: F64
) -> tuple[InertialState, F64]:
    """Return the posterior of one iteration of the iterated Kalman update, and its covariance.

    Thousands of residuals are given as the information that they sum to. The information form
    of the update is computed with a square root of the covariance, so that the posterior is
    symmetric and positive however certain it is (Bierman, "Factorization Methods for Discrete
    Sequential Estimation", 1977).

    Parameters
    ----------
    prior : InertialState
    root : ndarray, shape (18, 18)
        :func:`square_root` of the prior's covariance, the same in all iterations.
    at : InertialState
        Where the measurement was linearized.
    information : ndarray, shape (18, 18)
        Sum of h^T w h over all residuals, h their derivatives by the errors of ``at``.
    gradient : ndarray, shape (18,)
        Sum of -h^T w r over all residuals r.
    """
    left = np.linalg.cholesky(np.eye(ERRORS) + root.T @ information @ root)
    whitened = np.linalg.solve(left, root.T)
    posterior = whitened.T @ whitened
    error = -at.boxminus(prior)
    error += posterior @ (gradient - information @ error)
    return at.boxplus(error), posterior


def twist_jacobian(state: InertialState, lever: F64) -> F64:
    """Return the derivatives (3, 18) of :func:`body_velocity` by the errors."""
    h = np.zeros((3, ERRORS))
    h[:, ROTATION] = skew(state.rotation.T @ state.velocity)
    h[:, VELOCITY] = state.rotation.T
    h[:, GYRO_BIAS] = -skew(lever)
    return h


def body_velocity(state: InertialState, rate: F64, lever: F64) -> F64:
    """Return the velocity of the cloud frame's origin in cloud axes [m/s], shape (3,).

    Parameters
    ----------
    state : InertialState
    rate : ndarray, shape (3,)
        Angular velocity as measured, bias included [rad/s].
    lever : ndarray, shape (3,)
        Place of the IMU in the cloud frame [m].
    """
    turning = rate - state.gyro_bias
    return np.asarray(state.rotation.T @ state.velocity - rotations.cross(turning, lever))


def update_twist(
    state: InertialState, covariance: F64, measured: F64, noise: F64, rate: F64, lever: F64
) -> Update:
    """Return the posterior of a measured velocity of the cloud frame's origin.

    Parameters
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    measured : ndarray, shape (3,)
        Over the ground, cloud axes [m/s].
    noise : ndarray, shape (3, 3)
        Its covariance.
    rate, lever : ndarray, shape (3,)
        As in :func:`body_velocity`.
    """
    innovation = measured - body_velocity(state, rate, lever)
    return update(state, covariance, innovation, twist_jacobian(state, lever), noise)


def update_static(
    state: InertialState,
    covariance: F64,
    samples: Samples,
    noise: Noise,
    use_forces: bool,
    *,
    levels: bool = False,
) -> tuple[InertialState, F64]:
    """Return state and covariance after samples of a sensor at rest: a zero-velocity update.

    The mean rate measures the gyro bias, the mean force gravity plus the accelerometer bias. The
    velocity becomes zero; stamp and position stay. Fewer than two samples change nothing.

    Parameters
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        Since this was done last, cloud axes.
    noise : Noise
    use_forces : bool
        Whether the accelerometer is used.
    levels : bool
        The force corrects roll and pitch as well; otherwise the whole pose stays.
    """
    if len(samples) < 2:
        return state, covariance
    seconds = float(samples["stamp"][-1] - samples["stamp"][0]) * 1e-9
    covariance = covariance.copy()
    covariance[GYRO_BIAS, GYRO_BIAS] += noise.gyro_walk**2 * seconds * np.eye(3)
    covariance[ACCEL_BIAS, ACCEL_BIAS] += noise.accel_walk**2 * seconds * np.eye(3)
    jacobian = np.zeros((9, ERRORS))
    jacobian[:3, GYRO_BIAS] = np.eye(3)
    jacobian[3:6, VELOCITY] = np.eye(3)
    weights = np.repeat((seconds / noise.gyro**2, 1.0 / tuning.ZERO_VELOCITY**2, 0.0), 3)
    innovation = np.zeros(9)
    innovation[:3] = samples["angular_velocity"].mean(axis=0) - state.gyro_bias
    innovation[3:6] = -state.velocity
    if use_forces:
        jacobian[6:, ACCEL_BIAS] = np.eye(3)
        jacobian[6:, GRAVITY] = -state.rotation.T
        if levels:
            jacobian[6:, ROTATION] = skew(state.rest_force)
        weights[6:] = seconds / noise.accel**2
        force = samples["linear_acceleration"].mean(axis=0)
        innovation[6:] = force - state.accel_bias - state.rest_force
    weighted = jacobian.T * weights
    better, covariance = update_with_information(
        state, square_root(covariance), state, weighted @ jacobian, weighted @ innovation
    )
    return (
        dataclasses.replace(
            state,
            rotation=better.rotation if levels else state.rotation,
            velocity=np.zeros(3),
            gyro_bias=better.gyro_bias,
            accel_bias=better.accel_bias,
            gravity=better.gravity,
        ),
        covariance,
    )


# ---- changes of what is known


def decorrelated(covariance: F64, errors: slice, sigma: float) -> F64:
    """Return a covariance (18, 18) in which three errors are independent of all others."""
    out = covariance.copy()
    out[errors, :] = 0.0
    out[:, errors] = 0.0
    out[errors, errors] = sigma**2 * np.eye(3)
    return out


def pose_covariance(state: InertialState, covariance: F64) -> F64:
    """Return the covariance (6, 6) of place and turn about the map's axes [m, rad].

    Parameters
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    """
    errors = np.r_[POSITION, ROTATION]
    axes = np.eye(6)
    axes[3:, 3:] = state.rotation
    return np.asarray(axes @ covariance[np.ix_(errors, errors)] @ axes.T)


def with_loose_pose(state: InertialState, covariance: F64, more: F64) -> F64:
    """Return a covariance (18, 18) in which the pose is more uncertain, independent of the rest.

    Parameters
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    more : ndarray, shape (6, 6)
        What is added, of x, y, z and of the turns about the map's axes [m, rad].
    """
    axes = np.zeros((6, 6))
    axes[:3, 3:] = state.rotation.T  # turns come first here, about the cloud's axes
    axes[3:, :3] = np.eye(3)
    pose = covariance[POSE, POSE] + axes @ more @ axes.T
    out = covariance.copy()
    out[POSE, :] = out[:, POSE] = 0.0
    out[POSE, POSE] = pose
    return out


def with_leaning_gravity(state: InertialState, covariance: F64, variance: float) -> F64:
    """Return a covariance (18, 18) in which the direction of gravity is less certain.

    Parameters
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    variance : float
        What is added, of the turn about either horizontal axis [rad^2].
    """
    out = covariance.copy()
    lever = skew(state.gravity)
    out[GRAVITY, GRAVITY] += variance * lever @ lever.T
    return out


def at_map_origin(covariance: F64) -> F64:
    """Return a covariance (18, 18) in which the pose is known: a new map begins with it."""
    for errors in (ROTATION, POSITION):
        covariance = decorrelated(covariance, errors, tuning.MAP_ORIGIN_SIGMA)
    return covariance


def with_gyro_bias_of(
    state: InertialState, covariance: F64, before: InertialState, covariance_before: F64
) -> tuple[InertialState, F64]:
    """Return state and covariance (18, 18) with the gyro bias as it was known before.

    Without samples it stood for the change of the rate.
    """
    covariance = decorrelated(covariance, GYRO_BIAS, 0.0)
    covariance[GYRO_BIAS, GYRO_BIAS] = covariance_before[GYRO_BIAS, GYRO_BIAS]
    return dataclasses.replace(state, gyro_bias=before.gyro_bias), covariance


def after_time_jump(
    state: InertialState, covariance: F64, stamp: HostNs
) -> tuple[InertialState, F64]:
    """Return state and covariance (18, 18) at the first instant of a new time line.

    The sensor may have been moved meanwhile, but hardly far; its motion is unknown.
    """
    for errors, sigma in (
        (ROTATION, tuning.TIME_JUMP_ROTATION),
        (POSITION, tuning.TIME_JUMP_POSITION),
        (VELOCITY, tuning.TIME_JUMP_VELOCITY),
    ):
        covariance = decorrelated(covariance, errors, sigma)
    return dataclasses.replace(state, stamp=stamp, velocity=np.zeros(3)), covariance


def skew(v: F64) -> F64:
    """Return the matrices of the cross product, shape (..., 3, 3)."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., (2, 0, 1), (1, 2, 0)] = v
    matrix[..., (1, 2, 0), (2, 0, 1)] = -v
    return matrix
