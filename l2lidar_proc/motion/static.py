"""Tells from the IMU alone whether the sensor stands still, in spite of its head turning.

The head shakes gyro and accelerometer at its own frequency, by how much differs between units. So
levels are learned at rest rather than prescribed: a first second in which nothing drifts becomes
the reference, and whatever exceeds the spread seen there by several times is motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.rotations import F64

_BLOCK: Final = 25  # samples: 0.1 s, what a sudden start needs to be seen
_SIGMAS: Final = 5.0
# What counts as no change however quiet the sensor is.
_RATE_FLOOR: Final = 0.005  # [rad/s]
_FORCE_FLOOR: Final = 0.03  # [m/s^2]
_RATE_SPREAD: Final = 0.5  # [rad/s] a shaking beyond this is no rest
_FORCE_SPREAD: Final = 0.6  # [m/s^2]


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """What the IMU says while the sensor stands still.

    Attributes
    ----------
    rate, rate_spread : ndarray, shape (3,)
        Mean, which is the bias, and standard deviation of the gyro [rad/s], IMU axes.
    force, force_spread : ndarray, shape (3,)
        Mean and standard deviation of the accelerometer [m/s^2], IMU axes.
    """

    rate: F64
    rate_spread: F64
    force: F64
    force_spread: F64


def at_rest(
    samples: Samples, bias: F64, margin: float, *, sigmas: float = _SIGMAS, least: int = 100
) -> Rest | None:
    """Return what the IMU says at rest, None if it moved.

    Parameters
    ----------
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        About a second.
    bias : ndarray, shape (3,)
        What is known of the gyro's bias [rad/s].
    margin : float
        How wrong that may be [rad/s]: the mean rate may differ so much from it.
    sigmas : float
        And so many standard deviations of the mean.
    least : int
        Fewer samples are not enough.

    Notes
    -----
    The mean is weighted by a Hann window, whose side lobes all but remove the lines of the head at
    more than two periods per window: 4 Hz and above for a second.
    """
    if len(samples) < least:
        return None
    rates, forces = samples["angular_velocity"], samples["linear_acceleration"]
    found = Rest(_hann_mean(rates), rates.std(axis=0), _hann_mean(forces), forces.std(axis=0))
    if found.rate_spread.max() > _RATE_SPREAD or found.force_spread.max() > _FORCE_SPREAD:
        return None
    quarter = len(samples) // 4
    if _drifts(rates, found.rate_spread, quarter, 2.0 * _RATE_FLOOR):
        return None
    if _drifts(forces, found.force_spread, quarter, 2.0 * _FORCE_FLOOR):
        return None
    limit = margin + sigmas * found.rate_spread * np.sqrt(1.5 / len(samples))
    return found if (np.abs(found.rate - bias) <= limit).all() else None


def still_like(samples: Samples, rest: Rest) -> bool:
    """Return whether samples say no more than those of a known rest did.

    Parameters
    ----------
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        Best a head turn or more; fewer than 25 samples never count as still.
    rest : Rest
    """
    return _agrees(
        samples["angular_velocity"], rest.rate, rest.rate_spread, _RATE_FLOOR
    ) and _agrees(samples["linear_acceleration"], rest.force, rest.force_spread, _FORCE_FLOOR)


def blended(rest: Rest, newer: Rest, share: float) -> Rest:
    """Return a rest whose means have moved towards newer ones; the spreads stay."""
    return Rest(
        rest.rate + share * (newer.rate - rest.rate),
        rest.rate_spread,
        rest.force + share * (newer.force - rest.force),
        rest.force_spread,
    )


def _hann_mean(values: F64) -> F64:
    weights = np.hanning(len(values) + 2)[1:-1]
    return np.asarray(weights @ values / weights.sum())


def _drifts(values: F64, spread: F64, quarter: int, floor: float) -> bool:
    """Return whether the means of the quarters differ by more than chance lets them."""
    means = values[: 4 * quarter].reshape(4, quarter, 3).mean(axis=1)
    return bool((np.ptp(means, axis=0) > floor + _SIGMAS * spread * np.sqrt(2.0 / quarter)).any())


def _agrees(values: F64, mean: F64, spread: F64, floor: float) -> bool:
    blocks = len(values) // _BLOCK
    if not blocks:
        return False
    if (
        np.abs(values.mean(axis=0) - mean) > floor + _SIGMAS * spread / np.sqrt(len(values))
    ).any():
        return False
    shaped = values[-blocks * _BLOCK :].reshape(blocks, _BLOCK, 3)
    # a line of the head moves the mean of a block by up to its amplitude, 1.4 times its spread
    if (np.abs(shaped.mean(axis=1) - mean) > 2.0 * (floor + spread)).any():
        return False
    return bool((shaped.std(axis=1) <= 2.0 * (floor + spread)).all())
