"""IMU preintegration: rotation, velocity and position sums of a stretch of samples.

With gravity g, attitude R, velocity v and position p at one knot (the anchor), any other knot dt
later is at ``R q``, ``v + g dt + R b`` and ``p + v dt + g dt^2 / 2 + R a``. The sums q, b and a
depend only on the samples and their biases (Lupton and Sukkarieh 2012; Forster et al. 2017), so
one integration serves prediction, deskew and alignment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import F64, I64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.imu_buffer import Samples


@dataclass(frozen=True, slots=True, eq=False)
class ImuSegment:
    """Rates and specific forces at knots of time, biases included.

    Attributes
    ----------
    stamps : ndarray, shape (K,), int64
        Knots [ns], strictly ascending, K >= 2.
    rates, forces : ndarray, shape (K, 3)
        Angular velocity [rad/s] and specific force [m/s^2] at the knots; linear between them.
    missing : ndarray, shape (K - 1,), bool
        Intervals inside a gap: their rates are assumed and their forces mean nothing.
    rate_errors, force_errors : ndarray, shape (K - 1,)
        By which rates [rad/s] and forces [m/s^2] may be off throughout an interval, 1 sigma,
        because some samples are missing there: the spread of those around. 0 where none are
        missing, or so many that those around do not tell.
    """

    stamps: I64
    rates: F64
    forces: F64
    missing: NDArray[np.bool_]
    rate_errors: F64
    force_errors: F64

    def knot(self, stamp: HostNs) -> int:
        """Return the index of the first knot not before an instant."""
        return min(int(np.searchsorted(self.stamps, stamp)), len(self.stamps) - 1)


def segment(
    samples: Samples,
    marks: list[HostNs],
    gap_ns: int,
    steady_rate: F64,
    hold_ns: int | None = None,
) -> ImuSegment:
    """Return the samples between the first and the last of some marks, with a knot at each mark.

    Parameters
    ----------
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        Ascending; may be empty.
    marks : list of HostNs
        At least two different instants.
    gap_ns : int
        A longer stretch without a sample is a gap.
    steady_rate : ndarray, shape (3,)
        Rate assumed far from all samples [rad/s], gyro bias included.
    hold_ns : int, optional
        Before the first and after the last sample the mean of the nearest ones is held for this
        long; ``gap_ns`` if left out.

    Notes
    -----
    Inside a gap the rate goes in a straight line from the mean before it to the mean after it.
    The work is bounded by the number of samples, whatever the marks: a gap gets at most
    :data:`tuning.GAP_KNOTS` knots.
    """
    start, end = int(min(marks)), int(max(marks))
    stamps = samples["stamp"]
    within = stamps[(stamps > start) & (stamps < end)]
    known = np.unique(np.concatenate((within, np.asarray(marks, dtype=np.int64))))
    hold = gap_ns if hold_ns is None else hold_ns
    knots = _with_gap_knots(known, gap_ns, hold)
    count = len(knots)
    if not len(samples):
        nothing = np.zeros((count, 3))
        gap, no_error = np.ones(count - 1, np.bool_), np.zeros(count - 1)
        return ImuSegment(knots, nothing + steady_rate, nothing, gap, no_error, no_error)
    forces = _interpolated(knots, stamps, samples["linear_acceleration"])
    rates = _interpolated(knots, stamps, samples["angular_velocity"])
    middles = knots[:-1] + (knots[1:] - knots[:-1]) // 2
    after = np.searchsorted(stamps, middles)
    since = middles - stamps[np.maximum(after - 1, 0)]
    until = stamps[np.minimum(after, len(stamps) - 1)] - middles
    inside = (after > 0) & (after < len(stamps))
    apart = since + until
    missing = np.where(inside, apart > gap_ns, np.minimum(abs(since), abs(until)) > hold)
    rates[(knots < stamps[0] - hold) | (knots > stamps[-1] + hold)] = steady_rate
    _bridge(rates, knots, samples, gap_ns)
    is_sparse = inside & (apart > _sparse_ns(stamps)) & (apart <= tuning.BLIND_SHORT_S * 1e9)
    rate_errors, force_errors = (
        _interpolation_errors(samples[name], after, is_sparse)
        for name in ("angular_velocity", "linear_acceleration")
    )
    return ImuSegment(knots, rates, forces, missing, rate_errors, force_errors)


def _sparse_ns(stamps: I64) -> float:
    """Return the distance of two samples [ns] from which on some are missing between them."""
    if len(stamps) < 3:
        return np.inf
    return tuning.SPARSE_PERIODS * float(np.median(np.diff(stamps)))


def _interpolation_errors(values: F64, after: I64, is_sparse: NDArray[np.bool_]) -> F64:
    """Return what values interpolated in some intervals (N,) may be off by, 0 in the others.

    That is by how much the samples next to them differ from the mean of those farther around, of
    all axes together: a blow shows there, though both ends may be at the same height of it.

    Parameters
    ----------
    values : ndarray, shape (M, 3)
        Of the samples.
    after : ndarray, shape (N,)
        The sample after each interval.
    is_sparse : ndarray, shape (N,)
    """
    errors = np.zeros(len(after))
    for place in np.flatnonzero(is_sparse).tolist():
        near, around = (
            values[max(int(after[place]) - count, 0) : int(after[place]) + count]
            for count in (tuning.TREND_SAMPLES, tuning.AROUND_SAMPLES)
        )
        errors[place] = np.sqrt(np.square(near - around.mean(axis=0)).mean(axis=0).sum())
    return errors


def _with_gap_knots(known: I64, gap_ns: int, hold_ns: int) -> I64:
    """Return the knots with more of them inside every gap, a bounded number."""
    spans = np.diff(known)
    gaps = np.flatnonzero(spans > min(gap_ns, hold_ns + 1))
    if not len(gaps):
        return known
    filled = [known]
    for gap in gaps.tolist():
        first, span = int(known[gap]), int(spans[gap])
        count = min(-(-span // tuning.GAP_STEP_NS), tuning.GAP_KNOTS)
        filled.append(first + np.arange(1, count, dtype=np.int64) * (span // count))
        # where a held rate ends it changes within a nanosecond: knots on either side
        ends = hold_ns + np.array([0, 1], dtype=np.int64)
        filled.append(np.concatenate((first + ends, first + span - ends)))
    knots = np.unique(np.concatenate(filled))
    return np.asarray(knots[(knots >= known[0]) & (knots <= known[-1])])


def _bridge(rates: F64, knots: I64, samples: Samples, gap_ns: int) -> None:
    """Let the rates inside each gap go straight from the mean before it to the mean after it."""
    stamps, measured = samples["stamp"], samples["angular_velocity"]
    for last in np.flatnonzero(np.diff(stamps) > gap_ns).tolist():
        first, end = int(stamps[last]), int(stamps[last + 1])
        inner = (knots > first) & (knots < end)
        if inner.any():
            before = measured[max(last + 1 - tuning.TREND_SAMPLES, 0) : last + 1].mean(axis=0)
            after = measured[last + 1 : last + 1 + tuning.TREND_SAMPLES].mean(axis=0)
            share = ((knots[inner] - first) / (end - first))[:, None]
            rates[inner] = before + share * (after - before)


def _interpolated(knots: I64, stamps: I64, values: F64) -> F64:
    """Return the values at the knots, linear between the samples, held beyond, shape (K, 3)."""
    origin = int(knots[0])
    at, times = (knots - origin) * 1e-9, (stamps - origin) * 1e-9
    out = np.stack([np.interp(at, times, column) for column in values.T], axis=-1)
    out[knots < stamps[0]] = values[: tuning.TREND_SAMPLES].mean(axis=0)
    out[knots > stamps[-1]] = values[-tuning.TREND_SAMPLES :].mean(axis=0)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Preintegration:
    """Sums of the samples at every knot, seen from the anchor.

    Attributes
    ----------
    stamps : ndarray, shape (K,), int64
    rates : ndarray, shape (K, 3)
        Angular velocity without bias [rad/s].
    rotations_wxyz : ndarray, shape (K, 4)
        q: axes at the knot to axes at the anchor.
    velocities : ndarray, shape (K, 3)
        b [m/s].
    positions : ndarray, shape (K, 3)
        a [m].
    anchor : int
        Index of the knot everything is seen from: there q is identity, b and a are zero.
    """

    stamps: I64
    rates: F64
    rotations_wxyz: F64
    velocities: F64
    positions: F64
    anchor: int

    def anchored_at(self, anchor: int) -> Preintegration:
        """Return the same sums seen from another knot."""
        back = rotations.conjugate(self.rotations_wxyz[anchor])
        dt = ((self.stamps - self.stamps[anchor]) * 1e-9)[:, None]
        velocity = self.velocities - self.velocities[anchor]
        position = self.positions - self.positions[anchor] - self.velocities[anchor] * dt
        return Preintegration(
            self.stamps,
            self.rates,
            rotations.multiply(back, self.rotations_wxyz),
            rotations.rotate(back, velocity),
            rotations.rotate(back, position),
            anchor,
        )


def integrate(
    imu: ImuSegment,
    anchor: int,
    *,
    gyro_bias: F64,
    accel_bias: F64,
    rest_force: F64,
    use_forces: bool = True,
    body_velocity: F64 | None = None,
) -> Preintegration:
    """Return the sums over a segment.

    Parameters
    ----------
    imu : ImuSegment
    anchor : int
        Index of the knot to see everything from.
    gyro_bias, accel_bias : ndarray, shape (3,)
        [rad/s] and [m/s^2].
    rest_force : ndarray, shape (3,)
        Specific force of a sensor at rest in the anchor's attitude [m/s^2]. In gaps, and
        everywhere without ``use_forces``, the velocity stays.
    use_forces : bool
    body_velocity : ndarray, shape (3,), optional
        Velocity at the anchor in its own axes [m/s]. Where the velocity would stay it then turns
        with the body instead, as that of a vehicle does.
    """
    dt = (np.diff(imu.stamps) * 1e-9)[:, None]
    rates = imu.rates - gyro_bias
    before, after = rates[:-1], rates[1:]
    # the second term is the coning of two rates that are not parallel
    turns = 0.5 * dt * (before + after) + (dt * dt / 12.0) * rotations.cross(before, after)
    q = rotations.cumulative(np.concatenate(([[1.0, 0.0, 0.0, 0.0]], rotations.exp(turns))))
    q = rotations.multiply(rotations.conjugate(q[anchor]), q)
    steady = np.broadcast_to(rest_force, (len(imu.stamps), 3))
    if body_velocity is not None:
        steady = steady + rotations.rotate(q, rotations.cross(rates, body_velocity))
    before, after = steady[:-1], steady[1:]
    if use_forces:
        forces = rotations.rotate(q, imu.forces - accel_bias)
        before = np.where(imu.missing[:, None], before, forces[:-1])
        after = np.where(imu.missing[:, None], after, forces[1:])
    velocities = _summed(0.5 * dt * (before + after))
    positions = _summed(dt * velocities[:-1] + dt * dt / 6.0 * (2.0 * before + after))
    since = ((imu.stamps - imu.stamps[anchor]) * 1e-9)[:, None]
    return Preintegration(
        imu.stamps,
        rates,
        q,
        velocities - velocities[anchor],
        positions - positions[anchor] - velocities[anchor] * since,
        anchor,
    )


def coverage(stamps: NDArray[np.int64], start: HostNs, end: HostNs) -> tuple[float, int]:
    """Return how far IMU samples cover a span.

    Parameters
    ----------
    stamps : ndarray, shape (N,), int64
        Of the samples [ns], ascending.
    start, end : HostNs

    Returns
    -------
    share : float
        Part of the span between the first and the last sample, 0 to 1.
    gap_ns : int
        Longest stretch without a sample that touches the span.
    """
    if not len(stamps):
        return 0.0, int(end - start)
    first = max(int(np.searchsorted(stamps, start, side="right")) - 1, 0)
    last = min(int(np.searchsorted(stamps, end, side="left")), len(stamps) - 1)
    stretches = np.diff(stamps[first : last + 1], prepend=start, append=end)
    if stamps[first] <= start:
        stretches[0] = 0
    if stamps[last] >= end:
        stretches[-1] = 0
    inside = min(end, int(stamps[-1])) - max(start, int(stamps[0]))
    return min(max(inside / max(end - start, 1), 0.0), 1.0), max(int(stretches.max()), 0)


def _summed(steps: F64) -> F64:
    return np.asarray(np.concatenate((np.zeros((1, 3)), np.cumsum(steps, axis=0))))
