"""Velocity along bare walls, from how their brightness and depth change along the way.

Only doors, niches and marks fix the position along a bare wall. Registration cannot use them:
thinning leaves a point or two of each, and the cells of the map are wider than they are. A sweep
of an L2 samples a wall in upright lines up to half a meter apart, elsewhere in each sweep. Placed
with the right velocity, the lines of some seconds show each edge once. With a wrong one, bright
and dark lines, or near and deep ones, alternate around the edge. So the velocity at which
neighboring lines differ least is the most likely one.

The profile uses no map, so it cannot confirm errors of the map, and it does not have to tell one
edge from another. Objects in front of a wall are left out: people walk at a speed of their own.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import F64, I64
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ACCEL_BIAS, ERRORS, GRAVITY, VELOCITY, InertialState
from l2lidar_proc.motion.passed_places import PassedPlaces

SPOT: Final = np.dtype(
    [
        ("stamp", "<i8"),  # [ns] mean of its points
        ("place", "<f8", (3,)),  # [m] mean of its points, map frame
        ("sight", "<f8", (3,)),  # [m] from the sensor to it, map axes
        ("brightness", "<f8"),  # mean logarithm of the intensity; 0 where none is measured
        ("points", "<f8"),  # how many
    ]
)
"""A spot of an upright face, as one sweep saw it: 3 cm along the direction of travel, 30 cm up."""

Spots = NDArray[np.void]
"""Spots (N,), dtype SPOT."""

_SAMPLE: Final = np.dtype(
    [
        ("along", "<f8"),  # [m]
        ("age", "<f8"),  # [s]
        ("row", "<f8"),  # number of the row of its wall: only those of one row are compared
        ("brightness", "<f8", (2,)),  # against that of the wall, and its variance
        ("depth", "<f8", (2,)),  # [m, m^2] behind the wall, and its variance
    ]
)
"""What a spot says about the profile of its wall."""


def extract_spots(
    points: F64, stamps: I64, intensities: F64 | None, sights: F64, axes: F64
) -> Spots:
    """Return the spots of upright faces beside the sensor in the points of a sweep.

    Parameters
    ----------
    points : ndarray, shape (N, 3)
        Map frame [m].
    stamps : ndarray, shape (N,)
        [ns]
    intensities : ndarray, shape (N,), or None
        Of any unit. If some points have one, those without (0, not finite) are left out.
    sights : ndarray, shape (N, 3)
        From the sensor to the points, map axes [m].
    axes : ndarray, shape (3, 3)
        As :func:`~l2lidar_proc.odometry.walls.wall_velocity.level_axes` returns them.

    Returns
    -------
    ndarray, shape (M,), dtype SPOT
    """
    brightness = np.zeros(len(points))
    if intensities is not None:
        lit = np.isfinite(intensities) & (intensities > 0.0)
        if lit.any():
            points, stamps, sights = points[lit], stamps[lit], sights[lit]
            brightness = np.log(intensities[lit])
    if not len(points):
        return np.zeros(0, SPOT)
    seen, beside = points @ axes.T, sights @ axes[1]
    cells = np.floor(seen[:, [0, 2]] / (tuning.PROFILE_CELL, tuning.PROFILE_ROW)).astype(np.int64)
    cells -= cells.min(axis=0)
    keys = (cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]) * 2 + (beside > 0.0)
    number, count = np.unique(keys, return_inverse=True, return_counts=True)[1:]

    def mean(values: F64) -> F64:
        return np.asarray(np.bincount(number, values) / count)

    def spread(values: F64) -> F64:
        rest = values - values.mean()
        return np.asarray(np.sqrt(np.maximum(mean(rest * rest) - mean(rest) ** 2, 0.0)))

    found = np.zeros(len(count), SPOT)
    earliest = int(stamps.min())
    found["stamp"] = earliest + np.round(mean((stamps - earliest).astype(np.float64)))
    for k in range(3):
        found["place"][:, k] = mean(points[:, k])
        found["sight"][:, k] = mean(sights[:, k])
    found["brightness"] = mean(brightness)
    found["points"] = count
    across, up = spread(seen[:, 1]), spread(seen[:, 2])
    is_upright = (
        (count >= tuning.PROFILE_POINTS)
        & (across < tuning.PROFILE_FLAT)
        & (up > tuning.PROFILE_UPRIGHT * across)
        & (np.abs(mean(beside)) > tuning.PROFILE_BESIDE)
    )
    return records.decimated(found[is_upright], tuning.PROFILE_SPOTS)


class WallProfile(PassedPlaces):
    """The spots of the last seconds, which measure the velocity."""

    def __init__(self) -> None:
        super().__init__(SPOT)
        self._measured = 0  # stamp of the latest measurement

    def clear(self) -> None:
        """Forget all spots; another time line may begin."""
        super().clear()
        self._measured = 0

    def update(
        self, state: InertialState, covariance: F64, found: Spots, axes: F64
    ) -> tuple[InertialState, F64]:
        """Return state and covariance after the spots of a sweep, compared with earlier ones.

        The posterior of the velocity is computed on a grid, and its mean and variance become those
        of the state (assumed density filtering). All spots are compared about once a second, so
        that each counts several times: with a share of its likelihood that is 1 in all.

        Parameters
        ----------
        state : InertialState
            At the sweep's reference; it has placed the spots.
        covariance : ndarray, shape (18, 18)
        found : ndarray, shape (N,), dtype SPOT
        axes : ndarray, shape (3, 3)
            As :func:`~l2lidar_proc.odometry.walls.wall_velocity.level_axes` returns them.
        """
        self.along = axes[0]
        now = int(state.stamp)
        kept = np.flatnonzero(self._kept["stamp"] >= now - tuning.PROFILE_KEPT_NS)
        self._kept = records.joined((records.selected(self._kept, kept), found))
        pause = now - self._measured
        if pause < tuning.PROFILE_PAUSE_NS or len(self._kept) < tuning.PROFILE_SIDE:
            return state, covariance
        span = now - int(self._kept["stamp"].min())
        if span < tuning.PROFILE_SPAN_NS:
            return state, covariance
        self._measured = now
        h = velocity_jacobian(state, 0.5e-9 * span, axes[0])
        cross = covariance @ h
        variance = float(h @ cross)
        if variance < tuning.PROFILE_SURE**2:
            return state, covariance
        errors = _candidates(float(np.sqrt(variance)))
        likelihood = velocity_likelihood(self._kept, now, axes, errors)
        share = min(pause / tuning.PROFILE_KEPT_NS, 1.0)
        prior = np.exp(-0.5 * errors**2 / variance)
        posterior = prior * likelihood**share
        mean = float(np.average(errors, weights=posterior))
        left = float(np.average((errors - mean) ** 2, weights=posterior))
        # beyond the errors compared nothing is known: without edges all stays as it is
        left *= variance / float(np.average(errors**2, weights=prior))
        gain = cross / variance
        after = state.boxplus(gain * mean)
        self.correct(state, after)
        return after, covariance + np.outer(gain, gain) * (left - variance)


def velocity_jacobian(state: InertialState, age: float, along: F64) -> F64:
    """Return the derivatives (18,) of the velocity along a direction, some seconds ago."""
    h = np.zeros(ERRORS)
    h[VELOCITY] = along
    h[GRAVITY] = -age * along
    h[ACCEL_BIAS] = age * (state.rotation.T @ along)
    return h


def acceleration_jacobian(state: InertialState, along: F64) -> F64:
    """Return the derivatives (18,) of the acceleration along a direction, the attitude known."""
    h = np.zeros(ERRORS)
    h[GRAVITY] = along
    h[ACCEL_BIAS] = -state.rotation.T @ along
    return h


def _candidates(sigma: float) -> F64:
    """Return the errors of the velocity to compare [m/s], for its standard deviation [m/s]."""
    reach = min(tuning.PROFILE_SIGMAS * sigma, tuning.PROFILE_REACH)
    return error_grid(reach, tuning.PROFILE_STEP, tuning.PROFILE_STEPS)


def error_grid(reach: float, step: float, least: int) -> F64:
    """Return evenly spaced errors (M,) from -reach to reach, 0 among them.

    Parameters
    ----------
    reach : float
    step : float
        They are no farther apart.
    least : int
        How many to either side of 0, at least.
    """
    count = max(int(np.ceil(reach / step - 1e-6)), least)  # less by what rounding adds
    return np.linspace(-reach, reach, 2 * count + 1)


def velocity_likelihood(spots: Spots, now: int, axes: F64, errors: F64) -> F64:
    """Return how likely each of some errors (M,) of the velocity along walls is; 1 at most.

    :func:`log_likelihood`, corrected for terms that are not independent, and for an error that is
    common to all.

    Parameters
    ----------
    spots : ndarray, shape (N,), dtype SPOT
    now : int
    axes : ndarray, shape (3, 3)
    errors : ndarray, shape (M,)
    """
    return likelihood_of(log_likelihood(spots, now, axes, errors), errors)


def likelihood_of(logs: F64, errors: F64) -> F64:
    """Return what :func:`velocity_likelihood` makes of logarithms (M,) for some errors (M,)."""
    logs = logs / tuning.PROFILE_DEPENDENT
    apart = (errors[:, None] - errors) / tuning.PROFILE_NOISE
    kernel = np.exp(-0.5 * apart * apart)
    likelihood = kernel @ np.exp(logs - logs.max()) / kernel.sum(axis=1)
    return np.asarray(likelihood / likelihood.max() + np.finfo(float).tiny)


def log_likelihood(
    spots: Spots, now: int, axes: F64, errors: F64, accelerations: F64 | None = None
) -> F64:
    """Return how likely each of some errors (M,) of the velocity along walls is, as a logarithm.

    A row of a wall is a Markov process along the way: from one spot to the next, brightness and
    depth stay but for noise, or both change, at a constant rate per meter. So the likelihood is a
    product over neighbors, which depend on the error, as that shifts the spots. An edge has some
    width: the reveal of a niche is seen at one place in any depth.

    Parameters
    ----------
    spots : ndarray, shape (N,), dtype SPOT
    now : int
        Instant of the state that has placed them [ns].
    axes : ndarray, shape (3, 3)
        As :func:`~l2lidar_proc.odometry.walls.wall_velocity.level_axes` returns them.
    errors : ndarray, shape (M,)
        What has to be added to the state's velocity [m/s],
    accelerations : ndarray, shape (M,), or None
        and to its acceleration since the spots were seen [m/s^2]; None if that is right.
    """
    if accelerations is None:
        accelerations = np.zeros(len(errors))
    samples = _samples(records.decimated(spots, tuning.PROFILE_MOST), now, axes)
    if len(samples) < 2:
        return np.zeros(len(errors))
    age = samples["age"]
    reach = np.abs(errors).max() + 0.5 * age.max() * np.abs(accelerations).max()
    width = np.ptp(samples["along"]) + 2.0 * age.max() * reach + 1.0
    along = samples["along"] + 2.0 * width * samples["row"]
    found = np.zeros(len(errors))
    for number, (error, acceleration) in enumerate(zip(errors, accelerations, strict=True)):
        shifted = along - (error - 0.5 * acceleration * age) * age
        order = np.argsort(shifted)
        apart = np.diff(shifted[order])
        in_row = apart < width
        apart, first, second = apart[in_row], order[:-1][in_row], order[1:][in_row]
        stays = changes = np.zeros(len(apart))
        for name, change in (
            ("brightness", tuning.PROFILE_BRIGHTNESS[2]),
            ("depth", tuning.PROFILE_DEPTH[3]),
        ):
            value, variances = samples[name].T
            noise = variances[first] + variances[second]
            square = (value[second] - value[first]) ** 2
            stays = stays - 0.5 * (square / noise + np.log(noise))
            noise = noise + change**2
            changes = changes - 0.5 * (square / noise + np.log(noise))
        rate = tuning.PROFILE_RATE * (apart + tuning.PROFILE_EDGE)
        changes = changes + np.log(-np.expm1(-rate) + np.finfo(float).tiny)
        found[number] = np.logaddexp(stays - rate, changes).sum()
    return found


def are_walls(spots: Spots, axes: F64) -> bool:
    """Return whether most of the spots (N,) are those of walls along the way, on one side or both.

    Unlike for their profile, objects may stand in front of them.
    """
    if len(spots) < tuning.PROFILE_SIDE:
        return False
    place, beside = spots["place"] @ axes.T, spots["sight"] @ axes[1]
    on_wall = np.zeros(len(spots), np.bool_)
    for side in (beside > 0.0, beside <= 0.0):
        if side.sum() >= tuning.WALLS_LEAST:
            off = _without_trend(place[side, 1], place[side, 0])
            on_wall[side] = np.abs(off) < tuning.WALLS_THICKNESS
    return bool(on_wall.mean() > tuning.WALLS_MOST)


def _samples(spots: Spots, now: int, axes: F64) -> NDArray[np.void]:
    """Return what spots (N,) of walls say about their profiles, dtype _SAMPLE."""
    place, sight = spots["place"] @ axes.T, spots["sight"] @ axes.T
    reach = np.linalg.norm(sight, axis=1)
    is_left = sight[:, 1] > 0.0
    samples = np.zeros(len(spots), _SAMPLE)
    samples["along"] = place[:, 0] - place[:, 0].mean()
    samples["age"] = (now - spots["stamp"]) * 1e-9
    row = np.floor(place[:, 2] / tuning.PROFILE_ROW)
    samples["row"] = 2.0 * (row - row.min()) + is_left
    common, of_point, _ = tuning.PROFILE_BRIGHTNESS
    samples["brightness"][:, 1] = common**2 + of_point**2 / spots["points"]
    common, per_meter, of_point, _ = tuning.PROFILE_DEPTH
    variance = common**2 + (per_meter * reach) ** 2 + of_point**2 / spots["points"]
    samples["depth"][:, 1] = variance
    depth = np.where(is_left, place[:, 1], -place[:, 1])
    is_wall = np.zeros(len(spots), np.bool_)
    for side in (is_left, ~is_left):
        if side.sum() < tuning.PROFILE_SIDE:
            continue
        # walls are straight or bend a little, and lean as the sensor seems to; errors of the beams
        # depend on where they point
        behind = _without_trend(
            depth[side], samples["along"][side], sight[side, 0], sight[side, 2]
        )
        samples["depth"][side, 0] = behind
        # what comes back depends on the range, and on the incidence: distance over range. The
        # distance is that of the wall, or it would explain how bright a recessed door is
        distance = np.maximum(np.abs(sight[side, 1]) - behind, tuning.PROFILE_BESIDE)
        terms = np.log(reach[side]), np.log(distance)
        samples["brightness"][side, 0] = _without_trend(spots["brightness"][side], *terms)
        is_wall[side] = _is_wall(behind, variance[side])
        is_wall[side] &= (behind > -tuning.PROFILE_PROUD) & (behind < tuning.PROFILE_BEHIND)
    return samples[is_wall]


def _is_wall(depth: F64, variance: F64) -> bool:
    """Return whether spots (N,) are of one wall with nothing in front of it.

    An object in front of a wall hides a different part of it in each sweep, so the edge of the
    hidden part moves with the sensor.
    """
    far, sigmas, most = tuning.PROFILE_BEFORE
    before = float(np.mean(depth < -np.maximum(far, sigmas * np.sqrt(variance))))
    return _robust_sigma(depth) < tuning.PROFILE_SCATTER and before < most


def _without_trend(values: F64, *terms: F64) -> F64:
    """Return values (N,) without their quadratic trend in some terms (N,).

    Edges do not count: least squares with Cauchy weights, iterated.
    """
    columns = [np.ones(len(values))]
    for term in terms:
        scaled = term / (np.abs(term).max() + np.finfo(float).tiny)
        columns += [scaled, scaled * scaled]
    base = np.stack(columns, axis=1)
    weights = np.ones(len(values))
    rest = values
    for _ in range(tuning.PROFILE_ROUNDS):
        weighted = (base * weights[:, None]).T
        fit = np.linalg.lstsq(weighted @ base, weighted @ values, rcond=1e-9)[0]
        rest = values - base @ fit
        scale = max(tuning.PROFILE_CAUCHY * _robust_sigma(rest), 1e-6)
        weights = 1.0 / (1.0 + (rest / scale) ** 2)
    return np.asarray(rest)


def _robust_sigma(values: F64) -> float:
    """Return a robust standard deviation of values (N,) about zero.

    1.4826 is the ratio of standard deviation and median absolute deviation of a Gaussian.
    """
    return 1.4826 * float(np.median(np.abs(values)))
