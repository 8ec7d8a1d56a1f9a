"""Messages of the odometry: order of quaternions and covariances, frames, stamps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from tf2_msgs.msg import TFMessage

from l2lidar_node import rotations
from l2lidar_node.types import HostNs
from l2lidar_proc.odometry.estimate import BaseMotion
from l2lidar_proc.ros import odometry_messages as messages

pytestmark = pytest.mark.ros
POSE = rotations.transform(rotations.exp((0.1, 0.3, -0.7)), (2.0, -1.0, 0.5))
XYZW = Rotation.from_matrix(POSE[:3, :3]).as_quat(canonical=True)


def quaternion(message: Any) -> list[float]:
    return [message.x, message.y, message.z, message.w]


def transform_of(message: bytes) -> Any:
    (found,) = deserialize_message(message, TFMessage).transforms
    return found


@pytest.mark.parametrize("length", range(1, 10))
def test_a_transform_is_serialized_as_rclpy_does(length: int) -> None:
    data = messages.transform(POSE, HostNs(-3_999_999_999), "o" * length, "base")
    found = transform_of(data)
    # rclpy leaves the bytes between strings and numbers as they are in memory
    by_rclpy = serialize_message(TFMessage(transforms=[found]))
    assert len(by_rclpy) == len(data)
    assert transform_of(by_rclpy) == found
    np.testing.assert_array_equal(quaternion(found.transform.rotation), XYZW)
    place = found.transform.translation
    assert (place.x, place.y, place.z) == (2.0, -1.0, 0.5)
    assert (found.header.frame_id, found.child_frame_id) == ("o" * length, "base")
    assert (found.header.stamp.sec, found.header.stamp.nanosec) == (-4, 1)


def test_quaternions_are_x_y_z_w_in_every_message() -> None:
    motion = BaseMotion(POSE, np.eye(6), np.zeros(3), np.zeros(3), np.eye(6))
    stamp = HostNs(5_000_000_007)
    odometry = messages.odometry(motion, stamp, "odom", "base")
    transform = transform_of(messages.transform(POSE, stamp, "odom", "base"))
    path = messages.pose_stamped(POSE, stamp, "odom")
    for found in (
        odometry.pose.pose.orientation,
        transform.transform.rotation,
        path.pose.orientation,
    ):
        np.testing.assert_allclose(quaternion(found), XYZW, atol=1e-12)
    for place in (
        odometry.pose.pose.position,
        transform.transform.translation,
        path.pose.position,
    ):
        assert (place.x, place.y, place.z) == (2.0, -1.0, 0.5)
    for header in (odometry.header, transform.header, path.header):
        assert (header.stamp.sec, header.stamp.nanosec, header.frame_id) == (5, 7, "odom")
    assert odometry.child_frame_id == transform.child_frame_id == "base"


def test_twist_and_covariances_are_in_their_places() -> None:
    pose, twist = np.arange(36.0).reshape(6, 6), np.arange(36.0, 72.0).reshape(6, 6)
    motion = BaseMotion(POSE, pose, np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]), twist)
    found = messages.odometry(motion, HostNs(0), "odom", "base")
    linear, angular = found.twist.twist.linear, found.twist.twist.angular
    assert (linear.x, linear.y, linear.z) == (1.0, 2.0, 3.0)
    assert (angular.x, angular.y, angular.z) == (4.0, 5.0, 6.0)
    assert found.pose.covariance.tolist() == pose.ravel().tolist()
    assert found.twist.covariance.tolist() == twist.ravel().tolist()
