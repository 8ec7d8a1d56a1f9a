"""Each number of a sample arrives in its own field of the message."""

from __future__ import annotations

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from rclpy.serialization import deserialize_message  # noqa: E402  after importorskip
from sensor_msgs.msg import Imu  # noqa: E402

from l2lidar_node.config import ImuConfig  # noqa: E402
from l2lidar_node.ros.conversions import ImuTemplate, from_time, to_time  # noqa: E402
from l2lidar_node.settings import build  # noqa: E402
from l2lidar_node.types import (  # noqa: E402
    FIRST_STAMP,
    LAST_STAMP,
    HostNs,
    ImuSample,
    StampError,
)

pytestmark = pytest.mark.ros

NAMES = (
    "roll_covar", "pitch_covar", "yaw_covar", "gyro_x_covar", "gyro_y_covar", "gyro_z_covar",
    "accel_x_covar", "accel_y_covar", "accel_z_covar",
)  # fmt: skip


def test_an_imu_message_has_every_number_in_its_place() -> None:
    config = build(ImuConfig, {name: number + 1.0 for number, name in enumerate(NAMES)})
    stamp = HostNs(1_700_000_000_000_000_005)
    sample = ImuSample(stamp, (0.1, 0.2, 0.3, 0.4), (0.5, 0.6, 0.7), (0.8, 0.9, 1.0))
    message = deserialize_message(ImuTemplate("imu", config).serialize(sample), Imu)
    assert message.header.frame_id == "imu"
    assert from_time(message.header.stamp) == stamp
    q = message.orientation
    assert (q.w, q.x, q.y, q.z) == sample.orientation_wxyz
    rate, force = message.angular_velocity, message.linear_acceleration
    assert (rate.x, rate.y, rate.z) == sample.angular_velocity
    assert (force.x, force.y, force.z) == sample.linear_acceleration
    for field, diagonal in (
        ("orientation", [1.0, 2.0, 3.0]),
        ("angular_velocity", [4.0, 5.0, 6.0]),
        ("linear_acceleration", [7.0, 8.0, 9.0]),
    ):
        found = np.reshape(getattr(message, f"{field}_covariance"), (3, 3))
        np.testing.assert_array_equal(found, np.diag(diagonal))


@pytest.mark.parametrize("stamp", [FIRST_STAMP, HostNs(-1), HostNs(0), LAST_STAMP])
def test_every_time_that_fits_goes_there_and_back(stamp: HostNs) -> None:
    assert from_time(to_time(stamp)) == stamp


@pytest.mark.parametrize("stamp", [FIRST_STAMP - 1, LAST_STAMP + 1, 10**30])
def test_a_time_that_does_not_fit_is_named(stamp: int) -> None:
    with pytest.raises(StampError, match="s after 1970 is out of range"):
        to_time(HostNs(stamp))
