"""Checks of the IMU samples: units, norms, covariances, orientation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.check.observation import Observation
from l2lidar_node.check.requirements import Consumer, Finding, Use, not_judged, ok
from l2lidar_node.types import F64, STANDARD_GRAVITY, Level

_SUBJECT: Final = "imu"
_MAX_RATE: Final = 40.0  # rad/s; the L2's gyro ends at 2000 deg/s, which is 35
_COVARIANCES: Final = (
    ("orientation", "roll_covar, pitch_covar and yaw_covar"),
    ("angular_velocity", "gyro_x_covar, gyro_y_covar and gyro_z_covar"),
    ("linear_acceleration", "accel_x_covar, accel_y_covar and accel_z_covar"),
)


def check(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    """Yield findings on the values of the samples; there is at least one."""
    imu = seen.imu
    finite = np.isfinite(imu["angular_velocity"]).all(axis=1)
    finite &= np.isfinite(imu["linear_acceleration"]).all(axis=1)
    finite &= np.isfinite(imu["orientation_wxyz"]).all(axis=1)
    if not finite.all():
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "values",
            f"{int((~finite).sum())} of {len(imu)} samples have NaN or infinite values",
            "fix the publisher",
        )
        imu = imu[finite]
    if not len(imu):
        return
    yield _check_acceleration(imu["linear_acceleration"], consumer)
    yield _check_rate(imu["angular_velocity"])
    yield from _check_covariances(imu)


def _check_acceleration(acceleration: F64, consumer: Consumer) -> Finding:
    norm = float(np.median(np.linalg.norm(acceleration, axis=1)))
    text = f"the acceleration's norm is {norm:.4g} in the median"
    if abs(norm - STANDARD_GRAVITY) < 0.08 * STANDARD_GRAVITY:
        return ok(_SUBJECT, "acceleration", f"{text}: m/s^2 with gravity")
    if 0.9 < norm < 1.1:
        level = Level.WARN if consumer.any_acceleration_unit else Level.ERROR
        why, fix = "this is in g, but m/s^2 is required", "multiply by 9.80665; the driver does"
    elif 17.0 < norm < 23.0:
        level = Level.WARN if consumer.any_acceleration_unit else Level.ERROR
        why = "twice gravity, a fault of an L2 that was tilted at power-on"
        fix = "power-cycle the L2 while it is upright and still"
    elif norm < 0.5:
        level, why = Level.ERROR, "it lacks gravity, which is required"
        fix = "publish what the accelerometer measures, +9.81 upwards at rest"
    else:
        level, why = Level.WARN, "9.81 m/s^2 is required at rest"
        fix = "unless it was moving hard, power-cycle the L2 while it is upright and still"
    return Finding(level, _SUBJECT, "acceleration", f"{text}: {why}", fix)


def _check_rate(rates: F64) -> Finding:
    greatest = float(np.linalg.norm(rates, axis=1).max())
    if greatest > _MAX_RATE:
        return Finding(
            Level.ERROR,
            _SUBJECT,
            "gyro",
            f"rates are up to {greatest:.4g}, more than the gyro can measure in rad/s "
            "(2000 deg/s are 34.9); rad/s is required",
            "multiply by pi / 180; the driver publishes rad/s",
        )
    if greatest == 0.0:
        return Finding(
            Level.WARN,
            _SUBJECT,
            "gyro",
            "all rates are exactly 0, which no gyro measures",
            "compare with the driver's own IMU topic",
        )
    return ok(_SUBJECT, "gyro", f"rates are up to {greatest:.3g} rad/s")


def _check_covariances(imu: NDArray[np.void]) -> Iterator[Finding]:
    zero, wrong = [], []
    for name, parameters in _COVARIANCES:
        covariance = imu[f"{name}_covariance"]
        diagonal = covariance[:, (0, 4, 8)]
        if (covariance == 0).all():
            zero.append(parameters)
        elif not np.isfinite(covariance).all() or (
            (diagonal < 0).any() and not (covariance[:, 0] == -1).all()
        ):
            wrong.append(name)
    if wrong:
        yield Finding(
            Level.WARN,
            _SUBJECT,
            "covariance-invalid",
            f"the covariance of {', '.join(wrong)} is negative or not finite",
            "variances must be 0 or more; only -1 as the first number is allowed (not measured)",
        )
    if zero:
        yield Finding(
            Level.WARN,
            _SUBJECT,
            "covariance-zero",
            "all covariances are 0, which means unknown",
            f"set {'; '.join(zero)}",
        )
    if not zero and not wrong:
        yield ok(_SUBJECT, "covariance", "covariances are given")


def missing(consumer: Consumer) -> Iterator[Finding]:
    """Yield the findings for a topic without samples."""
    if consumer.imu is not Use.IGNORED:
        yield Finding(
            consumer.imu.level,
            _SUBJECT,
            "imu-missing",
            f"no IMU samples; {consumer.title} "
            f"{'needs' if consumer.imu is Use.NEEDED else 'can use'} them",
            "set enable_IMU_publishing: true",
        )


_USABLE_NORM: Final = 0.1  # below that LIO-SAM shuts down
_MAX_ANGLE_DEG: Final = 10.0
_MOST: Final = 2000
_WINDOW_S: Final = 0.1
_TURNED_RAD: Final = 0.05


def unit(wxyz: F64) -> F64:
    """Return quaternions, (N, 4), of norm 1; those near 0 become the identity."""
    norms = np.linalg.norm(wxyz, axis=1)
    units = np.tile([1.0, 0.0, 0.0, 0.0], (len(wxyz), 1))
    usable = norms > 1e-9
    units[usable] = wxyz[usable] / norms[usable, None]
    return units


def check_orientation(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    """Yield findings on the orientations; there is at least one sample."""
    imu = seen.imu[np.isfinite(seen.imu["orientation_wxyz"]).all(axis=1)]
    imu = imu[np.isfinite(imu["linear_acceleration"]).all(axis=1)]
    imu = imu[np.isfinite(imu["angular_velocity"]).all(axis=1)]
    if not len(imu):
        return
    norms = np.linalg.norm(imu["orientation_wxyz"], axis=1)
    if (norms < _USABLE_NORM).any():
        if consumer.orientation is Use.IGNORED:
            yield ok(_SUBJECT, "orientation", f"none, and {consumer.title} needs none")
            return
        yield Finding(
            consumer.orientation.level,
            _SUBJECT,
            "orientation-norm",
            f"{int((norms < _USABLE_NORM).sum())} of {len(imu)} orientations are (near) 0; "
            f"{consumer.title} requires unit quaternions"
            + (" and shuts down" if consumer.orientation is Use.NEEDED else ""),
            "use the driver's IMU topic, which has the L2's own orientation",
        )
        return
    if np.abs(norms - 1.0).max() > 0.02:
        yield Finding(
            Level.WARN,
            _SUBJECT,
            "orientation-norm",
            f"norms of orientations are {norms.min():.3f} to {norms.max():.3f}, not 1",
            "normalize them; the driver does",
        )
    yield _check_gravity(imu[:: max(len(imu) // _MOST, 1)], consumer)
    yield from _check_rates(imu)


def _check_gravity(imu: NDArray[np.void], consumer: Consumer) -> Finding:
    q, acceleration = unit(imu["orientation_wxyz"]), imu["linear_acceleration"]
    norms = np.linalg.norm(acceleration, axis=1)
    calm = np.abs(norms - np.median(norms)) <= 0.1 * np.median(norms)
    q, acceleration = q[calm & (norms > 0)], acceleration[calm & (norms > 0)]
    if not len(q):
        return not_judged(_SUBJECT, "orientation", "no acceleration to compare with")
    angle = _from_vertical(q, acceleration)
    text = f"gravity by accelerometer and by orientation are {angle:.3g} deg apart"
    if angle < _MAX_ANGLE_DEG:
        return ok(_SUBJECT, "orientation", text)
    variants = {
        "its numbers are in the order w, x, y, z instead of x, y, z, w": np.roll(q, -1, axis=1),
        "its numbers are in the order z, w, x, y instead of x, y, z, w": np.roll(q, 1, axis=1),
        "it is inverted (world to IMU)": q * [1.0, -1.0, -1.0, -1.0],
    }
    guess = min(variants, key=lambda name: _from_vertical(variants[name], acceleration))
    fits = _from_vertical(variants[guess], acceleration) < _MAX_ANGLE_DEG
    level = Level.ERROR if consumer.orientation is Use.NEEDED else Level.WARN
    return Finding(
        level,
        _SUBJECT,
        "orientation-gravity",
        f"{text}; " + (f"it fits if {guess}" if fits else "IMU to a z-up world is required"),
        "use the driver's IMU topic"
        if fits
        else "power-cycle the L2 while it is upright and still",
    )


def _from_vertical(q: F64, acceleration: F64) -> float:
    """Return the median angle of accelerations from the world's z axis [deg]."""
    up = rotations.rotate(q, acceleration)
    cosine = up[:, 2] / np.linalg.norm(up, axis=1)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))


def _check_rates(imu: NDArray[np.void]) -> Iterator[Finding]:
    """Compare how far rates and orientations turn in windows of a tenth of a second."""
    stamps = imu["stamp"].astype(np.float64) / 1e9
    steps = np.diff(stamps)
    period = float(np.median(steps)) if len(steps) else 0.0
    if period <= 0:
        return
    stride = max(round(_WINDOW_S / period), 1)
    q = unit(imu["orientation_wxyz"])[::stride]
    sums = np.cumsum(imu["angular_velocity"], axis=0) * period
    by_rate = np.linalg.norm(np.diff(sums[::stride], axis=0), axis=1)
    cosine = np.abs(np.sum(q[1:] * q[:-1], axis=1))
    by_orientation = 2.0 * np.arccos(np.clip(cosine, 0.0, 1.0))
    turned = (by_orientation > _TURNED_RAD) & (by_orientation < 2.0)
    if turned.sum() < 5:
        yield not_judged(
            _SUBJECT, "gyro-unit", "too little rotation to compare with the orientations"
        )
        return
    ratio = float(np.median(by_rate[turned] / by_orientation[turned]))
    text = f"integrated rates are {ratio:.3g} times the rotation of the orientations"
    if 0.7 < ratio < 1.4:
        yield ok(_SUBJECT, "gyro-unit", f"{text}: rad/s")
    elif 30.0 < ratio < 100.0:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "gyro-unit",
            f"{text}: they are in deg/s, but rad/s is required",
            "multiply by pi / 180; the driver publishes rad/s",
        )
    else:
        half = 0.4 < ratio < 0.6
        yield Finding(
            Level.WARN,
            _SUBJECT,
            "gyro-unit",
            text
            + (
                ": the stamps run at half speed"
                if half
                else ": the unit, the axes or the stamps are wrong"
            ),
            "set enable_l2_time_correction: true" if half else "use the driver's IMU topic",
        )
