"""Sums up IMU samples over a span of time, without yet knowing attitude, speed or gravity.

With gravity g, attitude R, velocity v and position p at one knot (the anchor), any other knot dt
later is at ``R q``, ``v + g dt + R b`` and ``p + v dt + g dt^2 / 2 + R a``: q, b and a are what
is kept here. They depend on the samples and their biases alone (Lupton and Sukkarieh 2012;
Forster et al. 2017).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs
from l2lidar_proc import rotations
from l2lidar_proc.motion.imu_buffer import Samples

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

STEP_NS: Final = 4_000_000
_TREND: Final = 5  # samples whose mean is held over a gap at an end; one alone is too noisy


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """What the IMU felt at knots of time, biases included.

    Attributes
    ----------
    stamps : ndarray, shape (K,), int64
        Knots [ns], strictly ascending, K >= 2.
    rates, forces : ndarray, shape (K, 3)
        Angular velocity [rad/s] and specific force [m/s^2] at the knots; linear between them.
    missing : ndarray, shape (K - 1,), bool
        Which intervals lie in a gap: their rates are a guess and their forces mean nothing.
    """

    stamps: I64
    rates: F64
    forces: F64
    missing: NDArray[np.bool_]

    def knot(self, stamp: HostNs) -> int:
        """Return the number of the first knot not before an instant."""
        return min(int(np.searchsorted(self.stamps, stamp)), len(self.stamps) - 1)


def track(samples: Samples, marks: list[HostNs], gap_ns: int, steady_rate: F64) -> Track:
    """Return the samples between the first and the last of some marks, with a knot at each mark.

    Parameters
    ----------
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        Ascending, may be empty.
    marks : list of HostNs
        At least two different instants.
    gap_ns : int
        A longer stretch without sample is a gap.
    steady_rate : ndarray, shape (3,)
        Rate assumed where there is no sample within ``gap_ns`` [rad/s], gyro bias included.
    """
    start, end = min(marks), max(marks)
    stamps = samples["stamp"]
    within = stamps[(stamps > start) & (stamps < end)]
    knots = np.unique(np.concatenate((within, np.asarray(marks, dtype=np.int64))))
    holes = np.flatnonzero(np.diff(knots) > gap_ns)
    if len(holes):
        fill = [np.arange(knots[hole], knots[hole + 1], 5 * STEP_NS) for hole in holes]
        knots = np.unique(np.concatenate((knots, *fill)))
    if not len(samples):
        nothing = np.zeros((len(knots), 3))
        return Track(knots, nothing + steady_rate, nothing, np.ones(len(knots) - 1, np.bool_))
    rates = _at(knots, stamps, samples["angular_velocity"])
    forces = _at(knots, stamps, samples["linear_acceleration"])
    middles = (knots[:-1] + knots[1:]) // 2
    after = np.searchsorted(stamps, middles)
    since = middles - stamps[np.maximum(after - 1, 0)]
    until = stamps[np.minimum(after, len(stamps) - 1)] - middles
    inside = (after > 0) & (after < len(stamps))
    missing = np.where(inside, since + until > gap_ns, np.minimum(abs(since), abs(until)) > gap_ns)
    lost = np.append(missing, False) & np.append(True, missing)
    rates[lost] = steady_rate
    return Track(knots, rates, forces, missing)


def _at(knots: I64, stamps: I64, values: F64) -> F64:
    """Return the values at the knots, linear between the samples, held beyond, shape (K, 3)."""
    origin = int(knots[0])
    at, times = (knots - origin) * 1e-9, (stamps - origin) * 1e-9
    out = np.stack([np.interp(at, times, column) for column in values.T], axis=-1)
    out[knots < stamps[0]] = values[:_TREND].mean(axis=0)
    out[knots > stamps[-1]] = values[-_TREND:].mean(axis=0)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Increments:
    """Sums of the samples at every knot, as seen from the anchor.

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
        The knot everything is seen from: there q is identity, b and a are zero.
    """

    stamps: I64
    rates: F64
    rotations_wxyz: F64
    velocities: F64
    positions: F64
    anchor: int

    def seen_from(self, anchor: int) -> Increments:
        """Return the same sums as seen from another knot."""
        back = rotations.conjugate(self.rotations_wxyz[anchor])
        dt = ((self.stamps - self.stamps[anchor]) * 1e-9)[:, None]
        velocity = self.velocities - self.velocities[anchor]
        position = self.positions - self.positions[anchor] - self.velocities[anchor] * dt
        return Increments(
            self.stamps,
            self.rates,
            rotations.multiply(back, self.rotations_wxyz),
            rotations.rotate(back, velocity),
            rotations.rotate(back, position),
            anchor,
        )


def integrate(
    felt: Track,
    anchor: int,
    gyro_bias: F64,
    accel_bias: F64,
    at_rest: F64,
    use_forces: bool = True,
) -> Increments:
    """Return the sums over a track.

    Parameters
    ----------
    felt : Track
    anchor : int
        Knot to see everything from.
    gyro_bias, accel_bias : ndarray, shape (3,)
        [rad/s] and [m/s^2].
    at_rest : ndarray, shape (3,)
        Specific force of a sensor at rest in the anchor's attitude [m/s^2]: in gaps, and
        everywhere without ``use_forces``, the velocity stays.
    use_forces : bool
    """
    dt = (np.diff(felt.stamps) * 1e-9)[:, None]
    rates = felt.rates - gyro_bias
    before, after = rates[:-1], rates[1:]
    # the second term is the coning of two rates that are not parallel
    turns = 0.5 * dt * (before + after) + (dt * dt / 12.0) * rotations.cross(before, after)
    q = rotations.cumulative(np.concatenate(([[1.0, 0.0, 0.0, 0.0]], rotations.exp(turns))))
    q = rotations.multiply(rotations.conjugate(q[anchor]), q)
    if use_forces:
        forces = rotations.rotate(q, felt.forces - accel_bias)
        before, after = forces[:-1], forces[1:]
        before = np.where(felt.missing[:, None], at_rest, before)
        after = np.where(felt.missing[:, None], at_rest, after)
    else:
        before = after = np.broadcast_to(at_rest, (len(dt), 3))
    velocities = _summed(0.5 * dt * (before + after))
    positions = _summed(dt * velocities[:-1] + dt * dt / 6.0 * (2.0 * before + after))
    since = ((felt.stamps - felt.stamps[anchor]) * 1e-9)[:, None]
    return Increments(
        felt.stamps,
        rates,
        q,
        velocities - velocities[anchor],
        positions - positions[anchor] - velocities[anchor] * since,
        anchor,
    )


def _summed(steps: F64) -> F64:
    return np.asarray(np.concatenate((np.zeros((1, 3)), np.cumsum(steps, axis=0))))
