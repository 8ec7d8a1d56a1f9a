"""Live topics for the command line, for the check or the viewer."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Imu, PointCloud2
from tf2_msgs.msg import TFMessage

from l2lidar_node.check.observation import Gathering, Observation, Qos, SourceError, Topics, choose
from l2lidar_node.programs import held
from l2lidar_node.ros.mounting import ImuAdjustClient
from l2lidar_node.viewing import ROLES, Viewer

_DISCOVERY_S: Final = 6.0
_SILENCE_S: Final = 10.0  # then the viewer gives up
_LOOK_S: Final = 0.1
_ASK_AGAIN_S: Final = 1.0
_STDOUT: Final = 1
_STDERR: Final = 2
_IDLE: Final = 50  # turns of the executor without a message of before


def observe(asked: Topics, needs_imu: bool, seconds: float) -> tuple[Observation, Topics]:
    """Observe for some seconds and return the observation.

    Parameters
    ----------
    asked : Topics
    needs_imu : bool
        Whether the consumer reads an IMU topic.
    seconds : float
        How long to listen once the topics are found.

    Raises
    ------
    SourceError
        If there are no such topics, or which to use is not plain.
    """
    with _standard_output_for_results():
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        node = Node("l2lidar_check")
        try:
            return _observe(node, asked, needs_imu, seconds)
        finally:
            node.destroy_node()
            rclpy.try_shutdown()


@contextmanager
def _standard_output_for_results() -> Iterator[None]:
    """Have Fast DDS complain on the standard error output: it would spoil the JSON."""
    sys.stdout.flush()
    kept = os.dup(_STDOUT)
    os.dup2(_STDERR, _STDOUT)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, _STDOUT)
        os.close(kept)


def _observe(
    node: Node, asked: Topics, needs_imu: bool, seconds: float
) -> tuple[Observation, Topics]:
    asked = Topics(*(node.resolve_topic_name(topic) if topic else "" for topic in asked))
    topics = _found(node, asked, needs_imu)
    gathering = Gathering()
    ear = _Ear(node, topics, gathering)
    imu_adjust = ImuAdjustClient(node, topics.cloud, _ASK_AGAIN_S)
    ear.listen(seconds)
    ear.wait_for(lambda: imu_adjust.answer is not None)  # a busy publisher answers late
    return (
        gathering.observation(
            cloud_qos=_offers(node, topics.cloud),
            imu_qos=_offers(node, topics.imu),
            is_leveled=imu_adjust.answer,
        ),
        topics,
    )


def _found(node: Node, asked: Topics, needs_imu: bool) -> Topics:
    """Return the topics once they are there; other nodes take a while to be seen."""
    deadline = time.monotonic() + _DISCOVERY_S
    while True:
        kinds = {
            topic: types[0]
            for topic, types in node.get_topic_names_and_types()
            if node.count_publishers(topic)
        }
        is_late = time.monotonic() > deadline
        try:
            topics = choose(kinds, asked, needs_imu)
        except SourceError:
            if is_late:
                raise
        else:
            if topics.imu or not needs_imu or is_late:
                return topics
        with held():
            rclpy.spin_once(node, timeout_sec=_LOOK_S)


class _Ear:
    """Subscribes to topics and notes the arrival time of each message."""

    def __init__(self, node: Node, topics: Topics, gathering: Gathering) -> None:
        # Best effort takes from every publisher, and deep queues lose nothing of what comes.
        deep = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        listen = node.create_subscription
        listen(PointCloud2, topics.cloud, self._timed(gathering.cloud), deep)
        if topics.imu:
            listen(Imu, topics.imu, self._timed(gathering.imu), deep)
        listen(TFMessage, "/tf", gathering.transforms, deep)
        listen(TFMessage, "/tf_static", gathering.transforms, latched)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._end_ns = sys.maxsize
        self._handled = 0

    def listen(self, seconds: float) -> None:
        """Receive messages for some seconds."""
        _spin(self._executor, seconds)
        # What came by now still waits where this program is slow, more samples than clouds.
        self._end_ns = time.time_ns()
        idle = 0
        while idle < _IDLE:
            before = self._handled
            with held():
                self._executor.spin_once(timeout_sec=0.0)
            idle = 0 if self._handled > before else idle + 1

    def wait_for(self, condition: Callable[[], bool]) -> None:
        """Go on until a condition holds, or for some seconds; clouds and samples are left out."""
        _spin(self._executor, _DISCOVERY_S, condition)

    def _timed(self, take: Callable[[Any, int], None]) -> Callable[[Any, Any], None]:
        def hear(message: Any, info: Any) -> None:
            arrival = int(info["received_timestamp"]) or time.time_ns()
            if arrival <= self._end_ns:
                self._handled += 1
                take(message, arrival)

        return hear


def _offers(node: Node, topic: str) -> tuple[Qos, ...]:
    if not topic:
        return ()
    names = {
        ReliabilityPolicy.RELIABLE: "reliable",
        ReliabilityPolicy.BEST_EFFORT: "best_effort",
    }
    return tuple(
        Qos(names.get(info.qos_profile.reliability, "unknown"), info.qos_profile.depth)
        for info in node.get_publishers_info_by_topic(topic)
    )


class ViewerNode(Node):
    """Passes every message to the viewer.

    Parameters
    ----------
    viewer : Viewer
    topics : dict
        Topic names by role: those of :data:`l2lidar_node.viewing.ROLES`, ``imu``, ``odometry``.
    """

    def __init__(self, viewer: Viewer, topics: dict[str, str]) -> None:
        super().__init__("l2lidar_viewer")
        sensor_data = qos_profile_sensor_data
        for role in ROLES:
            self.create_subscription(
                PointCloud2,
                topics[role],
                lambda message, role=role: viewer.cloud(message, role),
                sensor_data,
            )
        self.create_subscription(Imu, topics["imu"], viewer.imu, sensor_data)
        self.create_subscription(Odometry, topics["odometry"], viewer.odometry, sensor_data)
        self.create_subscription(DiagnosticArray, "/diagnostics", viewer.diagnostics, 10)


def view(rerun: Any, topics: dict[str, str], seconds: float | None) -> int:
    """Show topics until interrupted, or for some seconds; return how many messages were shown.

    rclpy has to be initialized, without handlers of signals.

    Parameters
    ----------
    rerun : module
        The rerun SDK, see :func:`l2lidar_node.viewing.open_viewer`.
    topics : dict
        See :class:`ViewerNode`.
    seconds : float or None
        How long to show from the first message on. If none comes, it gives up.
    """
    viewer = Viewer(rerun)
    node = ViewerNode(viewer, topics)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        if seconds is not None:
            _spin(executor, _SILENCE_S, lambda: viewer.messages > 0)
        if seconds is None or viewer.messages:
            _spin(executor, seconds)
    finally:
        node.destroy_node()
    return viewer.messages


def _spin(
    executor: SingleThreadedExecutor,
    seconds: float | None,
    is_over: Callable[[], bool] = lambda: False,
) -> None:
    """Take messages for some seconds (None: until interrupted), which pauses do not shorten."""
    left = math.inf if seconds is None else seconds
    while executor.context.ok() and left > 0 and not is_over():
        begun = time.monotonic()
        with held():
            executor.spin_once(timeout_sec=min(left, _LOOK_S))
        left -= min(time.monotonic() - begun, 2 * _LOOK_S)
