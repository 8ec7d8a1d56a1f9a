"""Turns IMU messages into samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Imu

from l2lidar_node.ros.conversions import from_time
from l2lidar_node.types import IMU_SAMPLE


def to_sample(message: Imu) -> NDArray[np.void]:
    """Return an IMU message as a sample, shape (1,), dtype IMU_SAMPLE."""
    q, rate, force = message.orientation, message.angular_velocity, message.linear_acceleration
    row = (
        from_time(message.header.stamp),
        (q.w, q.x, q.y, q.z),
        (rate.x, rate.y, rate.z),
        (force.x, force.y, force.z),
    )
    return np.array([row], dtype=IMU_SAMPLE)
