"""Questions for imu_adjust, to real parameter services."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy")

from rclpy.executors import SingleThreadedExecutor  # noqa: E402  after importorskip
from sensor_msgs.msg import PointCloud2  # noqa: E402

from l2lidar_node.ros.mounting import ImuAdjustClient  # noqa: E402
from tests.l2lidar_node.ros.rig import TIMEOUT_S  # noqa: E402

pytestmark = pytest.mark.ros


@pytest.fixture
def nodes() -> Iterator[tuple[Any, Any]]:
    """A node that asks, and a publisher of clouds."""
    rclpy.init()
    asking, publisher = rclpy.create_node("asking"), rclpy.create_node("publisher")
    publisher.create_publisher(PointCloud2, "/points", 1)
    yield asking, publisher
    publisher.destroy_node()
    asking.destroy_node()
    rclpy.shutdown()


def until(condition: Callable[[], object], *nodes: Any) -> None:
    """Spin nodes until a condition holds."""
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline
        executor.spin_once(timeout_sec=0.05)
    for node in nodes:
        executor.remove_node(node)
    executor.shutdown()


def test_questions_that_are_not_answered_do_not_pile_up(nodes: Any) -> None:
    asking, publisher = nodes
    adjust = ImuAdjustClient(asking, "/points", period_s=3600.0)

    def is_asked() -> bool:
        adjust._ask()
        return bool(adjust._clients) and bool(pending())

    def pending() -> Any:
        return adjust._clients["/publisher"]._pending_requests

    until(is_asked, asking)  # nobody spins the publisher, so its services are there but silent
    for _ in range(200):
        adjust._ask()
    assert len(pending()) < 10
    assert adjust.answer is None
    # Late, but an answer.
    until(lambda: adjust.answer is not None, asking, publisher)
    assert adjust.answer is False
