"""Messages taken ahead of the executor."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Int32

from l2lidar_proc.ros.subscriptions import waiting

pytestmark = pytest.mark.ros
LIMIT_S = 120.0


@pytest.fixture
def node() -> Iterator[Node]:
    context = rclpy.Context()
    rclpy.init(context=context)
    node = Node("waiting", context=context)
    yield node
    node.destroy_node()
    context.shutdown()


def test_what_waits_is_taken_in_order_and_the_executor_goes_on(node: Node) -> None:
    heard: list[int] = []
    subscription = node.create_subscription(
        Int32, "numbers", lambda message: heard.append(message.data), 100
    )
    publisher = node.create_publisher(Int32, "numbers", 100)
    deadline = time.monotonic() + LIMIT_S
    while not publisher.get_subscription_count():
        assert time.monotonic() < deadline
    for number in range(20):
        publisher.publish(Int32(data=number))
    taken: list[int] = []
    while len(taken) < 8:
        taken += [message.data for message in waiting(subscription, 8 - len(taken))]
        assert time.monotonic() < deadline
    assert taken == list(range(8))  # no more than was asked for
    assert heard == []
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    while len(heard) < 12:
        executor.spin_once(0.1)
        assert time.monotonic() < deadline
    assert heard == list(range(8, 20))
    assert list(waiting(subscription, 5)) == []
    executor.shutdown()


def test_a_node_starts_before_what_only_its_first_sweep_needs() -> None:
    """What takes most of the start is imported in a thread meanwhile."""
    heavy = ("scipy.stats", "scipy.sparse", "kiss_icp.config", "open3d", "matplotlib", "gtsam")
    code = (
        "import sys\n"
        "import l2lidar_node.ros.driver_node, l2lidar_proc.ros.companion_node\n"
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert found.stdout.strip() == "[]"
