"""Mount of a cloud's frame: static transforms, and the driver's imu_adjust."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final

from rcl_interfaces.srv import GetParameters
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from tf2_msgs.msg import TFMessage

from l2lidar_node.frames import FrameTree
from l2lidar_node.types import F64


class StaticFrames:
    """The static transforms that have been published.

    Parameters
    ----------
    node : Node
        Whose subscription it is.

    Attributes
    ----------
    version : int
        Counts messages: what was looked up before the newest one may have changed.
    refused : str
        The last transform that could not be used, and why; empty if all could.
    """

    def __init__(self, node: Node) -> None:
        self.version = 0
        self.refused = ""
        self._node = node
        self._tree = FrameTree()
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(TFMessage, "/tf_static", self._take, latched)

    def find(self, target: str, source: str) -> F64 | None:
        """Return source coordinates to target coordinates, (4, 4), None if not known."""
        return self._tree.find(target, source)

    def root(self, frame: str) -> tuple[str, F64]:
        """Return the topmost frame above a frame, and the transform to it, (4, 4)."""
        return self._tree.root(frame)

    def obstacle(self, parent: str, child: str) -> str:
        """Return in words why no transform may put a child below a parent; empty if it may.

        A frame with two parents breaks the tree: tf2 drops one of the two transforms.
        """
        reason = self._tree.obstacle(parent, child)
        return f"{reason} on /tf_static" if reason else ""

    def _take(self, message: TFMessage) -> None:
        problems = self._tree.take(message)
        if problems:
            self.refused = f"/tf_static: {problems[-1]}"
            self._node.get_logger().warning(self.refused, throttle_duration_sec=5.0)
        if len(problems) < len(message.transforms):
            self.version += 1


def untied(frames: StaticFrames | None, target: str, source: str) -> str:
    """Return in words why a transform is not known, without frames as well; empty if it is."""
    if target == source:
        return ""
    if frames is None:
        return f"use_tf is false, so the mount of '{source}' is unknown"
    if frames.find(target, source) is not None:
        return ""
    return (
        f"'{source}' is not tied to '{target}' on /tf_static (transforms on /tf are ignored, "
        "since they may move); publish the mount with a fixed joint or static_transform_publisher"
    )


_MAX_CLIENTS: Final = 8
_MOST_PENDING: Final = 6  # questions to one publisher: a busy one may answer some rounds later
_PARAMETER: Final = "imu_adjust"  # of this driver, and of upstream's


class ImuAdjustClient:
    """Queries imu_adjust of every publisher of a topic, repeatedly.

    Parameters
    ----------
    node : Node
    topic : str
        Topic of the clouds.
    period_s : float
        Time between two rounds of questions [s].
    on_leveling : callable, optional
        Called with the names of the publishers that level their clouds, after each answer while
        there are any.

    Attributes
    ----------
    answer : bool or None
        Whether a publisher levels its clouds; None until one has answered.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        period_s: float = 5.0,
        on_leveling: Callable[[list[str]], None] | None = None,
    ) -> None:
        self.answer: bool | None = None
        self._node = node
        self._topic = topic
        self._on_leveling = on_leveling
        self._clients: dict[str, Client] = {}
        self._asked: dict[str, deque[Future]] = {}  # the last questions
        self._answers: dict[str, bool] = {}
        node.create_timer(period_s, self._ask, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _ask(self) -> None:
        publishers = set()
        topic = self._node.resolve_topic_name(self._topic)
        for info in self._node.get_publishers_info_by_topic(topic):
            name = f"{info.node_namespace.rstrip('/')}/{info.node_name}"
            publishers.add(name)
            if name not in self._clients and not self._open(name):
                continue
            client = self._clients[name]
            if client.service_is_ready():
                asked = self._asked[name]
                if len(asked) == _MOST_PENDING:
                    # rclpy keeps a request until it is answered, which may be never.
                    client.remove_pending_request(asked.popleft())
                future = client.call_async(GetParameters.Request(names=[_PARAMETER]))
                future.add_done_callback(lambda done, name=name: self._answered(name, done))
                asked.append(future)
        for name in set(self._clients) - publishers:
            self._node.destroy_client(self._clients.pop(name))
            del self._asked[name]
            self._answers.pop(name, None)
        self._judge()

    def _open(self, name: str) -> bool:
        """Create a client for a publisher; return whether there is one."""
        if len(self._clients) >= _MAX_CLIENTS:
            return False
        try:
            self._clients[name] = self._node.create_client(GetParameters, f"{name}/get_parameters")
        except NameValidationException:  # a program that is not ROS may have any name
            return False
        self._asked[name] = deque()
        return True

    def _answered(self, name: str, future: Future) -> None:
        response = future.result()
        # A parameter that the node does not have comes back as not set, which reads as false.
        self._answers[name] = bool(response and response.values and response.values[0].bool_value)
        self._judge()

    def _judge(self) -> None:
        leveling = [name for name, is_leveling in self._answers.items() if is_leveling]
        self.answer = bool(leveling) if self._answers else None
        if leveling and self._on_leveling is not None:
            self._on_leveling(leveling)
