"""Velocity along bare walls, measured where the surfaces of the map do not constrain it.

The profile of the walls is used first: it is seldom precise but never far off. That leaves the
vertical lines, which are precise, little room for false votes.
"""

from __future__ import annotations

import numpy as np

from l2lidar_node.types import F64
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.motion.passed_places import correction_of_passed
from l2lidar_proc.odometry.walls.vertical_lines import Lines, VerticalLines
from l2lidar_proc.odometry.walls.wall_profile import Spots, WallProfile


def level_axes(direction: F64, gravity: F64) -> F64:
    """Return level axes as the rows of a rotation matrix: along, across to the left, and up.

    Parameters
    ----------
    direction : ndarray, shape (3,)
        Map axes; not vertical.
    gravity : ndarray, shape (3,)
        [m/s^2]
    """
    up = -gravity / np.linalg.norm(gravity)
    along = direction - (direction @ up) * up
    along /= np.linalg.norm(along)
    return np.stack((along, np.cross(up, along), up))


class WallVelocity:
    """Measures the velocity along walls between which a carrier drives."""

    def __init__(self) -> None:
        self._profile = WallProfile()
        self._lines = VerticalLines()

    def clear(self) -> None:
        """Forget all that was seen."""
        self._profile.clear()
        self._lines.clear()

    def correct(self, before: InertialState, after: InertialState) -> None:
        """Move what was seen along with a correction of the state at one instant.

        Parameters
        ----------
        before, after : InertialState
            At the same instant, not before anything that was seen.
        """
        self._profile.correct(before, after)
        self._lines.correct(before, after)

    def update(
        self, state: InertialState, covariance: F64, spots: Spots, lines: Lines, axes: F64
    ) -> tuple[InertialState, F64]:
        """Return state and covariance after a sweep.

        Parameters
        ----------
        state : InertialState
            At the sweep's reference; it has placed spots and lines.
        covariance : ndarray, shape (18, 18)
        spots : ndarray, shape (N,), dtype SPOT
        lines : ndarray, shape (M,), dtype LINE
        axes : ndarray, shape (3, 3)
            As :func:`level_axes` returns them.
        """
        profiled, covariance = self._profile.update(state, covariance, spots, axes)
        self._lines.correct(state, profiled)
        if len(lines):
            lines = lines.copy()
            lines["place"] += correction_of_passed(state, profiled, lines["stamp"])
        after, covariance = self._lines.update(profiled, covariance, lines, axes)
        self._profile.correct(profiled, after)
        return after, covariance
