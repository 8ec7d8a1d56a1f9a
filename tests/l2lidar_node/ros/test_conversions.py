"""Each number of a sample arrives in its own field of the message."""

from __future__ import annotations

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from rclpy.serialization import deserialize_message, serialize_message  # noqa: E402  after importorskip
from sensor_msgs.msg import Imu, PointCloud2  # noqa: E402

from l2lidar_node.config import ImuConfig  # noqa: E402
from l2lidar_node.ros.conversions import ImuTemplate, from_cloud, from_time, to_time  # noqa: E402
from l2lidar_node.settings import build  # noqa: E402
from l2lidar_node.types import (  # noqa: E402
    FIRST_STAMP,
    LAST_STAMP,
    POINT,
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


@pytest.mark.parametrize("is_lossy", [False, True])
@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 7000])
def test_a_compressed_cloud_is_read_as_the_zstd_plugin_reads_it(
    count: int, is_lossy: bool
) -> None:
    pytest.importorskip("point_cloud_interfaces")
    import zstandard
    from point_cloud_interfaces.msg import CompressedPointCloud2

    from l2lidar_node.ros.compressed_cloud import GRID_M, CompressedCloudTemplate

    rng = np.random.default_rng(count)
    points = np.zeros(count, POINT)
    for name in POINT.names or ():
        points[name] = rng.uniform(-30.0, 30.0, count)
    stamp = HostNs(1_700_000_000_000_000_005)
    template = CompressedCloudTemplate(POINT, "l2lidar_link", 1, is_lossy)
    data = template.serialize(points, stamp)
    message = deserialize_message(data, CompressedPointCloud2)
    assert len(serialize_message(message)) == len(data)  # its padding is not all zero
    assert message.format == "zstd"
    compressed = bytes(message.compressed_data)
    # one frame that says how large its content is, or the plugin refuses it
    size = zstandard.frame_content_size(compressed)
    assert size == message.row_step == message.point_step * message.width
    cloud = PointCloud2(
        header=message.header,
        height=message.height,
        width=message.width,
        fields=message.fields,
        is_bigendian=message.is_bigendian,
        point_step=message.point_step,
        row_step=message.row_step,
        data=zstandard.ZstdDecompressor().decompress(compressed),
        is_dense=message.is_dense,
    )
    assert (from_time(cloud.header.stamp), cloud.header.frame_id) == (stamp, "l2lidar_link")
    found = from_cloud(cloud)
    assert len(found) == count
    if not is_lossy:
        assert found.tobytes() == points.tobytes()
        return
    assert found.dtype.names == ("x", "y", "z", "intensity")
    assert (found["intensity"] == points["intensity"]).all()
    for axis in "xyz":
        assert np.abs(found[axis] - points[axis]).max(initial=0.0) <= GRID_M / 2 * 1.001
