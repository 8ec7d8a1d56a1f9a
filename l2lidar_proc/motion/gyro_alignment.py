"""Gyro alignment: rotation, time offset, scale and bias from the poses of an odometry.

A gyro with the rotation R in the cloud frame measures ``m = (I + E) R^T w + b`` of the cloud
frame's angular velocity w, E symmetric: scale on its diagonal, misalignment beside it. What is
antisymmetric in a real gyro's misalignment is a rotation, and is found as one. Between two poses
the gyro must turn as the poses do; the difference is linear in small changes of all parameters,
so batch least squares and the check of a running odometry share :func:`turns_between`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import F64
from l2lidar_proc.motion.imu_buffer import Samples

ROTATION: Final = slice(0, 3)
SCALE: Final = slice(3, 6)
SKEW: Final = slice(6, 9)
BIAS: Final = slice(9, 12)
OFFSET: Final = 12
PARAMETERS: Final = 13

PRIOR_SD: Final = np.array([*[np.deg2rad(10.0)] * 3, *[0.02] * 3, *[0.01] * 3, *[0.2] * 3, 0.02])
"""What is known beforehand, wide: it only keeps what the motion does not tell near nothing.

Rotations up to 10 degrees, scales of 2 %, misalignments of 1 %, biases of 0.2 rad/s and offsets of
20 ms are beyond what such sensors have; twice these values are implausible.
"""

_PARTS: Final = 8  # of the recording, whose scatter tells the uncertainty
_OUTLIER: Final = 3.0  # Huber's bound in standard deviations
# [rad] Poses and rates are rounded numbers, so no agreement is closer than this. A simulated
# sensor at rest has residuals of exactly zero, which would be infinitely certain.
_LEAST_RESIDUAL: Final = 1e-6
_ITERATIONS: Final = 8
_CONVERGED: Final = 0.02  # of a standard deviation
_LONGEST_NS: Final = 1_000_000_000  # between poses: longer ones span a gap
_LARGEST_GAP_NS: Final = 30_000_000  # between samples within such an interval
_FEWEST: Final = 4 * _PARTS  # intervals
_HEAD_TURN_NS: Final = 230_000_000
_STRAY: Final = 0.5  # [rad^2/s] of an axis that is not turned about: it explains nothing
# ---- of a rotation that may be large
_COARSE_NS: Final = 380_000_000  # between poses: shorter turns are hardly more than their noise
_COARSE_LEAST: Final = 12  # turns
_COARSE_UNEXPLAINED: Final = 0.5  # share, at most. Scan matching of walks leaves 0.1
_COARSE_SD: Final = 0.16  # [rad] at most: five of them tell apart two that map axes to axes
_COARSE_LEAST_ANGLE: Final = np.deg2rad(15.0)  # a smaller one is a matter of calibration
_COARSE_EXCESS: Final = 40.0  # of three degrees of freedom; right axes reach 15 by chance
# [rad] within which it may be one that maps axes to axes, at least, and in standard deviations
_COARSE_SNAP: Final = 0.05
_COARSE_SNAP_SDS: Final = 2.5


class GyroError(ValueError):
    """Poses and samples from which nothing can be estimated; the message says why."""


@dataclass(frozen=True, slots=True, eq=False)
class GyroModel:
    """How a gyro measures the cloud frame's angular velocity.

    Attributes
    ----------
    rotation : ndarray, shape (3, 3)
        R: IMU axes to cloud axes.
    scale : ndarray, shape (3,)
        Measured over true rate of each axis, minus one.
    skew : ndarray, shape (3,)
        Symmetric misalignment of x and y, x and z, y and z [rad].
    bias : ndarray, shape (3,)
        IMU axes [rad/s].
    offset_s : float
        What the stamps of samples are late by [s].
    """

    rotation: F64
    scale: F64
    skew: F64
    bias: F64
    offset_s: float

    @classmethod
    def ideal(cls) -> GyroModel:
        """Return the model of a gyro as it is drawn."""
        return cls(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), 0.0)

    @property
    def values(self) -> F64:
        """All parameters as one vector, the rotation as a rotation vector, shape (13,)."""
        vector = rotations.log(rotations.from_matrix(self.rotation))
        return np.concatenate((vector, self.scale, self.skew, self.bias, [self.offset_s]))

    @classmethod
    def of(cls, values: F64) -> GyroModel:
        """Return the model of a vector of parameters (13,)."""
        return cls(
            rotations.matrices(rotations.exp(values[ROTATION])),
            values[SCALE].copy(),
            values[SKEW].copy(),
            values[BIAS].copy(),
            float(values[OFFSET]),
        )

    @property
    def unmixing(self) -> F64:
        """Matrix (3, 3) that takes the scale and misalignment off measured rates."""
        return unmixing(self.scale, self.skew)


class Turns(NamedTuple):
    """Rotation of poses against the gyro, one row for each interval.

    Attributes
    ----------
    residual : ndarray, shape (K, 3)
        Rotation vector from the gyro's turn to the poses', axes of the cloud at the end [rad].
    jacobian : ndarray, shape (K, 3, 13)
        How the residual changes with the parameters.
    ends : ndarray, shape (K,), int64
        Stamp of the second pose [ns].
    """

    residual: F64
    jacobian: F64
    ends: NDArray[np.int64]

    @property
    def rms(self) -> float:
        """Root mean square of the residuals' norms [rad]."""
        return float(np.sqrt(np.mean(np.sum(self.residual**2, axis=1))))


@dataclass(frozen=True, slots=True, eq=False)
class GyroAlignment:
    """Result of a gyro alignment.

    Attributes
    ----------
    model : GyroModel
    covariance : ndarray, shape (13, 13)
        Order of the slices of this module; by the scatter between parts of the recording, at
        least that of the residuals.
    turns : Turns
        What is left under the model.
    outliers : int
        Intervals beyond three standard deviations.
    parts : ndarray, shape (P, 13)
        What the parts of the recording say by themselves, one step from the common solution.
    parts_sd : ndarray, shape (P, 13)
        Deviations of these by the residuals alone.
    excitation : ndarray, shape (3,)
        See :func:`excitation`.
    """

    model: GyroModel
    covariance: F64
    turns: Turns
    outliers: int
    parts: F64
    parts_sd: F64
    excitation: F64

    @property
    def sd(self) -> F64:
        """Standard deviations, shape (13,)."""
        return np.sqrt(np.diag(self.covariance))


def unmixing(scale: F64, skew: F64) -> F64:
    """Return the matrix (3, 3) that takes scale and misalignment off measured rates."""
    matrix = np.diag(np.asarray(scale, dtype=np.float64))
    for value, (i, j) in zip(skew, ((0, 1), (0, 2), (1, 2)), strict=True):
        matrix[i, j] = matrix[j, i] = value
    return np.asarray(np.linalg.inv(np.eye(3) + matrix), dtype=np.float64)


def excitation(stamps: NDArray[np.int64], rates: F64) -> F64:
    """Return how far each axis has been turned about by itself, shape (3,) [rad^2/s].

    The integral of the squared rate that no combination of the other axes explains: axes that
    are only ever turned together are not told apart. Rates are averaged over a turn of the head
    first, whose lines in the gyro are no turning.

    Parameters
    ----------
    stamps : ndarray, shape (N,), int64
        [ns], ascending.
    rates : ndarray, shape (N, 3)
        Of the gyro [rad/s].
    """
    if not len(stamps):
        return np.zeros(3)
    number = (stamps - stamps[0]) // _HEAD_TURN_NS
    groups = np.unique(number, return_inverse=True)[1]
    count = np.bincount(groups)
    smooth = np.stack([np.bincount(groups, column) / count for column in rates.T], axis=-1)
    turning = smooth - np.median(smooth, axis=0)
    moment = _HEAD_TURN_NS * 1e-9 * turning.T @ turning
    alone = 1.0 / np.diag(np.linalg.inv(moment + _STRAY * np.eye(3)))
    return np.asarray(np.clip(alone - _STRAY, 0.0, None))


def turns_between(
    stamps: NDArray[np.int64], orientations: F64, samples: Samples, model: GyroModel
) -> Turns:
    """Return how poses turn against a gyro.

    Intervals that are too long, or within which samples are missing, are left out.

    Parameters
    ----------
    stamps : ndarray, shape (N,), int64
        Of the poses [ns], ascending.
    orientations : ndarray, shape (N, 4)
        Cloud axes to fixed axes, w, x, y, z.
    samples : ndarray, shape (M,), dtype IMU_SAMPLE
        As measured, ascending.
    model : GyroModel
        To compare with, and to linearize about.
    """
    at = samples["stamp"] - round(1e9 * model.offset_s)
    usable = _usable(stamps, at)
    if not usable.any():
        return Turns(np.empty((0, 3)), np.empty((0, 3, PARAMETERS)), np.empty(0, np.int64))
    origin = int(stamps[0])
    marks = np.concatenate((stamps[:-1][usable], stamps[1:][usable]))
    knots = np.unique(np.concatenate((at, marks)))
    knots = knots[(knots >= marks.min()) & (knots <= marks.max())]
    t, known = (knots - origin) * 1e-9, (at - origin) * 1e-9
    measured = np.stack(
        [np.interp(t, known, column) for column in samples["angular_velocity"].T], axis=-1
    )
    dt = np.diff(t)[:, None]
    middle = 0.5 * (measured[1:] + measured[:-1]) - model.bias
    plain = middle @ model.unmixing.T
    rate = plain @ model.rotation.T
    q = rotations.normalised(
        rotations.cumulative(np.vstack(([1.0, 0.0, 0.0, 0.0], rotations.exp(rate * dt))))
    )
    first = np.searchsorted(knots, stamps[:-1][usable])
    last = np.searchsorted(knots, stamps[1:][usable])
    by_gyro = rotations.multiply(rotations.conjugate(q[first]), q[last])
    poses = rotations.normalised(orientations)
    by_poses = rotations.multiply(rotations.conjugate(poses[:-1]), poses[1:])[usable]
    residual = rotations.log(rotations.multiply(rotations.conjugate(by_gyro), by_poses))
    steps = _derivatives(plain, model, np.diff(measured, axis=0) / np.maximum(dt, 1e-9))
    # A change of the rate at a step turns the end of the interval, in the axes at its end.
    to_fixed = rotations.matrices(q[:-1])
    summed = np.concatenate(
        (np.zeros((1, 3, PARAMETERS)), np.cumsum((to_fixed @ steps) * dt[:, :, None], axis=0))
    )
    back = np.swapaxes(rotations.matrices(q[last]), 1, 2)
    jacobian = -back @ (summed[last] - summed[first])
    return Turns(residual, np.asarray(jacobian, np.float64), stamps[1:][usable])


def _usable(stamps: NDArray[np.int64], at: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which intervals between poses are short and covered by samples, shape (N - 1,)."""
    start, end = stamps[:-1], stamps[1:]
    usable = (end > start) & (end - start <= _LONGEST_NS)
    if len(at) < 2:
        return np.zeros(len(usable), np.bool_)
    usable &= (start >= at[0]) & (end <= at[-1])
    gaps = np.flatnonzero(np.diff(at) > _LARGEST_GAP_NS)
    for gap in gaps.tolist():
        usable &= (end <= at[gap]) | (start >= at[gap + 1])
    return np.asarray(usable)


def _derivatives(plain: F64, model: GyroModel, change: F64) -> F64:
    """Return how the angular velocity changes with the parameters, shape (N, 3, 13)."""
    turn, unmixing = model.rotation, model.unmixing
    found = np.zeros((len(plain), 3, PARAMETERS))
    x, y, z = plain.T
    nothing = np.zeros(len(plain))
    # a turn of the rotation about the IMU's axes
    crossing = np.array([[nothing, z, -y], [-z, nothing, x], [y, -x, nothing]])
    found[:, :, ROTATION] = turn @ np.moveaxis(crossing, 2, 0)
    stretch = np.zeros((len(plain), 3, 6))
    for axis, column in enumerate((x, y, z)):
        stretch[:, axis, axis] = column
    for number, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        stretch[:, i, 3 + number], stretch[:, j, 3 + number] = plain[:, j], plain[:, i]
    found[:, :, SCALE.start : SKEW.stop] = -(turn @ unmixing) @ stretch
    found[:, :, BIAS] = -(turn @ unmixing)
    found[:, :, OFFSET] = change @ (turn @ unmixing).T
    return found


def align(
    stamps: NDArray[np.int64], orientations: F64, samples: Samples, start: GyroModel | None = None
) -> GyroAlignment:
    """Return the alignment of a gyro with poses.

    Parameters
    ----------
    stamps : ndarray, shape (N,), int64
        Of the poses [ns], ascending.
    orientations : ndarray, shape (N, 4)
        Cloud axes to fixed axes, w, x, y, z; errors of different poses are independent.
    samples : ndarray, shape (M,), dtype IMU_SAMPLE
        As measured, ascending.
    start : GyroModel, optional
        Where to begin; the drawing if left out.

    Raises
    ------
    GyroError
        If there are too few intervals between poses that samples cover.

    Notes
    -----
    Neighboring intervals share a pose, so their errors are correlated: with the variance p of a
    pose and w of the gyro's integral over an interval they have the covariance ``2 p + w`` on the
    diagonal and ``-p`` beside it. Both come from the residuals' own autocovariance.
    """
    model = start or GyroModel.ideal()
    turns = turns_between(stamps, orientations, samples, model)
    if len(turns.residual) < _FEWEST:
        raise GyroError(
            f"{len(turns.residual)} turns between poses with IMU samples, expected {_FEWEST}"
        )
    weights = np.ones(len(turns.residual))
    prior = np.diag(PRIOR_SD**-2.0)
    for _ in range(_ITERATIONS):
        normal, right = _normal(_whitened(turns, weights))
        step = np.asarray(np.linalg.solve(normal + prior, right - prior @ model.values))
        model = _stepped(model, step)
        turns = turns_between(stamps, orientations, samples, model)
        weights = _weights(turns)
        if (np.abs(step) < _CONVERGED * np.sqrt(np.diag(np.linalg.inv(normal + prior)))).all():
            break
    parts, parts_sd, covariance = _by_parts(_whitened(turns, weights))
    return GyroAlignment(
        model,
        covariance,
        turns,
        int(np.count_nonzero(weights < 1.0)),
        model.values + parts,
        parts_sd,
        excitation(samples["stamp"], samples["angular_velocity"].astype(np.float64)),
    )


class CoarseRotation(NamedTuple):
    """How the axes of a gyro lie in those of clouds, from their turns alone.

    Attributes
    ----------
    matrix : ndarray, shape (3, 3)
        IMU axes to cloud axes.
    sd : float
        Standard deviation of it, about the axis about which it is known worst [rad].
    unexplained : float
        Share of the turns' squares that it leaves.
    drawn_excess : float
        Squared Mahalanobis distance that the turns have more with the axes of the clouds.
    """

    matrix: F64
    sd: float
    unexplained: float
    drawn_excess: float

    @property
    def is_clear(self) -> bool:
        """Whether the gyro turns as the clouds do, and would not with the clouds' axes."""
        return (
            self.unexplained < _COARSE_UNEXPLAINED
            and self.sd < _COARSE_SD
            and self.contradicts_drawn
        )

    @property
    def contradicts_drawn(self) -> bool:
        """Whether the axes of the clouds cannot be those of the gyro, by far."""
        angle = float(np.arccos(np.clip((np.trace(self.matrix) - 1.0) / 2.0, -1.0, 1.0)))
        return angle > _COARSE_LEAST_ANGLE and self.drawn_excess > _COARSE_EXCESS


def coarse_rotation(
    stamps: NDArray[np.int64], orientations: F64, samples: Samples
) -> CoarseRotation | None:
    """Return how a gyro lies in the axes of clouds, however far it is turned.

    The rotation that takes its turns to those of the poses best, in the sense of least squares
    (Kabsch 1976; the problem of Wahba 1965). Where it may be one that maps axes to axes, as
    drivers and mounts have them, it is that one.

    Parameters
    ----------
    stamps : ndarray, shape (N,), int64
        Of the poses [ns], ascending.
    orientations : ndarray, shape (N, 4)
        Cloud axes to fixed axes, w, x, y, z.
    samples : ndarray, shape (M,), dtype IMU_SAMPLE
        As measured, ascending; those that are not finite are left out.

    Returns
    -------
    CoarseRotation or None
        None where there are too few turns.
    """
    from scipy.spatial.transform import Rotation

    samples = samples[np.isfinite(samples["angular_velocity"]).all(axis=1)]
    kept = [0] if len(stamps) else []
    for number, stamp in enumerate(stamps.tolist()):
        if stamp - stamps[kept[-1]] >= _COARSE_NS:
            kept.append(number)
    at, poses = stamps[kept], orientations[kept]
    standing = np.tile([1.0, 0.0, 0.0, 0.0], (len(at), 1))
    drawn = GyroModel.ideal()
    by_gyro = turns_between(at, standing, samples, drawn)
    within = np.isin(at[1:], by_gyro.ends)
    by_poses = rotations.log(
        rotations.multiply(rotations.conjugate(poses[:-1]), poses[1:])[within]
    )
    if len(by_poses) < _COARSE_LEAST:
        return None
    # without their means: a bias of the gyro is in these
    theirs, ours = (turns - turns.mean(axis=0) for turns in (-by_gyro.residual, by_poses))
    u, strengths, vt = np.linalg.svd(ours.T @ theirs)
    handed = float(np.linalg.det(u @ vt))  # -1 where a mirror would fit better
    matrix = (u * (1.0, 1.0, handed)) @ vt
    left = float(((ours - theirs @ matrix.T) ** 2).sum())
    variance = max(left / (3 * len(ours) - 6), _LEAST_RESIDUAL**2)
    # about the axis of the most turns the others tell
    told = strengths[1] + handed * strengths[2]
    sd = float(np.sqrt(variance / max(told, variance)))
    group = Rotation.create_group("O").as_matrix()
    angles = Rotation.from_matrix(group @ matrix.T).magnitude()
    if angles.min() < max(_COARSE_SNAP, _COARSE_SNAP_SDS * sd):
        matrix = group[int(np.argmin(angles))]
    drawn_left = float(((ours - theirs) ** 2).sum())
    return CoarseRotation(
        matrix, sd, left / max(float((ours**2).sum()), variance), (drawn_left - left) / variance
    )


def information(turns: Turns) -> tuple[F64, F64]:
    """Return the normal equations of the parameters from turns.

    Returns
    -------
    normal : ndarray, shape (13, 13)
    right : ndarray, shape (13,)
        The change is ``solve(normal, right)``.
    """
    return _normal(_whitened(turns, _weights(turns)))


def _weights(turns: Turns) -> F64:
    """Return Huber's weights of the intervals, as factors of residuals, shape (K,)."""
    size = np.linalg.norm(turns.residual, axis=1)
    scale = max(np.median(size) / 1.54, _LEAST_RESIDUAL)  # of a norm of three normal numbers
    return np.asarray(np.minimum(1.0, np.sqrt(3.0) * _OUTLIER * scale / np.maximum(size, 1e-12)))


def _stepped(model: GyroModel, step: F64) -> GyroModel:
    values = model.values + np.where(np.arange(PARAMETERS) < ROTATION.stop, 0.0, step)
    turned = model.rotation @ rotations.matrices(rotations.exp(step[ROTATION]))
    values[ROTATION] = rotations.log(rotations.from_matrix(turned))
    return GyroModel.of(values)


def _whitened(turns: Turns, weights: F64) -> Turns:
    """Return the turns with errors that are independent and of variance one."""
    from scipy.linalg import cholesky_banded, solve_banded

    residual = turns.residual * weights[:, None]
    count = len(residual)
    total = max(float(np.mean(residual**2)), _LEAST_RESIDUAL**2)
    shared = -float(np.mean(residual[1:] * residual[:-1]))
    pose = min(max(shared, 0.05 * total), 0.45 * total)
    bands = np.vstack((np.full(count, total), np.full(count, -pose)))
    lower = cholesky_banded(bands, lower=True)
    both = np.concatenate((turns.residual[..., None], turns.jacobian), axis=2)
    flat = (both * weights[:, None, None]).reshape(count, -1)
    solved = solve_banded((1, 0), lower, flat).reshape(both.shape)
    return Turns(solved[..., 0], solved[..., 1:], turns.ends)


def _normal(turns: Turns) -> tuple[F64, F64]:
    """Return the normal matrix and right side for a step that takes the residuals away."""
    jacobian = turns.jacobian.reshape(-1, PARAMETERS)
    return jacobian.T @ jacobian, -jacobian.T @ turns.residual.reshape(-1)


def _by_parts(white: Turns) -> tuple[F64, F64, F64]:
    """Return the parts' deviations from the whole, standard deviations, and the covariance.

    Delete-one jackknife over stretches of the recording; where it says less than the residuals
    themselves, those count.
    """
    prior = np.diag(PRIOR_SD**-2.0)
    groups = np.array_split(np.arange(len(white.residual)), _PARTS)
    sums = [
        _normal(Turns(white.residual[part], white.jacobian[part], white.ends[part]))
        for part in groups
    ]
    normal = np.sum([item[0] for item in sums], axis=0)
    right = np.sum([item[1] for item in sums], axis=0)
    own = np.linalg.inv(normal + prior)
    whole = own @ right
    without = np.stack([np.linalg.solve(normal - a + prior, right - b) for a, b in sums])
    alone = np.stack([np.linalg.solve(a + prior, b) for a, b in sums])
    deviations = np.stack([np.sqrt(np.diag(np.linalg.inv(a + prior))) for a, _ in sums])
    away = without - without.mean(axis=0)
    jackknife = np.diag(away.T @ away) * (_PARTS - 1) / _PARTS
    grown = np.sqrt(np.maximum(jackknife / np.diag(own), 1.0))
    return alone - whole, deviations, own * np.outer(grown, grown)
