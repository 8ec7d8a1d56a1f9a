"""The short path of the cloud frame between two instants, integrated from its IMU.

Rotation comes from the gyro: between two samples the rate is taken as linear in time, and the
rotation vector of the interval is the mean rate times its length plus the coning term (second
order of the Magnus series). Translation comes from velocities that were measured elsewhere;
between and beyond them the accelerometer, freed of gravity, carries the velocity on, or, without
gravity, the velocity in the body is taken as constant, which is what a vehicle does that turns
where it goes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs
from l2lidar_proc import rotations
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.rotations import F64

VELOCITY: Final = np.dtype(
    [
        ("stamp", "<i8"),  # [ns] host clock
        ("velocity", "<f8", (3,)),  # [m/s] of the cloud origin over the ground, cloud axes
    ]
)
"""One velocity of the sensor; an array of them is in strictly ascending order of ``stamp``."""

_STEP_NS: Final = 4_000_000  # longest interval inside a gap: its rotation stays small
_TREND: Final = 5  # samples whose mean rate is held beyond the data; one alone is too noisy


@dataclass(frozen=True, slots=True, eq=False)
class Gravity:
    """Which way is up for the sensor at one instant.

    Attributes
    ----------
    stamp : HostNs
    up : ndarray, shape (3,)
        Specific force of a sensor at rest in this attitude [m/s^2], cloud axes: up times g.
    """

    stamp: HostNs
    up: F64


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """Poses of the cloud frame at knots, as seen from the first one.

    Attributes
    ----------
    stamps : ndarray, shape (K,), int64
        Knots [ns], strictly ascending: start, the IMU samples, end.
    rotations_wxyz : ndarray, shape (K, 4)
        Cloud axes at the knot to cloud axes at the first knot.
    positions : ndarray, shape (K, 3)
        Origin at the knot in the frame of the first knot [m].
    rates : ndarray, shape (K, 3)
        Angular velocity without bias [rad/s], cloud axes; linear in time between knots.
    """

    stamps: NDArray[np.int64]
    rotations_wxyz: F64
    positions: F64
    rates: F64

    def pose(self, stamp: HostNs) -> tuple[F64, F64]:
        """Return rotation (w, x, y, z), shape (4,), and position [m], shape (3,), at one instant.

        Instants outside the path take the pose of the nearer end.
        """
        rotations_wxyz, positions = self.poses(np.array([stamp]))
        return rotations_wxyz[0], positions[0]

    def poses(self, stamps: NDArray[np.int64]) -> tuple[F64, F64]:
        """Return rotations (w, x, y, z), (N, 4), and positions [m], (N, 3), at instants."""
        stamps = np.clip(stamps, self.stamps[0], self.stamps[-1])
        knot = np.clip(
            np.searchsorted(self.stamps, stamps, side="right") - 1, 0, len(self.stamps) - 2
        )
        dt = ((stamps - self.stamps[knot]) * 1e-9)[:, None]
        whole = ((self.stamps[knot + 1] - self.stamps[knot]) * 1e-9)[:, None]
        slope = (self.rates[knot + 1] - self.rates[knot]) / whole
        turn = rotations.exp(dt * (self.rates[knot] + 0.5 * dt * slope))
        step = (dt / whole) * (self.positions[knot + 1] - self.positions[knot])
        return rotations.multiply(self.rotations_wxyz[knot], turn), self.positions[knot] + step

    def between(self, start: HostNs, end: HostNs) -> tuple[F64, F64]:
        """Return rotation (4,) and translation [m] (3,) from the frame at ``end`` to ``start``."""
        (q, p), (q_end, p_end) = self.pose(start), self.pose(end)
        back = rotations.conjugate(q)
        return rotations.multiply(back, q_end), rotations.rotate(back, p_end - p)


def still_path(start: HostNs, end: HostNs) -> Path:
    """Return the path of a sensor that does not move."""
    stamps = np.array([start, max(end, start + 1)], dtype=np.int64)
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    return Path(stamps, identity, np.zeros((2, 3)), np.zeros((2, 3)))


def integrate(
    samples: Samples,
    start: HostNs,
    end: HostNs,
    *,
    T_cloud_imu: F64,
    bias: F64,
    velocities: NDArray[np.void] | None = None,
    gravity: Gravity | None = None,
    hold_ns: int = 20_000_000,
) -> Path:
    """Return the path of the cloud frame between two instants.

    Parameters
    ----------
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        N >= 1, ascending; ideally one before ``start`` and one after ``end``. A velocity's or
        gravity's stamp should lie within the path, so start early enough.
    start, end : HostNs
    T_cloud_imu : ndarray, shape (4, 4)
        IMU coordinates to cloud coordinates; its translation is the lever arm.
    bias : ndarray, shape (3,)
        Gyro bias [rad/s], IMU axes.
    velocities : ndarray, shape (M,), dtype VELOCITY, optional
        Without any the positions stay zero.
    gravity : Gravity, optional
        With it the accelerometer carries the velocity between and beyond ``velocities``.
    hold_ns : int
        Beyond the samples the mean of the nearest rates is held this long, then the rate is zero.

    Returns
    -------
    Path
        From ``start`` to ``end``, or one nanosecond long where ``end`` is not later.

    Raises
    ------
    ValueError
        If there is no sample.
    """
    if not len(samples):
        raise ValueError("samples: at least one IMU sample is needed to integrate")
    end = max(end, HostNs(start + 1))
    anchors = [gravity.stamp] if gravity is not None else []
    if velocities is not None:
        anchors.extend(velocities["stamp"])
    knots = _knots(samples["stamp"], start, end, hold_ns, anchors)
    times = _seconds(knots, start)
    R_cloud_imu = np.asarray(T_cloud_imu)[:3, :3]
    rates = _held(samples, start, knots, hold_ns, bias) @ R_cloud_imu.T

    dt = np.diff(times)[:, None]
    before, after = rates[:-1], rates[1:]
    turns = 0.5 * dt * (before + after) + (dt * dt / 12.0) * rotations.cross(before, after)
    identity = np.array([[1.0, 0.0, 0.0, 0.0]])
    q = rotations.cumulative(np.concatenate((identity, rotations.exp(turns))))

    positions = np.zeros((len(knots), 3))
    if velocities is not None and len(velocities):
        lever = np.asarray(T_cloud_imu)[:3, 3]
        carried = None
        if gravity is not None:
            carried = _specific_force(samples, start, times) @ R_cloud_imu.T
        positions = _translate(knots, q, rates, velocities, carried, gravity, lever)

    return Path(knots, q, positions, rates)


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


def _knots(
    stamps: NDArray[np.int64], start: HostNs, end: HostNs, hold_ns: int, anchors: list[HostNs]
) -> NDArray[np.int64]:
    """Return the knots of a path: its ends, samples and anchors, and more in a gap."""
    knots = [[start, end], stamps, anchors]
    if coverage(stamps, start, end)[1] > 2 * _STEP_NS:
        knots.append(np.arange(start, end, _STEP_NS))
        # where the hold begins and ends the rate changes within a nanosecond: knots on either side
        early, late = int(stamps[0]) - hold_ns, int(stamps[-1]) + hold_ns
        knots.append([early - 1, early, late, late + 1])
    joined = np.unique(np.concatenate([np.asarray(some, dtype=np.int64) for some in knots]))
    return joined[(joined >= start) & (joined <= end)]


def _held(
    samples: Samples, start: HostNs, knots: NDArray[np.int64], hold_ns: int, bias: F64
) -> F64:
    """Return the rates at the knots without bias, IMU axes, shape (K, 3)."""
    stamps = samples["stamp"]
    rates = samples["angular_velocity"] - bias
    early, late = knots < stamps[0], knots > stamps[-1]
    at_knots = _interpolated(_seconds(knots, start), _seconds(stamps, start), rates)
    if early.any():
        at_knots[early] = rates[:_TREND].mean(axis=0)
        at_knots[knots < stamps[0] - hold_ns] = 0.0
    if late.any():
        at_knots[late] = rates[-_TREND:].mean(axis=0)
        at_knots[knots > stamps[-1] + hold_ns] = 0.0
    return at_knots


def _specific_force(samples: Samples, start: HostNs, times: F64) -> F64:
    """Return the specific force [m/s^2] at times after the start, IMU axes, shape (K, 3)."""
    return _interpolated(times, _seconds(samples["stamp"], start), samples["linear_acceleration"])


def _interpolated(at: F64, times: F64, values: F64) -> F64:
    return np.stack([np.interp(at, times, column) for column in values.T], axis=-1)


def _translate(
    knots: NDArray[np.int64],
    q: F64,
    rates: F64,
    velocities: NDArray[np.void],
    force: F64 | None,
    gravity: Gravity | None,
    lever: F64,
) -> F64:
    """Return the positions at the knots in the frame of the first knot, shape (K, 3)."""
    times = _seconds(knots, knots[0])
    dt = np.diff(times)[:, None]
    known = _seconds(velocities["stamp"], knots[0])
    if force is None or gravity is None:
        world = rotations.rotate(q, _interpolated(times, known, velocities["velocity"]))
        return _summed(0.5 * dt * (world[:-1] + world[1:]))

    # the accelerometer feels the IMU's own origin: carry that along, then step back to the cloud's
    arms = rotations.rotate(q, lever)
    at_gravity = min(int(np.searchsorted(knots, gravity.stamp)), len(knots) - 1)
    acceleration = rotations.rotate(q, force) - rotations.rotate(q[at_gravity], gravity.up)
    gained = _summed(0.5 * dt * (acceleration[:-1] + acceleration[1:]))
    swing = rotations.rotate(q, rotations.cross(rates, lever))
    at = np.minimum(np.searchsorted(knots, velocities["stamp"]), len(knots) - 1)
    missing = rotations.rotate(q[at], velocities["velocity"]) + swing[at] - gained[at]
    v_imu = gained + _interpolated(times, known, missing)
    bend = dt * dt / 12.0 * (acceleration[:-1] - acceleration[1:])
    carried = _summed(0.5 * dt * (v_imu[:-1] + v_imu[1:]) + bend)
    return np.asarray(carried - (arms - arms[0]))


def _seconds(stamps: NDArray[np.int64], origin: int) -> F64:
    return np.asarray((stamps - origin) * 1e-9, dtype=np.float64)


def _summed(steps: F64) -> F64:
    return np.asarray(np.concatenate((np.zeros((1, 3)), np.cumsum(steps, axis=0))))
