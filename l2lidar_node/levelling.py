"""Turns points into a levelled frame with the sensor's own orientation, one per packet.

This is what upstream's ``imu_adjust`` does. It is no motion compensation: it turns each packet as
a whole, knows no translation, and its result is level with gravity instead of fixed to the sensor.
The companion package deskews properly and needs this off.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.geometry import PointBatch
from l2lidar_node.types import HostNs, ImuSample, Quaternion

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
        samples = list(self._samples)
        stamps = [sample.stamp for sample in samples]
        matrices = np.zeros((len(starts), 3, 3))
        known = np.zeros(len(starts), np.bool_)
        for index, start in enumerate(starts):
            nearest = _nearest(stamps, start)
            if nearest is not None:
                known[index] = True
                matrices[index] = self._rotation(samples[nearest].orientation_wxyz)
        points = batch.points.copy()
        xyz = np.stack([points["x"], points["y"], points["z"]], axis=1, dtype=np.float64)
        packet = np.repeat(np.arange(len(starts)), batch.counts)
        turned = np.einsum("nij,nj->ni", matrices[packet], xyz)
        for axis, name in enumerate(("x", "y", "z")):
            points[name] = turned[:, axis]
        if known.all():
            return PointBatch(points, batch.first_s, batch.counts)
        self.dropped += int(batch.counts[~known].sum())
        return _keep(points, known[packet], batch.first_s, batch.counts * known)

    def _rotation(self, wxyz: Quaternion) -> NDArray[np.float64]:
        """Return the rotation from the sensor to the levelled frame."""
        w, x, y, z = wxyz
        matrix = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        if not self.roll_pitch_only:
            return matrix
        yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
        cos, sin = np.cos(yaw), np.sin(yaw)
        unturn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(unturn @ matrix)


def _nearest(stamps: list[HostNs], instant: HostNs) -> int | None:
    """Return the index of the stamp nearest to an instant; None if none is near enough."""
    after = bisect_right(stamps, instant)
    near = [index for index in (after - 1, after) if 0 <= index < len(stamps)]
    best = min(near, key=lambda index: abs(stamps[index] - instant), default=None)
    return None if best is None or abs(stamps[best] - instant) > MAX_AGE_NS else best


def _keep(
    points: NDArray[np.void], mask: NDArray[np.bool_], first_s: float, counts: NDArray[np.intp]
) -> PointBatch:
    """Return the marked points, their times relative to the first of them."""
    points = points[mask]
    if len(points):
        first_s += float(points["time"][0])
        points["time"] -= points["time"][0]
    return PointBatch(points, first_s, counts)
