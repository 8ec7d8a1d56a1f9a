"""Asks whoever publishes the clouds whether it levels them, which would make deskewing wrong."""

from __future__ import annotations

from typing import Final

from rcl_interfaces.srv import GetParameters
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.task import Future

_MAX_CLIENTS: Final = 8
_PARAMETER: Final = "imu_adjust"  # of the driver, and of upstream's


class LevellingWatch:
    """Asks every few seconds; says loudly when the answer is yes.

    Parameters
    ----------
    node : Node
    topic : str
        Of the clouds.
    period_s : float

    Attributes
    ----------
    is_levelled : bool
        Whether a publisher of the clouds turns them into a levelled frame.
    """

    def __init__(self, node: Node, topic: str, period_s: float = 5.0) -> None:
        self.is_levelled = False
        self._node = node
        self._topic = topic
        self._clients: dict[str, Client] = {}
        self._answers: dict[str, bool] = {}
        node.create_timer(period_s, self._ask, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _ask(self) -> None:
        publishers = set()
        for info in self._node.get_publishers_info_by_topic(
            self._node.resolve_topic_name(self._topic)
        ):
            name = f"{info.node_namespace.rstrip('/')}/{info.node_name}"
            publishers.add(name)
            if name not in self._clients and not self._open(name):
                continue
            client = self._clients[name]
            if client.service_is_ready():
                future = client.call_async(GetParameters.Request(names=[_PARAMETER]))
                future.add_done_callback(lambda done, name=name: self._answered(name, done))
        for name in set(self._clients) - publishers:
            self._node.destroy_client(self._clients.pop(name))
            self._answers.pop(name, None)
        self._judge()

    def _open(self, name: str) -> bool:
        """Make a client for a publisher; return whether there is one."""
        if len(self._clients) >= _MAX_CLIENTS:
            return False
        try:
            self._clients[name] = self._node.create_client(GetParameters, f"{name}/get_parameters")
        except NameValidationException:  # a program that is not ROS may be called anything
            return False
        return True

    def _answered(self, name: str, future: Future) -> None:
        response = future.result()
        # a parameter that a node does not have comes back as not set, which is false
        self._answers[name] = bool(response and response.values and response.values[0].bool_value)
        self._judge()

    def _judge(self) -> None:
        levelling = [name for name, levelled in self._answers.items() if levelled]
        self.is_levelled = bool(levelling)
        if levelling:
            self._node.get_logger().error(
                f"{', '.join(levelling)} has imu_adjust on: its clouds are turned into a levelled "
                "frame, packet by packet, and deskewing them again makes them wrong; set "
                "imu_adjust to false there",
                throttle_duration_sec=30.0,
            )
