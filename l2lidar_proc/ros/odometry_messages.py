"""Conversions of odometry estimates to ROS messages."""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Pose, PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from tf2_msgs.msg import TFMessage

from l2lidar_node import rotations
from l2lidar_node.ros.conversions import STAMP, diagnostic_status, to_time
from l2lidar_node.types import F64, Check, HostNs, Level, split_stamp
from l2lidar_proc.cloud import positions
from l2lidar_proc.odometry.estimate import BaseMotion, OdometryEstimate, Status

if TYPE_CHECKING:
    from l2lidar_proc.slam.nodes import Keyframe  # brings half of scipy along

UNKNOWN_VARIANCE: Final = 9999.0
"""What rtabmap takes for a pose or velocity that is not known."""

_STAMP_AT: Final = 8  # behind the encapsulation and the number of transforms
# translation, then rotation x, y, z, w; the end of the message
_TRANSFORM: Final = struct.Struct("<7d")

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


def set_unknown(message: Odometry) -> None:
    """Give an odometry message the variances that rtabmap takes for "not known"."""
    unknown = (UNKNOWN_VARIANCE * np.eye(6)).ravel()
    message.pose.covariance = unknown
    message.twist.covariance = unknown


def odometry_status(
    estimate: OdometryEstimate, base_frame: str, T_map_base: F64, now: int
) -> DiagnosticArray:
    """Return the status of an estimate, with the estimate's stamp.

    The message is ``ALIGNED``, or the names of :class:`Status` that apply, comma-separated; the
    values are explained in docs/slam.md.

    Parameters
    ----------
    estimate : OdometryEstimate
    base_frame : str
    T_map_base : ndarray, shape (4, 4)
        Base coordinates to the odometry's own ones.
    now : int
        [ns]
    """
    lost = {Status.LOST, Status.RESTARTED} & set(estimate.status)
    level = Level.WARN if estimate.status else Level.OK
    quality = estimate.quality
    sigma = np.sqrt(np.diag(estimate.covariance))
    degenerate = np.zeros(3)
    if Status.DEGENERATE in estimate.status:
        degenerate = T_map_base[:3, :3].T @ quality.weakest
    values = {
        "matched": quality.matched,
        "inlier_ratio": f"{quality.inlier_ratio:.4f}",
        "residual_m": f"{quality.residual_m:.4f}",
        "degeneracy_ratio": f"{quality.degeneracy_ratio:.4f}",
        "degenerate_direction": " ".join(f"{axis + 0.0:.3f}" for axis in degenerate),
        "position_sigma_m": f"{sigma[:3].max():.4f}",
        "attitude_sigma_rad": f"{sigma[3:].max():.5f}",
        "speed_sigma_m_s": f"{estimate.speed_sigma:.4f}",
        "nis": f"{quality.nis_per_dof:.3f}",
        "velocity_nis": f"{quality.velocity_nis_per_dof:.3f}",
        "variance_factor": f"{quality.variance_factor:.2f}",
        "tilt_rad": f"{estimate.tilt:.5f}",
        "age_s": f"{(now - estimate.stamp) * 1e-9:.3f}",
    }
    check = Check(
        "odometry",
        Level.ERROR if lost else level,
        ",".join(status.name for status in estimate.status) or "ALIGNED",
        {name: str(value) for name, value in values.items()},
    )
    message = DiagnosticArray(status=[diagnostic_status(check)])
    message.header.stamp = to_time(estimate.stamp)
    message.header.frame_id = base_frame
    return message


def keyframe(given: Keyframe, odom_frame: str, frame: str) -> Odometry:
    """Return a keyframe: its pose, and as covariance that of the motion since the one before.

    In the axes of the odometry frame, as ROS wants it; 9999 where the motion is not known. The
    twist, where rtabmap looks for the covariance of a link, has the same in the keyframe's axes.
    """
    message = Odometry(child_frame_id=frame)
    message.header.stamp = to_time(given.stamp)
    message.header.frame_id = odom_frame
    message.pose.pose = pose(given.T_odom_node)
    if given.covariance is None:
        set_unknown(message)
        return message
    order = [3, 4, 5, 0, 1, 2]
    own = given.covariance[np.ix_(order, order)]
    turn = np.kron(np.eye(2), given.T_odom_node[:3, :3])
    message.pose.covariance = (turn @ own @ turn.T).ravel()
    message.twist.covariance = own.ravel()
    return message


def transform(matrix: F64, stamp: HostNs, parent: str, child: str) -> bytes:
    """Return the serialized TFMessage of a transform (4, 4), child to parent coordinates.

    Publishers take it as they take messages. Fifty times a second it costs a fifth of what rclpy
    needs to convert one field by field.
    """
    before, between = _transform_layout(parent, child)
    w, x, y, z = rotations.from_matrix(matrix[:3, :3]).tolist()
    numbers = _TRANSFORM.pack(*matrix[:3, 3].tolist(), x, y, z, w)
    return b"".join((before, STAMP.pack(*split_stamp(stamp)), between, numbers))


@lru_cache(maxsize=16)
def _transform_layout(parent: str, child: str) -> tuple[bytes, bytes]:
    """Return the bytes before and after the stamp, up to the numbers."""
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    data = serialize_message(TFMessage(transforms=[message]))
    return data[:_STAMP_AT], data[_STAMP_AT + STAMP.size : -_TRANSFORM.size]


def pose(matrix: F64) -> Pose:
    """Return a pose (4, 4)."""
    message = Pose()
    _set(message.position, matrix[:3, 3])
    _turn(message.orientation, matrix)
    return message


def matrix(pose: Pose) -> F64:
    """Return the (4, 4) of a pose; not finite where its quaternion is not one."""
    q = pose.orientation
    quaternion = np.array((q.w, q.x, q.y, q.z))
    norm = np.linalg.norm(quaternion)
    if not 0.5 < norm < 2.0:
        return np.full((4, 4), np.nan)
    place = pose.position
    return rotations.transform(quaternion / norm, (place.x, place.y, place.z))


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
    xyz = positions(points)
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
