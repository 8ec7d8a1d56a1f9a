"""Static detection from IMU samples, despite the spinning head, and the first state.

The head shakes gyro and accelerometer at its own frequency, by an amount that differs between
units. So levels are learned rather than prescribed: a first second in which no mean drifts becomes
the reference, and whatever exceeds its spread by several times is motion.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.types import F64, STANDARD_GRAVITY, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import (
    ACCEL_BIAS,
    ERRORS,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    VELOCITY,
    InertialState,
)
from l2lidar_proc.motion.imu_buffer import Samples


@dataclass(frozen=True, slots=True, eq=False)
class StaticReference:
    """Readings of the IMU of a sensor at rest.

    Attributes
    ----------
    rate, rate_spread : ndarray, shape (3,)
        Mean, which is the bias, and standard deviation of the gyro [rad/s].
    force, force_spread : ndarray, shape (3,)
        Mean and standard deviation of the accelerometer [m/s^2].
    """

    rate: F64
    rate_spread: F64
    force: F64
    force_spread: F64

    def blended(self, newer: StaticReference, share: float) -> StaticReference:
        """Return a reference whose means have moved towards newer ones; the spreads stay."""
        return StaticReference(
            self.rate + share * (newer.rate - self.rate),
            self.rate_spread,
            self.force + share * (newer.force - self.force),
            self.force_spread,
        )

    def matches(self, samples: Samples) -> bool:
        """Return whether samples show no more than this reference.

        Parameters
        ----------
        samples : ndarray, shape (N,), dtype IMU_SAMPLE
            Best a turn of the head or more; less than a tenth of a second, or fewer than 10
            samples, never match.
        """
        size = max(_count(tuning.STATIC_BLOCK_S, samples), tuning.STATIC_BLOCK_LEAST)
        return _matches(
            samples["angular_velocity"],
            size,
            self.rate,
            self.rate_spread,
            tuning.STATIC_RATE_FLOOR,
        ) and _matches(
            samples["linear_acceleration"],
            size,
            self.force,
            self.force_spread,
            tuning.STATIC_FORCE_FLOOR,
        )


class StaticTest(NamedTuple):
    """How much the means of parts of a static stretch may differ.

    Attributes
    ----------
    parts : int
        The stretch is split into so many.
    rate, force : float
        Largest difference between the means of two parts [rad/s, m/s^2],
    sigmas : float
        and so many standard deviations of that difference besides.
    """

    parts: int
    rate: float
    force: float
    sigmas: float


LEARNING: Final = StaticTest(
    4,
    2.0 * tuning.STATIC_RATE_FLOOR,
    2.0 * tuning.STATIC_FORCE_FLOOR,
    tuning.STATIC_SIGMAS,
)
"""Strict: what passes teaches the gyro bias."""

PLAUSIBLE: Final = StaticTest(
    6,
    tuning.START_RATE_CHANGE,
    tuning.START_FORCE_CHANGE,
    tuning.STATIC_SIGMAS,
)
"""Loose: what passes may be at rest, and the clouds decide."""


def static_reference(
    samples: Samples,
    bias: F64,
    margin: float,
    *,
    sigmas: float = tuning.STATIC_SIGMAS,
    least_s: float = tuning.STATIC_LEARN_S,
) -> StaticReference | None:
    """Return the readings of a sensor at rest, None if it moved.

    Parameters
    ----------
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        About a second.
    bias : ndarray, shape (3,)
        Gyro bias as far as it is known [rad/s].
    margin : float
        How wrong that may be [rad/s]: the mean rate may differ so much from it,
    sigmas : float
        and so many standard deviations of the mean.
    least_s : float
        Samples of a shorter time are not enough [s].

    Notes
    -----
    The mean is weighted by a Hann window, whose side lobes all but remove the lines of the head at
    more than two periods per window: 4 Hz and above for a second.
    """
    if len(samples) < _count(least_s, samples):
        return None
    rates, forces = samples["angular_velocity"], samples["linear_acceleration"]
    found = StaticReference(
        _hann_mean(rates), rates.std(axis=0), _hann_mean(forces), forces.std(axis=0)
    )
    shakes = (
        found.rate_spread.max() > tuning.STATIC_RATE_SPREAD
        or found.force_spread.max() > tuning.STATIC_VIBRATION
        or _without_vibration(samples).std(axis=0).max() > tuning.STATIC_FORCE_SPREAD
    )
    if shakes or _drifts(samples, found.rate_spread, found.force_spread, LEARNING):
        return None
    limit = margin + sigmas * found.rate_spread * np.sqrt(1.5 / len(samples))
    return found if (np.abs(found.rate - bias) <= limit).all() else None


def may_be_static(samples: Samples) -> bool:
    """Return whether the first samples of all allow the sensor to be at rest.

    Parameters
    ----------
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
    """
    if len(samples) < tuning.START_SAMPLES:
        return False
    rates, forces = samples["angular_velocity"], samples["linear_acceleration"]
    return bool(
        np.abs(rates.mean(axis=0)).max() < tuning.START_RATE
        and not _drifts(samples, white_noise(rates), white_noise(forces), PLAUSIBLE)
    )


class NoiseSpectrum(NamedTuple):
    """What the spectrum of a sensor's samples shows of its noise.

    Attributes
    ----------
    floor : float
        Standard deviation of the white noise of a sample, of the worst axis.
    vibration : float
        What vibrations integrate to, standard deviation, of the worst axis: an error of the angle
        [rad] for angular velocities, of the velocity [m/s] for forces. It oscillates about zero
        and does not add up.
    """

    floor: float
    vibration: float


def sample_period_s(samples: Samples) -> float:
    """Return the time [s] from one sample (N,) of an IMU to the next, to a tenth of a millisecond.

    Stamps jitter; an L2 has exactly 250 Hz, which counts where samples are too few.
    """
    if len(samples) < tuning.PERIOD_SAMPLES:
        return tuning.IMU_PERIOD_S
    period = round(float(np.median(np.diff(samples["stamp"]))) * 1e-9, 4)
    return max(period, 1e-4)


def noise_spectrum(values: F64, period_s: float) -> NoiseSpectrum:
    """Return the noise floor of samples at the IMU's rate, and the effect of vibrations.

    Motors and vibrations are lines of the spectrum; the motion of a carrier ends below
    :data:`tuning.NOISE_FROM_HZ`. A few lines do not move the median of the periodogram above it
    (modified periodogram with a Hann window, Welch 1967). The median of white noise is its mean
    times ln 2: bins have the chi-squared distribution of two degrees of freedom. A line of
    amplitude a at the frequency f integrates to one of a / (2 pi f).

    Parameters
    ----------
    values : ndarray, shape (N, 3)
        Angular velocities [rad/s] or forces [m/s^2]. Too few of them to resolve lines show only
        their :func:`white_noise`.
    period_s : float
        From one to the next [s].
    """
    count = len(values)
    if count < tuning.NOISE_LEAST_SAMPLES:
        return NoiseSpectrum(white_noise(values), 0.0)
    window = np.hanning(count)[:, None]
    amplitudes = np.fft.rfft((values - values.mean(axis=0)) * window, axis=0)
    frequencies = np.fft.rfftfreq(count, period_s)
    high = frequencies >= tuning.NOISE_FROM_HZ
    power = np.square(np.abs(amplitudes[high])) / np.square(window).sum()  # white: the variance
    integrated = power / np.square(2.0 * np.pi * frequencies[high, None])
    return NoiseSpectrum(
        float(np.sqrt(np.median(power, axis=0).max() / np.log(2.0))),
        float(np.sqrt(2.0 / count * integrated.sum(axis=0).max())),
    )


def white_noise(values: F64) -> float:
    """Return the standard deviation of the white part of samples (N, 3), despite slow motion.

    From the second differences, whose variance is 1.5 times that of white noise; the median
    ignores shocks.
    """
    if len(values) < 8:
        return 0.0
    bend = np.abs(values[1:-1] - 0.5 * (values[:-2] + values[2:]))
    return float(np.median(bend, axis=0).max() * 1.4826 / np.sqrt(1.5))


def gravity_is_plausible(samples: Samples, *, at_rest: bool) -> bool:
    """Return whether the accelerometer of a unit is sound, judged by the size of its mean.

    Parameters
    ----------
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        About a second; none is not plausible.
    at_rest : bool
        The mean force is gravity; otherwise the mean of the sizes is near it.
    """
    if not len(samples):
        return False
    forces = samples["linear_acceleration"]
    if at_rest:
        size = float(np.linalg.norm(forces.mean(axis=0)))
        low, high = tuning.GRAVITY_AT_REST
    else:
        size = float(np.linalg.norm(forces, axis=1).mean())
        low, high = tuning.GRAVITY_IN_MOTION
    return low < size < high


def _count(seconds: float, samples: Samples) -> int:
    """Return how many samples of this IMU (N,) a time [s] has, at least one."""
    return max(round(seconds / sample_period_s(samples)), 1)


def _without_vibration(samples: Samples) -> F64:
    """Return the mean forces of successive parts of samples, in which motors hardly show."""
    size, values = _count(tuning.STATIC_SMOOTHED_S, samples), samples["linear_acceleration"]
    return np.asarray(values[: len(values) // size * size].reshape(-1, size, 3).mean(axis=1))


def _hann_mean(values: F64) -> F64:
    weights = np.hanning(len(values) + 2)[1:-1]
    return np.asarray(weights @ values / weights.sum())


def _drifts(
    samples: Samples, rate_noise: F64 | float, force_noise: F64 | float, test: StaticTest
) -> bool:
    """Return whether the means of the parts differ by more than a test allows."""
    for name, noise, floor in (
        ("angular_velocity", rate_noise, test.rate),
        ("linear_acceleration", force_noise, test.force),
    ):
        parts = np.array_split(samples[name], test.parts)
        means = np.array([part.mean(axis=0) for part in parts])
        chance = test.sigmas * noise * np.sqrt(2.0 * test.parts / len(samples))
        if (np.ptp(means, axis=0) > floor + chance).any():
            return True
    return False


def _matches(values: F64, size: int, mean: F64, spread: F64, floor: float) -> bool:
    """Return whether values (N, 3), and each block of so many, have this mean and spread."""
    blocks = len(values) // size
    if not blocks:
        return False
    chance = tuning.STATIC_SIGMAS * spread / np.sqrt(len(values))
    if (np.abs(values.mean(axis=0) - mean) > floor + chance).any():
        return False
    shaped = values[-blocks * size :].reshape(blocks, size, 3)
    # a line of the head moves the mean of a block by up to its amplitude, 1.4 times its spread
    if (np.abs(shaped.mean(axis=1) - mean) > 2.0 * (floor + spread)).any():
        return False
    return bool((shaped.std(axis=1) <= 2.0 * (floor + spread)).all())


@dataclass(frozen=True, slots=True, eq=False)
class InitialState:
    """State from IMU samples alone.

    Attributes
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    at_rest : bool
    gravity_trusted : bool
        False without samples and with an accelerometer whose norm is not that of gravity.
    """

    state: InertialState
    covariance: F64
    at_rest: bool
    gravity_trusted: bool

    def leveled(self, up: F64, sigma: float) -> InitialState:
        """Return the first state in a map whose vertical is another unit vector (3,) of this one.

        How well that is known, is said by the sigma of gravity's level components [m/s^2].
        """
        turn = rotations.matrices(rotations.between(up, (0.0, 0.0, 1.0)))
        state = dataclasses.replace(self.state, rotation=turn @ self.state.rotation)
        covariance = self.covariance.copy()
        sigmas = np.array([sigma, sigma, tuning.GRAVITY_SIZE_SIGMA])
        covariance[GRAVITY, GRAVITY] = np.diag(sigmas**2)
        return dataclasses.replace(self, state=state, covariance=covariance)


def initial_state(samples: Samples, stamp: HostNs, may_rest: bool = True) -> InitialState:
    """Return the state at the origin of a new map frame, level if gravity is trusted.

    Parameters
    ----------
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        Of the last moments up to and around the stamp, cloud axes; may be empty.
    stamp : HostNs
    may_rest : bool
        False where the sensor is known to move, however quiet the IMU is.
    """
    force = samples["linear_acceleration"].mean(axis=0) if len(samples) else np.zeros(3)
    norm = float(np.linalg.norm(force))
    trusted = gravity_is_plausible(samples, at_rest=True) or (
        not may_rest and gravity_is_plausible(samples, at_rest=False)
    )
    at_rest = may_rest and may_be_static(samples)
    rotation = np.eye(3)
    if trusted:
        rotation = rotations.matrices(rotations.between(force, (0.0, 0.0, 1.0)))
    # at rest the excess of the force over gravity is bias; its direction remains ambiguous
    g = STANDARD_GRAVITY
    excess = force * (1.0 - g / norm) if trusted and at_rest else np.zeros(3)
    state = InertialState(
        stamp,
        rotation,
        np.zeros(3),
        np.zeros(3),
        samples["angular_velocity"].mean(axis=0) if at_rest else np.zeros(3),
        excess,
        np.array([0.0, 0.0, -g]) if trusted else np.zeros(3),
    )
    return InitialState(state, _covariance(rotation, at_rest, trusted), at_rest, trusted)


def _covariance(rotation: F64, at_rest: bool, trusted: bool) -> F64:
    """Return how well the first state is known, shape (18, 18)."""
    known = tuning.INITIAL_AT_REST if at_rest else tuning.INITIAL_IN_MOTION
    sigma = np.zeros(ERRORS)
    sigma[ROTATION] = sigma[POSITION] = tuning.START_POSE_SIGMA
    sigma[VELOCITY] = known.velocity
    sigma[GYRO_BIAS] = known.gyro_bias
    sigma[ACCEL_BIAS] = known.accel_bias
    # in motion the mean force is off by the motion too; the size of gravity is known
    sigma[GRAVITY] = known.gravity
    if not trusted:
        sigma[GRAVITY] = 0.0  # there is none in the model, and none may be learned
    covariance = np.diag(sigma**2)
    if at_rest and trusted:
        # bias and tilt are not separable, but their sum is what was measured: so the one that is
        # wrong across gravity is wrong by as much as the other
        both = np.zeros((ERRORS, 2))
        both[GRAVITY] = np.eye(3)[:, :2]
        both[ACCEL_BIAS] = rotation.T[:, :2]
        covariance += tuning.ACCEL_BIAS_SIGMA**2 * both @ both.T
    return covariance
