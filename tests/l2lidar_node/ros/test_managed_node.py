"""What the life cycle of a node leaves behind."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

rclpy = pytest.importorskip("rclpy")

from rclpy.executors import SingleThreadedExecutor  # noqa: E402  after importorskip
from rclpy.lifecycle import TransitionCallbackReturn as Return  # noqa: E402

from l2lidar_node.ros.managed_node import ManagedNode  # noqa: E402
from l2lidar_node.ros.program import StartError  # noqa: E402

pytestmark = pytest.mark.ros


class Resource:
    """What a node opens; nobody but its frames holds it."""


class Failing(ManagedNode):
    """A node that opens something and then finds no device."""

    def __init__(self) -> None:
        super().__init__("failing")
        self.opened: list[weakref.ref[Resource]] = []

    def set_up(self) -> None:
        resource = Resource()
        self.opened.append(weakref.ref(resource))
        try:
            raise OSError("no such device")
        except OSError as error:
            raise StartError(f"cannot open it: {error}") from None


@pytest.fixture
def node() -> Iterator[Failing]:
    rclpy.init()
    made = Failing()
    yield made
    made.destroy_node()
    rclpy.shutdown()


def test_a_failed_configuration_releases_what_it_had_opened(node: Failing) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    gc.disable()  # it would release what only a cycle holds
    try:
        assert node.trigger_configure() is Return.FAILURE
        assert [opened() for opened in node.opened] == [None]
    finally:
        gc.enable()
        executor.shutdown()


def test_a_start_that_fails_says_where(node: Failing) -> None:
    with pytest.raises(StartError, match="no such device") as problem:
        node.start(autostart=True)
    assert "set_up" in [entry.name for entry in problem.traceback]
