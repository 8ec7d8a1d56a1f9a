"""Sweep trajectory: poses of the cloud frame at knots of time, continuous between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import F64, HostNs
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.motion.preintegration import Preintegration


@dataclass(frozen=True, slots=True, eq=False)
class SweepTrajectory:
    """Poses of the cloud frame at knots, all in one frame.

    Attributes
    ----------
    stamps : ndarray, shape (K,), int64
        Knots [ns], strictly ascending, K >= 2.
    rotations_wxyz : ndarray, shape (K, 4)
        Cloud axes at the knot to the axes of that frame.
    positions : ndarray, shape (K, 3)
        Origin at the knot [m].
    rates : ndarray, shape (K, 3)
        Angular velocity without bias [rad/s], cloud axes; linear in time between knots.
    """

    stamps: NDArray[np.int64]
    rotations_wxyz: F64
    positions: F64
    rates: F64

    @classmethod
    def of(
        cls, preintegrated: Preintegration, state: InertialState, lever: F64
    ) -> SweepTrajectory:
        """Return the trajectory of the cloud frame, seen from it at a state's instant.

        Parameters
        ----------
        preintegrated : Preintegration
            Anchored at the state.
        state : InertialState
        lever : ndarray, shape (3,)
            Place of the IMU in the cloud frame [m], whose axes are the sensor's.
        """
        dt = ((preintegrated.stamps - preintegrated.stamps[preintegrated.anchor]) * 1e-9)[:, None]
        travelled = (dt * state.velocity + 0.5 * dt * dt * state.gravity) @ state.rotation
        q = preintegrated.rotations_wxyz
        arms = lever - rotations.rotate(q, lever)
        positions = travelled + preintegrated.positions + arms
        return cls(preintegrated.stamps, q, positions, preintegrated.rates)

    @property
    def is_still(self) -> bool:
        """Whether nothing moves at all."""
        return not (self.rates.any() or self.positions.any())

    def pose(self, stamp: HostNs) -> tuple[F64, F64]:
        """Return rotation (w, x, y, z), shape (4,), and position [m], shape (3,), at an instant.

        Instants outside the knots take the pose of the nearer end.
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

    def without_translation(self) -> SweepTrajectory:
        """Return the rotations alone."""
        nowhere = np.zeros_like(self.positions)
        return SweepTrajectory(self.stamps, self.rotations_wxyz, nowhere, self.rates)


def still_trajectory(start: HostNs, end: HostNs) -> SweepTrajectory:
    """Return the trajectory of a sensor that does not move."""
    stamps = np.array([start, max(end, start + 1)], dtype=np.int64)
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    return SweepTrajectory(stamps, identity, np.zeros((2, 3)), np.zeros((2, 3)))
