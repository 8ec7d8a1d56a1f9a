"""Turns points into a levelled frame with the sensor's own orientation, one per packet.

This is what upstream's ``imu_adjust`` does. It is no motion compensation: it turns each packet as
a whole, knows no translation, and its result is level with gravity instead of fixed to the sensor.
The companion package deskews properly and needs this off.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.geometry import PointBatch
from l2lidar_node.types import HostNs, ImuSample

MAX_AGE_NS: Final = 80_000_000  # upstream's tolerance between a packet and its orientation
_HISTORY: Final = 8192  # samples, 32 s: more than the longest sweep


class Levelling:
    """Remembers the latest orientations and applies them to batches of points.

    Parameters
    ----------
    roll_pitch_only : bool
        Leave out the yaw, which is arbitrary and drifts.

    Attributes
    ----------
    dropped : int
        Points left out for want of an orientation.
    """

    def __init__(self, roll_pitch_only: bool) -> None:
        self.roll_pitch_only = roll_pitch_only
        self.dropped = 0
        self._samples: deque[ImuSample] = deque(maxlen=_HISTORY)

    def add(self, sample: ImuSample) -> None:
        """Remember a sample; they come in ascending order."""
        self._samples.append(sample)

    def clear(self) -> None:
        """Forget all samples, for example because the time line began anew."""
        self._samples.clear()

    def __call__(self, batch: PointBatch, starts: list[HostNs]) -> PointBatch:
        """Return the batch with its points turned about the origin of the cloud frame.

        Points of packets without an orientation within :data:`MAX_AGE_NS` are left out.
        """
        while self._samples and self._samples[0].stamp < starts[0] - MAX_AGE_NS:
            self._samples.popleft()
        orientations, known = self._orientations(np.array(starts, np.int64))
        rotations = _rotations(orientations)
        if self.roll_pitch_only:
            rotations = _without_yaw(rotations)
        points = batch.points.copy()
        x, y, z = (batch.points[name] for name in ("x", "y", "z"))
        for row, name in enumerate(("x", "y", "z")):
            weights = np.repeat(rotations[:, row].T, batch.counts, axis=1)
            points[name] = weights[0] * x + weights[1] * y + weights[2] * z
        if known.all():
            return PointBatch(points, batch.first_s, batch.counts)
        self.dropped += int(batch.counts[~known].sum())
        kept = np.repeat(known, batch.counts)
        return _keep(points, kept, batch.first_s, batch.counts * known)

    def _orientations(
        self, instants: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the orientations nearest to some instants, (P, 4), and which are near enough."""
        if not self._samples:
            return np.tile([1.0, 0.0, 0.0, 0.0], (len(instants), 1)), np.zeros(
                len(instants), np.bool_
            )
        stamps = np.array([sample.stamp for sample in self._samples], np.int64)
        after = np.clip(np.searchsorted(stamps, instants), 1, max(len(stamps) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(stamps) - 1)
        is_before_nearer = instants - stamps[before] <= stamps[after] - instants
        nearest = np.where(is_before_nearer, before, after)
        known = np.abs(stamps[nearest] - instants) <= MAX_AGE_NS
        wxyz = np.array([sample.orientation_wxyz for sample in self._samples])
        return wxyz[nearest], known


def _rotations(wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrices, (P, 3, 3), of unit quaternions, (P, 4)."""
    w, x, y, z = wxyz.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def _without_yaw(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotations, (P, 3, 3), turned back about the vertical by their yaw."""
    yaw = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    cos, sin, zero = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))
    rows = [[cos, sin, zero], [-sin, cos, zero], [zero, zero, zero + 1.0]]
    return np.asarray(np.array(rows).transpose(2, 0, 1) @ rotations)


def _keep(
    points: NDArray[np.void], mask: NDArray[np.bool_], first_s: float, counts: NDArray[np.intp]
) -> PointBatch:
    """Return the marked points, their times relative to the first of them."""
    points = points[mask]
    if len(points):
        first_s += float(points["time"][0])
        points["time"] -= points["time"][0]
    return PointBatch(points, first_s, counts)
