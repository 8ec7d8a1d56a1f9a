"""Carries the odometry of the cloud frame over to another frame fixed to it, such as base_link."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_proc.motion.filter import skew
from l2lidar_proc.odometry.estimate import OdometryEstimate
from l2lidar_proc.recording.outputs import StampedPoses, levelled_start

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class BaseMotion:
    """Pose and twist of the base frame.

    Attributes
    ----------
    T_odom_base : ndarray, shape (4, 4)
    covariance : ndarray, shape (6, 6)
        Of x, y, z and the turns about the odometry frame's axes [m, rad].
    velocity, angular_velocity : ndarray, shape (3,)
        Base axes [m/s, rad/s].
    twist_covariance : ndarray, shape (6, 6)
        Base axes.
    """

    T_odom_base: F64
    covariance: F64
    velocity: F64
    angular_velocity: F64
    twist_covariance: F64


class BaseFrame:
    """The base frame on the sensor; the odometry frame begins below its first place, yaw 0.

    Parameters
    ----------
    T_lidar_base : ndarray, shape (4, 4)
        Base coordinates to cloud coordinates.
    """

    def __init__(self, T_lidar_base: F64) -> None:
        self.T_lidar_base = np.asarray(T_lidar_base, dtype=np.float64)
        self._T_odom_map: F64 | None = None

    def reset(self) -> None:
        """Let the odometry frame begin at the next pose."""
        self._T_odom_map = None

    def odom_from_map(self, T_map_lidar: F64) -> F64:
        """Return what takes the odometry's own coordinates to the odometry frame, (4, 4).

        The first pose that is given decides.
        """
        if self._T_odom_map is None:
            self._T_odom_map = levelled_start(T_map_lidar @ self.T_lidar_base)
        return self._T_odom_map

    def pose(self, T_map_lidar: F64) -> F64:
        """Return the pose (..., 4, 4) of the base frame for one of the cloud frame."""
        return np.asarray(self.odom_from_map(T_map_lidar) @ T_map_lidar @ self.T_lidar_base)

    def poses(self, of_lidar: StampedPoses) -> StampedPoses:
        """Return the poses (N,) of the base frame for those of the cloud frame, oldest first."""
        found = of_lidar.copy()
        if len(found):
            self.odom_from_map(of_lidar["pose"][0])
            found["pose"] = self.pose(of_lidar["pose"])
        return found

    def motion(self, estimate: OdometryEstimate) -> BaseMotion:
        """Return an estimate as one of the base frame."""
        pose = estimate.T_map_lidar
        turn_odom = self.odom_from_map(pose)[:3, :3]
        arm = self.T_lidar_base[:3, 3]
        swing = np.eye(6)
        swing[:3, 3:] = -skew(pose[:3, :3] @ arm)
        swing = _twice(turn_odom) @ swing
        turn_base = self.T_lidar_base[:3, :3].T
        twist = np.eye(6)
        twist[:3, 3:] = -skew(arm)
        twist = _twice(turn_base) @ twist
        velocity = estimate.velocity + rotations.cross(estimate.angular_velocity, arm)
        return BaseMotion(
            self.pose(pose),
            swing @ estimate.covariance @ swing.T,
            turn_base @ velocity,
            turn_base @ estimate.angular_velocity,
            twist @ estimate.twist_covariance @ twist.T,
        )


def _twice(turn: F64) -> F64:
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = turn
    return out
