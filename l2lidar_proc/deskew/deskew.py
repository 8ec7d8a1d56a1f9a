"""Deskew: moves every point of a sweep to the pose at one instant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records, rotations
from l2lidar_node.types import F32, HostNs
from l2lidar_proc.motion.sweep_motion import SweepTrajectory


def deskew(
    points: NDArray[np.void], start: HostNs, trajectory: SweepTrajectory, reference: HostNs
) -> NDArray[np.void]:
    """Return the points in the cloud frame of one instant.

    Parameters
    ----------
    points : ndarray, shape (N,)
        Structured with at least ``x``, ``y``, ``z`` [m] (cloud frame of each point's own instant)
        and ``time`` [s] after ``start``, ascending.
    start : HostNs
        Instant that ``time`` counts from.
    trajectory : SweepTrajectory
        Covers the points and the reference; beyond its ends its end poses hold.
    reference : HostNs
        The instant to move to.

    Returns
    -------
    ndarray, shape (N,)
        Same dtype and other fields; the very same array where the trajectory does not move.

    Notes
    -----
    A point is turned by what was turned since the knot before it (Rodrigues' formula to the fourth
    order: the angle is a few hundredths of a radian, the remainder below a micrometre), then by
    the pose of that knot as ``p + (R - I) p + d``, which keeps small turns exact in single
    precision.
    """
    if not len(points) or trajectory.is_still:
        return points
    moved = records.copied(points)
    for name, coordinate in zip(
        "xyz", coordinates(points, start, trajectory, reference), strict=True
    ):
        moved[name] = coordinate
    return moved


def coordinates(
    points: NDArray[np.void], start: HostNs, trajectory: SweepTrajectory, reference: HostNs
) -> tuple[F32, F32, F32]:
    """Return x, y and z in the cloud frame of one instant [m], each of shape (N,).

    Parameters are those of :func:`deskew`.
    """
    x, y, z = (np.ascontiguousarray(points[name], dtype=np.float32) for name in "xyz")
    if not len(points) or trajectory.is_still:
        return x, y, z
    times = np.ascontiguousarray(points["time"])
    knots = ((trajectory.stamps - start) * 1e-9).astype(np.float32)
    cuts = np.searchsorted(times, knots[1:-1])
    counts = np.diff(cuts, prepend=0, append=len(times))
    table = _table(trajectory, knots, reference)
    # one row per coefficient, one column per point: plain contiguous vectors from here on
    t0, wx, wy, wz, sx, sy, sz, vx, vy, vz, *pose = np.repeat(table, counts, axis=1)
    xx, xy, xz, yx, yy, yz, zx, zy, zz, dx, dy, dz = pose

    t = times - t0
    half = np.float32(0.5) * t
    ax, ay, az = t * (wx + half * sx), t * (wy + half * sy), t * (wz + half * sz)
    square = ax * ax + ay * ay + az * az
    sine = np.float32(1.0) - square * np.float32(1.0 / 6.0)
    cosine = np.float32(0.5) - square * np.float32(1.0 / 24.0)

    cx, cy, cz = ay * z - az * y, az * x - ax * z, ax * y - ay * x
    tx = x + sine * cx + cosine * (ay * cz - az * cy)
    ty = y + sine * cy + cosine * (az * cx - ax * cz)
    tz = z + sine * cz + cosine * (ax * cy - ay * cx)
    return (
        tx + (xx * tx + xy * ty + xz * tz + dx + t * vx),
        ty + (yx * tx + yy * ty + yz * tz + dy + t * vy),
        tz + (zx * tx + zy * ty + zz * tz + dz + t * vz),
    )


def _table(trajectory: SweepTrajectory, knots: F32, reference: HostNs) -> F32:
    """Return the motion from each knot on, seen from the reference, shape (22, K - 1).

    Rows: instant [s]; rate (3) [rad/s] and its slope (3) [rad/s^2]; velocity (3) [m/s]; R - I row
    by row (9); position (3) [m].
    """
    q_reference, p_reference = trajectory.pose(reference)
    R_reference = rotations.matrices(q_reference)
    turn = R_reference.T @ rotations.matrices(trajectory.rotations_wxyz[:-1]) - np.eye(3)
    position = (trajectory.positions - p_reference) @ R_reference
    seconds = np.diff(trajectory.stamps)[:, None] * 1e-9
    slope = np.diff(trajectory.rates, axis=0) / seconds
    velocity = np.diff(position, axis=0) / seconds
    columns = (
        knots[:-1, None],
        trajectory.rates[:-1],
        slope,
        velocity,
        turn.reshape(-1, 9),
        position[:-1],
    )
    return np.concatenate(columns, axis=1).astype(np.float32).T
