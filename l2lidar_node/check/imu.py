"""Checks the values of IMU samples: units, norms, covariances."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.check.findings import Finding, Level, ok
from l2lidar_node.check.observation import Observation
from l2lidar_node.check.requirements import Consumer, Use

F64 = NDArray[np.float64]

_SUBJECT: Final = "imu"
_G: Final = 9.80665
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
            "the publisher has to be mended",
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
    if abs(norm - _G) < 0.08 * _G:
        return ok(_SUBJECT, "acceleration", f"{text}: m/s^2 with gravity")
    if 0.9 < norm < 1.1:
        level = Level.WARN if consumer.any_acceleration_unit else Level.ERROR
        why, fix = "that is g, demanded is m/s^2", "multiply by 9.80665; the driver does"
    elif 17.0 < norm < 23.0:
        level = Level.WARN if consumer.any_acceleration_unit else Level.ERROR
        why = "twice gravity, a fault of L2s that were switched on while tilted"
        fix = "switch the L2 off and on while it stands upright and still"
    elif norm < 0.5:
        level, why = Level.ERROR, "there is no gravity in it, which is demanded"
        fix = "publish what the accelerometer measures, +9.81 upwards at rest"
    else:
        level, why = Level.WARN, "demanded is 9.81 m/s^2 at rest"
        fix = "was it moving hard? else switch the L2 off and on while it stands upright and still"
    return Finding(level, _SUBJECT, "acceleration", f"{text}: {why}", fix)


def _check_rate(rates: F64) -> Finding:
    greatest = float(np.linalg.norm(rates, axis=1).max())
    if greatest > _MAX_RATE:
        return Finding(
            Level.ERROR,
            _SUBJECT,
            "gyro",
            f"rates are up to {greatest:.4g}, more than the gyro can measure in rad/s "
            "(2000 deg/s are 34.9); demanded is rad/s",
            "multiply by pi / 180; the driver publishes rad/s",
        )
    if greatest == 0.0:
        return Finding(
            Level.WARN,
            _SUBJECT,
            "gyro",
            "all rates are exactly 0, as no gyro measures",
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
            "variances are 0 or more; only -1 as the first number has a meaning (not measured)",
        )
    if zero:
        yield Finding(
            Level.WARN,
            _SUBJECT,
            "covariance-zero",
            "covariances are 0 throughout, which means not known",
            f"set {'; '.join(zero)}",
        )
    if not zero and not wrong:
        yield ok(_SUBJECT, "covariance", "covariances are given")


def missing(consumer: Consumer) -> Iterator[Finding]:
    """Yield what there is to say where no sample came."""
    if consumer.imu is not Use.IGNORED:
        yield Finding(
            consumer.imu.level,
            _SUBJECT,
            "imu-missing",
            f"no IMU samples; {consumer.title} "
            f"{'needs' if consumer.imu is Use.NEEDED else 'can use'} them",
            "set enable_IMU_publishing: true",
        )
