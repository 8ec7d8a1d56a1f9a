"""Priors on the motion of carriers: they are slow, and nothing exceeds what physics allows."""

from __future__ import annotations

import dataclasses

import numpy as np

from l2lidar_node.types import F64, STANDARD_GRAVITY
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, GRAVITY, VELOCITY, InertialState, update


class Carrier:
    """What carries the sensor, as far as its speed tells.

    Attributes
    ----------
    peak_speed : float
        Highest of late, as :func:`peak_speed_after` returns it [m/s]; 0 while nothing is known.
    """

    def __init__(self) -> None:
        self.peak_speed = 0.0

    @property
    def drives(self) -> bool:
        """Whether it drives, and is not moved by hand."""
        return is_driving_speed(self.peak_speed)

    def note_speed(self, state: InertialState, covariance: F64, seconds: float) -> None:
        """Take a velocity, given as to :func:`peak_speed_after`."""
        self.peak_speed = peak_speed_after(self.peak_speed, state, covariance, seconds)

    def note_found(self, state: InertialState, covariance: F64) -> None:
        """Take a velocity that a search has found, given as to :func:`peak_speed_after`.

        It is not known well, but whoever seems to drive by it is taken for a carrier that drives.
        """
        speed, sigma = _speed(state, covariance)
        if is_driving_speed(speed) and speed > tuning.PRIOR_LEARN_SIGMAS * sigma:
            self.peak_speed = max(self.peak_speed, speed)

    def may_drive(self, state: InertialState, covariance: F64) -> bool:
        """Return whether its velocity may be that of one that drives, given as for the others."""
        speed, sigma = _speed(state, covariance)
        return is_driving_speed(speed + tuning.PRIOR_LEARN_SIGMAS * sigma)

    def with_priors(
        self,
        state: InertialState,
        covariance: F64,
        seconds: float,
        *,
        least_speed: float,
        height_observed: bool,
    ) -> tuple[InertialState, F64]:
        """Return state and covariance with what is known of such carriers and of gravity.

        Parameters
        ----------
        state : InertialState
        covariance : ndarray, shape (18, 18)
        seconds : float
            Time since this was done last.
        least_speed : float
            The carrier may be so fast, whatever it has shown [m/s].
        height_observed : bool
            As for :func:`apply_zero_velocity_prior`.
        """
        peak = max(self.peak_speed, least_speed)
        state, covariance = apply_zero_velocity_prior(
            state, covariance, seconds, peak, height_observed=height_observed
        )
        return with_gravity_of_known_size(state, covariance)


def apply_zero_velocity_prior(
    state: InertialState,
    covariance: F64,
    seconds: float,
    peak_speed: float,
    *,
    height_observed: bool = True,
) -> tuple[InertialState, F64]:
    """Return state and covariance with a velocity that is hardly known drawn towards zero.

    Carriers are slow: a velocity of zero is measured all the time, but so coarsely that it only
    counts where nothing else measures the velocity. A carrier that drives may keep its velocity
    for minutes; measuring zero again and again would brake it. So its velocity has to be known
    worse than its peak speed, at which zero is as likely as any. One that is moved by hand stops
    and turns all the time, so zero counts for more, the more the slower it is. The vertical
    velocity is drawn whatever the carrier: what walks or drives comes back to its height. Where
    nothing observes the height for long, that is all that is known of it, and counts for more;
    slopes last for seconds, so such measurements do not add up to a better one.

    Parameters
    ----------
    state : InertialState
        Without gravity, nothing is vertical.
    covariance : ndarray, shape (18, 18)
    seconds : float
        Time since this was done last.
    peak_speed : float
        Of this carrier of late, as :func:`peak_speed_after` returns it [m/s]; 0 if nothing is
        known of it.
    height_observed : bool
        Whether sweeps have fixed the height of late.
    """
    if seconds <= 0.0:
        return state, covariance
    size = float(np.linalg.norm(state.gravity))
    vertical = state.gravity[None] / max(size, 1e-12)
    rise_sigma = float(np.sqrt((vertical @ covariance[VELOCITY, VELOCITY] @ vertical.T)[0, 0]))
    if not height_observed and rise_sigma >= tuning.RISE_FROM_SIGMA:
        variance = tuning.RISE_SPEED**2 / seconds
        state, covariance = _drawn_to_zero(state, covariance, vertical, variance)
        covariance = _known_no_better(covariance, vertical[0], tuning.RISE_FLOOR)
    least, speed = tuning.PRIOR_FROM_SIGMA, tuning.PRIOR_SPEED
    if is_driving_speed(peak_speed):
        least = peak_speed
    elif peak_speed > 0.0:
        least, speed = tuning.HAND_FROM_SIGMA, max(peak_speed, tuning.HAND_SPEED)
    if np.linalg.eigvalsh(covariance[VELOCITY, VELOCITY])[-1] >= least**2:
        return _drawn_to_zero(state, covariance, np.eye(3), speed**2 / seconds)
    if rise_sigma >= tuning.PRIOR_FROM_SIGMA:
        return _drawn_to_zero(state, covariance, vertical, tuning.PRIOR_SPEED**2 / seconds)
    return state, covariance


def _drawn_to_zero(
    state: InertialState, covariance: F64, axes: F64, variance: float
) -> tuple[InertialState, F64]:
    """Return state and covariance with the velocity along axes (K, 3) measured as zero.

    The variance is that of each measurement [m²/s²].
    """
    jacobian = np.zeros((len(axes), ERRORS))
    jacobian[:, VELOCITY] = axes
    noise = variance * np.eye(len(axes))
    found = update(state, covariance, -axes @ state.velocity, jacobian, noise)
    return found.state, found.covariance


def _known_no_better(covariance: F64, axis: F64, sigma: float) -> F64:
    """Return a covariance with a velocity along an axis (3,) known to a sigma [m/s] at best."""
    out = covariance.copy()
    missing = sigma**2 - float(axis @ covariance[VELOCITY, VELOCITY] @ axis)
    out[VELOCITY, VELOCITY] += max(missing, 0.0) * np.outer(axis, axis)
    return out


def is_driving_speed(speed: float) -> bool:
    """Return whether a carrier that has been so fast [m/s] drives, and is not moved by hand."""
    return speed > tuning.DRIVING_SPEED


def peak_speed_after(
    before: float, state: InertialState, covariance: F64, seconds: float
) -> float:
    """Return a carrier's highest speed of late, as far as it is known [m/s].

    A peak detector: it rises at once and decays exponentially.

    Parameters
    ----------
    before : float
        The peak so far [m/s].
    state : InertialState
    covariance : ndarray, shape (18, 18)
        While the velocity is hardly known, nothing is forgotten, and only the speed counts that it
        has at least.
    seconds : float
        Time since this was done last.
    """
    speed, sigma = _speed(state, covariance)
    if sigma > tuning.PRIOR_LEARN_SIGMA:
        return max(before, speed - tuning.PRIOR_LEARN_SIGMAS * sigma)
    return max(before * float(np.exp(-seconds / tuning.PRIOR_MEMORY_S)), speed)


def _speed(state: InertialState, covariance: F64) -> tuple[float, float]:
    """Return the speed and the sigma of the velocity along its least certain axis [m/s]."""
    variance = float(np.linalg.eigvalsh(covariance[VELOCITY, VELOCITY])[-1])
    return float(np.linalg.norm(state.velocity)), float(np.sqrt(variance))


def bound_speed(
    state: InertialState, covariance: F64, max_speed: float
) -> tuple[InertialState, F64]:
    """Return state and covariance with a speed that no carrier of this kind has brought back.

    What is corrected with the velocity is what its covariance ties to it: a place that ran away
    comes back as far as the wrong velocity explains it. How the estimate came to be is not known,
    so the covariance does not shrink, and the velocity's allows for the whole excess.

    Parameters
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    max_speed : float
        [m/s]; slower states are returned as they are.
    """
    speed = float(np.linalg.norm(state.velocity))
    if speed <= max_speed:
        return state, covariance
    ahead = state.velocity / speed
    excess = speed - max_speed
    widened = covariance.copy()
    widened[VELOCITY, VELOCITY] += excess**2 * np.outer(ahead, ahead)
    jacobian = np.zeros((1, ERRORS))
    jacobian[0, VELOCITY] = ahead
    noise = np.array([[(tuning.SPEED_BOUND_SHARE * max_speed) ** 2]])
    found = update(state, widened, np.array([-excess]), jacobian, noise)
    velocity = found.state.velocity
    velocity = velocity * min(1.0, max_speed / float(np.linalg.norm(velocity)))
    return dataclasses.replace(found.state, velocity=velocity), widened


def with_gravity_of_known_size(state: InertialState, covariance: F64) -> tuple[InertialState, F64]:
    """Return state and covariance with a gravity whose size is that of the earth again.

    Only its direction has to be found. Where corrections have changed the size by more than it is
    uncertain by, the size counts as measured; what is tied to it, as the bias along the vertical,
    is corrected with it.

    Parameters
    ----------
    state : InertialState
        Without gravity, as for an accelerometer that is not trusted, it is returned as it is.
    covariance : ndarray, shape (18, 18)
    """
    size = float(np.linalg.norm(state.gravity))
    excess = size - STANDARD_GRAVITY
    if size == 0.0 or abs(excess) <= tuning.GRAVITY_SIZE_SIGMA:
        return state, covariance
    jacobian = np.zeros((1, ERRORS))
    jacobian[0, GRAVITY] = state.gravity / size
    noise = np.array([[tuning.GRAVITY_SIZE_SIGMA**2]])
    found = update(state, covariance, np.array([-excess]), jacobian, noise)
    return found.state, found.covariance


def biases_are_plausible(state: InertialState) -> bool:
    """Return whether no bias is larger than that of any sensor of this kind."""
    return bool(
        np.abs(state.gyro_bias).max() <= tuning.MOST_GYRO_BIAS
        and np.abs(state.accel_bias).max() <= tuning.MOST_ACCEL_BIAS
    )
