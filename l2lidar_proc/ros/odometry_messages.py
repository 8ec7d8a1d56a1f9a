"""Turns what the odometry says into messages."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from geometry_msgs.msg import Pose, PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray

from l2lidar_node.ros.conversions import to_time
from l2lidar_node.types import F64, HostNs
from l2lidar_proc import rotations
from l2lidar_proc.odometry.base_frame import BaseMotion

XYZ: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


def odometry(motion: BaseMotion, stamp: HostNs, odom_frame: str, base_frame: str) -> Odometry:
    """Return pose and twist of the base frame with their covariances."""
    message = Odometry(child_frame_id=base_frame)
    message.header.stamp = to_time(stamp)
    message.header.frame_id = odom_frame
    message.pose.pose = pose(motion.T_odom_base)
    message.pose.covariance = motion.covariance.ravel()
    _set(message.twist.twist.linear, motion.velocity)
    _set(message.twist.twist.angular, motion.angular_velocity)
    message.twist.covariance = motion.twist_covariance.ravel()
    return message


def transform(matrix: F64, stamp: HostNs, parent: str, child: str) -> TransformStamped:
    """Return a transform (4, 4), child coordinates to parent coordinates."""
    message = TransformStamped(child_frame_id=child)
    message.header.stamp = to_time(stamp)
    message.header.frame_id = parent
    _set(message.transform.translation, matrix[:3, 3])
    _turn(message.transform.rotation, matrix)
    return message


def pose(matrix: F64) -> Pose:
    """Return a pose (4, 4)."""
    message = Pose()
    _set(message.position, matrix[:3, 3])
    _turn(message.orientation, matrix)
    return message


def pose_stamped(matrix: F64, stamp: HostNs, frame: str) -> PoseStamped:
    """Return a pose (4, 4) in a frame."""
    message = PoseStamped()
    message.header.stamp = to_time(stamp)
    message.header.frame_id = frame
    message.pose = pose(matrix)
    return message


def moved(points: NDArray[np.void], matrix: F64) -> NDArray[np.void]:
    """Return structured points (N,) moved by a transform (4, 4), without their times."""
    names = [name for name in points.dtype.names or () if name != "time"]
    out = np.empty(len(points), [(name, points.dtype[name]) for name in names])
    for name in names:
        out[name] = points[name]
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float64)
    for axis, column in zip("xyz", (xyz @ matrix[:3, :3].T + matrix[:3, 3]).T, strict=True):
        out[axis] = column
    return out


def as_cloud(points: F64) -> NDArray[np.void]:
    """Return points (N, 3) as structured ones."""
    return np.ascontiguousarray(points, dtype=np.float32).view(XYZ).reshape(-1)


def are_apart(first: F64, second: F64, distance: float, angle: float) -> bool:
    """Return whether poses (4, 4) differ by more than a distance [m] or an angle [rad]."""
    if not np.isfinite(first).all() or np.linalg.norm(first[:3, 3] - second[:3, 3]) > distance:
        return True
    cosine = (np.trace(first[:3, :3].T @ second[:3, :3]) - 1.0) / 2.0
    return bool(cosine < np.cos(angle))


def _set(vector: Any, values: F64) -> None:
    vector.x, vector.y, vector.z = values.tolist()


def _turn(quaternion: Any, matrix: F64) -> None:
    w, x, y, z = rotations.from_matrix(matrix[:3, :3]).tolist()
    quaternion.w, quaternion.x, quaternion.y, quaternion.z = w, x, y, z
