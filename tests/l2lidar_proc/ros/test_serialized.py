"""Serialized messages are read as rclpy reads them, and bytes that are none do no harm."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu

from l2lidar_node.clouds import LAYOUTS
from l2lidar_node.ros.conversions import to_cloud, to_time
from l2lidar_node.types import HostNs
from l2lidar_proc.ros import serialized
from tests.l2lidar_proc.motion.analytic import Motion, at, seen

pytestmark = pytest.mark.ros
SAMPLES = Motion(turn=1.0, nod=0.2, speed=1.0).imu(0.0, 0.2)


def message(sample: np.void, frame: str) -> bytes:
    made = Imu()
    made.header.stamp = to_time(HostNs(int(sample["stamp"])))
    made.header.frame_id = frame
    w, x, y, z = sample["orientation_wxyz"].tolist()
    q = made.orientation
    q.w, q.x, q.y, q.z = w, x, y, z
    rate, force = made.angular_velocity, made.linear_acceleration
    rate.x, rate.y, rate.z = sample["angular_velocity"].tolist()
    force.x, force.y, force.z = sample["linear_acceleration"].tolist()
    made.orientation_covariance = np.arange(9.0)
    made.angular_velocity_covariance = np.arange(9.0, 18.0)
    made.linear_acceleration_covariance = np.arange(18.0, 27.0)
    return bytes(serialize_message(made))


@pytest.mark.parametrize("frame", ["", "a", "imu", "l2lidar_imu", "front/l2lidar_imü_and_more"])
def test_a_batch_is_what_was_sent(frame: str) -> None:
    (found,) = serialized.imu_batches([message(sample, frame) for sample in SAMPLES])
    assert found.frame == frame
    assert (found.samples == SAMPLES).all()


def test_frames_are_kept_apart_in_their_order() -> None:
    frames = ["one", "two", "two", "six", "one"]
    sent = [message(s, f) for s, f in zip(SAMPLES[:5], frames, strict=True)]
    found = list(serialized.imu_batches(sent))
    assert [batch.frame for batch in found] == ["one", "two", "six", "one"]
    assert (np.concatenate([batch.samples for batch in found]) == SAMPLES[:5]).all()


def test_another_layout_takes_the_ordinary_path() -> None:
    plain = message(SAMPLES[3], "imu")
    longer = plain + b"\0\0\0\0"
    found = list(serialized.imu_batches([plain, longer, plain]))
    assert [len(batch.samples) for batch in found] == [1, 1, 1]
    assert all((batch.samples == SAMPLES[3:4]).all() for batch in found)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_cloud_is_what_was_sent(layout: str) -> None:
    points, _ = seen(Motion(), 0.0, 0.2, 0.0, count=50)
    sent = LAYOUTS[layout].convert(points, at(1.5))
    found = serialized.cloud(bytes(serialize_message(to_cloud(sent, at(1.5), "l2lidar_link"))))
    assert (found.points == sent).all()
    assert found.stamp == at(1.5)
    assert found.frame == "l2lidar_link"


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_damaged_messages_are_errors_or_left_out(data: st.DataObject) -> None:
    points, _ = seen(Motion(), 0.0, 0.2, 0.0, count=20)
    kind = data.draw(st.sampled_from(["imu", "cloud"]))
    whole = (
        message(SAMPLES[0], "imu")
        if kind == "imu"
        else bytes(serialize_message(to_cloud(points, at(0), "lidar")))
    )
    damaged = bytearray(whole[: data.draw(st.integers(8, len(whole)))])
    for _ in range(data.draw(st.integers(0, 3))):
        # the head, where lengths stand; an impossible length must not be believed
        place = data.draw(st.integers(4, min(len(damaged), 80) - 1))
        damaged[place] = data.draw(st.integers(0, 255))
    if kind == "imu":
        assert sum(len(batch.samples) for batch in serialized.imu_batches([bytes(damaged)])) <= 1
    else:
        try:
            found = serialized.cloud(bytes(damaged))
        except ValueError:
            return
        assert found.points.nbytes <= len(damaged)
