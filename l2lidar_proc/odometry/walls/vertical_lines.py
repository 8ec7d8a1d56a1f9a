"""Vertical lines in a sweep: they measure the velocity along bare walls.

Between bare walls only the reveals of doors, niches and pillars fix the position along them:
narrow faces across the direction of travel, 2 to 12 cm deep. Registration cannot use them:
thinning leaves a point or two of each, and the cells of the map are wider than they are. In the
whole sweep, however, a scan line that meets such a face runs down it, and leaves 12 to 60 points
above one another. The position of such a vertical line along the walls is known to some
millimeters. Several sweeps see a door while it is passed, so its lines measure the velocity.

Most vertical lines are not reveals: a scan line that crosses a wall which is not in the map yet
leaves one as well. So points on known walls are left out, and the lines of a sweep are paired with
those of the last seconds. Two lines of one reveal are apart by the error of the velocity times the
time between them; other pairs are apart by anything. Each pair votes for an error. The one with
most votes is used if chance hardly explains so many, and if no other one has nearly as many. It
is weighted by the probability that it is right: two votes are wrong in one of ten cases.

When the state is corrected, the positions of earlier lines are corrected with it.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import F64, I64
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import (
    ACCEL_BIAS,
    ERRORS,
    GRAVITY,
    VELOCITY,
    InertialState,
    association_probability,
    square_root,
    update_with_information,
)
from l2lidar_proc.motion.passed_places import PassedPlaces

LINE: Final = np.dtype(
    [
        ("stamp", "<i8"),  # [ns] mean of its points
        ("place", "<f8", (3,)),  # [m] mean of its points, map frame
        ("sigma", "<f8"),  # [m] standard deviation of the place along the direction
        ("sweep", "<i8"),  # [ns] reference of its sweep
    ]
)
"""A vertical line, as one sweep saw it."""

Lines = NDArray[np.void]
"""Lines (N,), dtype LINE."""

_PAIR: Final = np.dtype(
    [
        ("line", "<i8"),  # index of the line of the latest sweep
        ("earlier", "<i8"),  # index of the other one
        ("apart", "<f8"),  # [s] time between them
        ("shift", "<f8"),  # [m] how much farther along the direction the later one lies
        ("reach", "<f8"),  # [m] largest shift of two lines of one reveal
        ("noise", "<f8"),  # [m] standard deviation of the shift at the right velocity
        ("vote", "<i8"),  # pairs of one place and one earlier sweep have one vote; ascending
    ]
)


def extract_lines(points: F64, stamps: I64, is_wall: NDArray[np.bool_], axes: F64) -> Lines:
    """Return the vertical lines in the points of a sweep, those with most points first.

    Parameters
    ----------
    points : ndarray, shape (N, 3)
        Map frame [m].
    stamps : ndarray, shape (N,)
        [ns]
    is_wall : ndarray, shape (N,)
        Which points lie on known surfaces along the direction.
    axes : ndarray, shape (3, 3)
        As :func:`~l2lidar_proc.odometry.walls.wall_velocity.level_axes` returns them.

    Returns
    -------
    ndarray, shape (M,), dtype LINE
    """
    from scipy.spatial import cKDTree  # brings scipy.sparse along; a node starts without

    free = np.flatnonzero(~is_wall)
    if len(free) < tuning.LINE_POINTS:
        return np.zeros(0, LINE)
    seen = (points - points[free[0]]) @ axes.T
    plan = cKDTree(seen[free, :2])
    crowd = plan.query_ball_point(seen[free, :2], tuning.LINE_RADIUS, return_length=True)
    walls = cKDTree(seen[is_wall, :2]) if is_wall.any() else None
    is_taken = np.zeros(len(free), np.bool_)
    earliest = int(stamps.min())
    found = np.zeros(tuning.LINE_MOST, LINE)
    count = 0
    for seed in np.argsort(-crowd, kind="stable").tolist():
        if crowd[seed] < tuning.LINE_POINTS or count == len(found):
            break
        if is_taken[seed]:
            continue
        center = seen[free[seed], :2]
        for _ in range(tuning.LINE_ROUNDS):
            near = plan.query_ball_point(center, tuning.LINE_RADIUS)
            center = seen[free[near], :2].mean(axis=0)
        is_taken[near] = is_taken[seed] = True
        spread, _, height = seen[free[near]].std(axis=0).tolist()
        on_wall = len(walls.query_ball_point(center, tuning.LINE_RADIUS)) if walls else 0
        if (
            len(near) < max(tuning.LINE_POINTS, on_wall)
            or height < tuning.LINE_HEIGHT
            or spread > tuning.LINE_SPREAD
        ):
            continue
        line = found[count]
        line["stamp"] = earliest + round(float((stamps[free[near]] - earliest).mean()))
        line["place"] = points[free[near]].mean(axis=0)
        line["sigma"] = np.hypot(
            max(spread, tuning.LINE_NOISE[0]) / np.sqrt(len(near)), tuning.LINE_NOISE[1]
        )
        count += 1
    return found[:count]


class VerticalLines(PassedPlaces):
    """The vertical lines of the last seconds, which measure the velocity."""

    def __init__(self) -> None:
        super().__init__(LINE)

    def update(
        self, state: InertialState, covariance: F64, found: Lines, axes: F64
    ) -> tuple[InertialState, F64]:
        """Return state and covariance after the lines of a sweep, compared with earlier ones.

        Parameters
        ----------
        state : InertialState
            At the sweep's reference; it has placed the lines.
        covariance : ndarray, shape (18, 18)
        found : ndarray, shape (N,), dtype LINE
        axes : ndarray, shape (3, 3)
            As :func:`~l2lidar_proc.odometry.walls.wall_velocity.level_axes` returns them.
        """
        self.along = axes[0]
        oldest = int(state.stamp) - tuning.LINE_KEPT_NS
        kept = np.flatnonzero(self._kept["stamp"] >= oldest)[-tuning.LINE_KEPT :]
        self._kept = records.joined((records.selected(self._kept, kept), found))
        self._kept["sweep"][len(kept) :] = int(state.stamp)
        sigma = float(np.sqrt(axes[0] @ covariance[VELOCITY, VELOCITY] @ axes[0]))
        pairs = self._pairs(len(kept), state, sigma, axes)
        agreeing, votes = _agreeing(pairs, sigma)
        pairs = self._with_relief(pairs[agreeing], axes)
        after, posterior = state, covariance
        for number in np.unique(pairs["line"]).tolist():
            earlier = pairs["earlier"][pairs["line"] == number]
            after, posterior = self._compared(number, earlier, after, posterior, axes[0])
        if after is state:
            return state, covariance
        # chance agrees on any error alike, the fewer votes the more often
        odds = tuning.LINE_TRUE * tuning.LINE_TRUE_VOTE ** (min(votes, tuning.LINE_SURE) - 2.0)
        error = float(axes[0] @ (after.velocity - state.velocity))
        right = association_probability(error, sigma**2, odds)
        mean, covariance = _mixed(state, covariance, after, posterior, right)
        self.correct(after, mean)
        return mean, covariance

    def _ages(self, state: InertialState) -> F64:
        """Return how much older than a state the lines are [s], shape (N,)."""
        return np.asarray((int(state.stamp) - self._kept["stamp"]) * 1e-9)

    def _pairs(
        self, first: int, state: InertialState, sigma: float, axes: F64
    ) -> NDArray[np.void]:
        """Return the lines of the latest sweep, each with earlier ones that may be its reveal.

        Parameters
        ----------
        first : int
            Of the lines of the latest sweep.
        state : InertialState
        sigma : float
            Of the velocity along the direction [m/s].
        axes : ndarray, shape (3, 3)

        Returns
        -------
        ndarray, shape (P,), dtype _PAIR
        """
        lines = self._kept
        line, earlier = np.mgrid[first : len(lines), :first].reshape(2, -1)
        pairs = np.zeros(len(line), _PAIR)
        pairs["line"], pairs["earlier"] = line, earlier
        ages = self._ages(state)
        apart = pairs["apart"] = ages[earlier] - ages[line]
        offset = (lines["place"][line] - lines["place"][earlier]) @ axes[:2].T
        pairs["shift"] = offset[:, 0]
        pairs["reach"] = np.minimum(
            tuning.LINE_SIGMAS * np.hypot(apart * sigma, tuning.LINE_BETWEEN), tuning.LINE_REACH
        )
        pairs["noise"] = np.sqrt(
            lines["sigma"][line] ** 2
            + lines["sigma"][earlier] ** 2
            + tuning.LINE_FIT_NOISE**2
            + tuning.LINE_WANDER**2 * np.abs(apart) ** 3 / 3.0
        )
        # a face may be several lines of a sweep, at several depths
        along = (lines["place"][first:] - state.position) @ axes[0]
        order = np.argsort(along)
        face = np.empty(len(along), np.int64)
        face[order] = np.cumsum(np.diff(along[order], prepend=-np.inf) > tuning.LINE_FACE)
        pairs = pairs[
            (apart >= tuning.LINE_PAUSE_S)
            & (np.abs(offset[:, 0]) < pairs["reach"])
            & (np.abs(offset[:, 1]) < tuning.LINE_DEEPEST)
        ]
        pairs = records.decimated(pairs, tuning.LINE_PAIRS)
        votes = np.stack((face[pairs["line"] - first], lines["sweep"][pairs["earlier"]]))
        pairs["vote"] = np.unique(votes, axis=1, return_inverse=True)[1].ravel()
        return np.sort(pairs, order=["vote", "line", "earlier"])

    def _with_relief(self, pairs: NDArray[np.void], axes: F64) -> NDArray[np.void]:
        """Return the pairs (P,) of lines that were seen at several depths, unlike a wall's."""
        across = self._kept["place"] @ axes[1]
        depth = across[pairs["earlier"]] - across[pairs["line"]]
        kept = np.zeros(len(pairs), np.bool_)
        for number in np.unique(pairs["line"]).tolist():
            mine = pairs["line"] == number
            kept[mine] = np.ptp(np.append(depth[mine], 0.0)) >= tuning.LINE_RELIEF
        return pairs[kept]

    def _compared(
        self,
        number: int,
        earlier: I64,
        state: InertialState,
        covariance: F64,
        along: F64,
    ) -> tuple[InertialState, F64]:
        """Return state and covariance after a line is compared with earlier ones (M,)."""
        residual, h, variance = self._comparison(number, earlier, state, along)
        after, posterior = update_with_information(
            state,
            square_root(covariance),
            state,
            np.outer(h, h) / variance,
            -h * residual / variance,
        )
        self.correct(state, after)
        return after, posterior

    def _comparison(
        self, number: int, earlier: I64, state: InertialState, along: F64
    ) -> tuple[float, F64, float]:
        """Return how far a line lies from the mean of others along a direction (3,).

        The residual [m], its derivatives (18,) by the errors of the state, and its variance [m^2].
        """
        weights = self._kept["sigma"][earlier] ** -2.0
        total = float(weights.sum())
        weights /= total
        tau = self._ages(state)
        offsets = (self._kept["place"][earlier] - self._kept["place"][number]) @ along
        residual = -float(weights @ offsets)
        span = float(weights @ tau[earlier]) - float(tau[number])
        square = float(tau[number] ** 2 - weights @ tau[earlier] ** 2)
        h = np.zeros(ERRORS)
        h[VELOCITY] = span * along
        h[GRAVITY] = 0.5 * square * along
        h[ACCEL_BIAS] = -0.5 * square * (state.rotation.T @ along)
        variance = (
            float(self._kept["sigma"][number] ** 2)
            + 1.0 / total
            + tuning.LINE_WANDER**2 * span**3 / 3.0
        )
        return residual, h, variance


def _mixed(
    state: InertialState,
    covariance: F64,
    after: InertialState,
    posterior: F64,
    right: float,
) -> tuple[InertialState, F64]:
    """Return mean and covariance (18, 18) of two Gaussians, the second with a probability."""
    change = after.boxminus(state)
    spread = right * (1.0 - right) * np.outer(change, change)
    mixed = right * posterior + (1.0 - right) * covariance + spread
    return state.boxplus(right * change), mixed


def _agreeing(pairs: NDArray[np.void], sigma: float) -> tuple[NDArray[np.bool_], float]:
    """Return which pairs (P,) agree with the error of the velocity that most vote for.

    None of them where chance explains as many votes, or another error has nearly as many. The
    second result is the number of votes.

    Parameters
    ----------
    pairs : ndarray, shape (P,), dtype _PAIR
    sigma : float
        Of the velocity along the direction [m/s].
    """
    none = np.zeros(len(pairs), np.bool_)
    if not len(pairs):
        return none, 0.0
    apart, shift, noise = pairs["apart"], pairs["shift"], pairs["noise"]
    errors = np.clip(shift / apart, -tuning.LINE_SIGMAS * sigma, tuning.LINE_SIGMAS * sigma)
    near = np.exp(-0.5 * ((shift - errors[:, None] * apart) / noise) ** 2)
    begins = np.flatnonzero(np.diff(pairs["vote"], prepend=-1))
    votes = np.maximum.reduceat(near, begins, axis=1).sum(axis=1)
    best = int(np.argmax(votes))
    agree = np.abs(shift - errors[best] * apart) < tuning.LINE_OUTLIER * noise
    weights = np.where(agree, apart / noise**2, 0.0)
    error = float((weights @ shift) / (weights @ apart + max(sigma, 1e-6) ** -2.0))
    agree = np.abs(shift - error * apart) < tuning.LINE_OUTLIER * noise
    if not agree.any():
        return none, 0.0
    others = np.maximum.reduceat(np.where(agree, 0.0, near), begins, axis=1).sum(axis=1)
    rival = float(np.where(agree, 0.0, others).max())
    unsure = float(apart[agree].max()) * sigma > tuning.LINE_UNSURE
    # votes of pairs that are spread evenly within their reach
    chance = float((np.sqrt(2.0 * np.pi) * noise / (2.0 * pairs["reach"])).sum())
    needed = tuning.LINE_VOTES_UNSURE if unsure else tuning.LINE_VOTES
    needed += tuning.LINE_CHANCE * chance
    if votes[best] < needed or rival > tuning.LINE_RIVAL * votes[best]:
        return none, 0.0
    return agree, float(votes[best])
