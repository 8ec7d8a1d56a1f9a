"""SLAM node: pairs odometry with clouds, passes them to a worker, publishes TF."""

from __future__ import annotations

import sys
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from rclpy._rclpy_pybind11 import InvalidHandle, RCLError
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from l2lidar_node import records
from l2lidar_node.ros.conversions import (
    diagnostic_array,
    diagnostic_status,
    from_cloud,
    from_time,
    to_cloud,
    to_time,
)
from l2lidar_node.ros.managed_node import ManagedNode
from l2lidar_node.ros.parameters import ParameterSet
from l2lidar_node.ros.program import StartError, run
from l2lidar_node.types import F64, Check, HostNs, Level, is_ros_time
from l2lidar_proc.cloud import positions
from l2lidar_proc.ros import odometry_messages as messages
from l2lidar_proc.ros.inputs import InputMonitor, steady_timer
from l2lidar_proc.ros.map_transform import FARTHEST_NS, MapTransform
from l2lidar_proc.ros.slam_worker import Answer, SlamWorker, values_of
from l2lidar_proc.slam.atlas import AtlasError
from l2lidar_proc.slam.config import SlamNodeConfig
from l2lidar_proc.slam.nodes import Health, Keyframe, Map, OdometrySweep, SlamState, health_of
from l2lidar_proc.slam.pose_graph import GtsamMissingError

_FARTHEST_M: Final = 1e6  # from the origin; no robot goes so far
_LATER_NS: Final = 2 * FARTHEST_NS  # than a pose that the transform is stamped, at most
_PENDING: Final = 40  # stamps that wait for their other messages
_SHOWN_POINTS: Final = 400_000  # of the map at most, in one message
_LEVELS: Final = {
    SlamState.LOCALIZED: Level.OK,
    SlamState.TENTATIVE: Level.WARN,
    SlamState.SEARCHING: Level.WARN,
    SlamState.DEAD_RECKONING: Level.ERROR,
    SlamState.LOST: Level.ERROR,
}


@dataclass(frozen=True, slots=True, eq=False)
class _Latest:
    """The newest odometry: stamp, arrival on the monotonic clock [ns], frame, pose (4, 4)."""

    stamp: HostNs
    arrival_ns: int
    frame: str
    pose: F64


@dataclass(slots=True)
class _Parts:
    """Messages of one stamp."""

    odometry: Odometry | None = None
    cloud: PointCloud2 | None = None
    status: DiagnosticStatus | None = None


def _until_shutdown(publish: Callable[..., None]) -> Callable[..., None]:
    """Return a method for the worker's thread, silent once a signal has shut the context down."""

    @wraps(publish)
    def run(node: SlamNode, *arguments: Any) -> None:
        try:
            publish(node, *arguments)
        except (RCLError, InvalidHandle):
            if node.context.ok():
                raise

    return run


class SlamNode(ManagedNode):
    """Publishes the pose of the odometry frame in the map.

    Raises
    ------
    SettingError
        If a parameter is wrong.
    StartError
        If gtsam or the map is missing.
    """

    def __init__(self) -> None:
        super().__init__("slam_node")
        self._worker: SlamWorker | None = None
        self._settings = ParameterSet(self, SlamNodeConfig, self._configure)
        self.start(self._settings.value.lifecycle.autostart)

    @property
    def worker(self) -> SlamWorker:
        """The worker; only while the node is configured."""
        assert self._worker is not None
        return self._worker

    def set_up(self) -> None:
        """Start the worker, load the map where one is to be used, open publishers and services."""
        config = self._settings.value
        try:
            self._worker = SlamWorker(config, self.get_logger().warning, self._show_keyframe)
        except (GtsamMissingError, AtlasError) as error:
            raise StartError(str(error)) from None
        self._parts: OrderedDict[HostNs, _Parts] = OrderedDict()
        self._latest: _Latest | None = None
        self._refused = self._failures = 0
        self._shown = (-1, -1)
        self._open(config)

    def begin(self) -> None:
        """Listen."""
        topics = self._settings.value.topics
        inputs = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._inputs = InputMonitor(self, (topics.odometry_topic, topics.cloud_topic))
        guarded = self._guarded

        def hear(kind: Any, topic: str, callback: Callable[..., None], qos: Any = inputs) -> None:
            self.create_subscription(kind, topic, guarded(callback), qos)

        hear(Odometry, topics.odometry_topic, self._odometry)
        hear(PointCloud2, topics.cloud_topic, self._cloud)
        hear(DiagnosticArray, topics.odometry_status_topic, self._status)
        hear(PoseWithCovarianceStamped, topics.initial_pose_topic, self._initial_pose, 1)
        hear(TFMessage, "/tf", self._transforms)
        self.create_timer(1.0 / topics.tf_rate, guarded(self._publish_transform))
        steady_timer(self, 1.0, guarded(self._diagnose))
        if topics.map_period_s > 0.0:
            self.create_timer(topics.map_period_s, guarded(self._show))
        if topics.autosave_s > 0.0:
            self.create_timer(topics.autosave_s, guarded(self._autosave))

    def pause(self) -> None:
        """Forget messages whose counterparts have not come."""
        self._parts.clear()

    def tear_down(self) -> None:
        """End the worker, which saves what is unsaved."""
        if self._worker is not None:
            self._worker.close()
            self._worker = None

    def _guarded(self, callback: Callable[..., None]) -> Callable[..., None]:
        return self._inputs.guarded(callback, self.pause)

    def _open(self, config: SlamNodeConfig) -> None:
        topics = config.topics
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._transform = MapTransform(self)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, topics.pose_topic, 10)
        self._map = self.create_publisher(PointCloud2, topics.map_topic, latched)
        self._path = self.create_publisher(Path, topics.path_topic, latched)
        self._graph = self.create_publisher(MarkerArray, topics.graph_topic, latched)
        reliable = QoSProfile(depth=50)
        self._keyframe = self.create_publisher(Odometry, topics.keyframe_topic, reliable)
        self._keyframe_points = self.create_publisher(
            PointCloud2, topics.keyframe_points_topic, reliable
        )
        self._state = self.create_publisher(DiagnosticStatus, topics.status_topic, latched)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        worker = self.worker
        # A callback that waits holds its group. In the node's own, neither messages nor timers
        # would come through, and nothing would wake the executor when the answer is there.
        waiting = ReentrantCallbackGroup()
        for kind, name, answer in (
            (Trigger, "save", self._answered(lambda _: worker.save(), at_once=True)),
            (Trigger, "load", self._answered(lambda _: worker.load())),
            (Trigger, "reset", self._answered(lambda _: worker.reset())),
            (Trigger, "relocalize", self._answered(lambda _: worker.relocalize())),
            (SetBool, "set_localization", self._answered(worker.set_localization)),
        ):
            self.create_service(kind, f"~/{name}", answer, callback_group=waiting)

    def _configure(self, config: SlamNodeConfig) -> None:
        if self._worker is not None:
            self._worker.map_name = config.topics.map_name

    # ---- input

    def _odometry(self, message: Odometry) -> None:
        stamp = from_time(message.header.stamp)
        pose = messages.matrix(message.pose.pose)
        problem = _problem(stamp, pose, message)
        if problem:
            self._drop(problem)
            return
        self._latest = _Latest(stamp, time.monotonic_ns(), message.header.frame_id, pose)
        self._part(stamp).odometry = message
        self._publish_transform()  # at once: who gets the same odometry can transform it
        self._publish_pose(message)
        self._pair(stamp)

    def _cloud(self, message: PointCloud2) -> None:
        stamp = from_time(message.header.stamp)
        self._part(stamp).cloud = message
        self._pair(stamp)

    def _status(self, message: DiagnosticArray) -> None:
        if message.status:
            stamp = from_time(message.header.stamp)
            self._part(stamp).status = message.status[0]
            self._pair(stamp)

    def _part(self, stamp: HostNs) -> _Parts:
        parts = self._parts.setdefault(stamp, _Parts())
        while len(self._parts) > _PENDING:
            self._parts.popitem(last=False)
        return parts

    def _pair(self, stamp: HostNs) -> None:
        """Hand a sweep on as soon as all that belongs to it is there."""
        parts = self._parts[stamp]
        if parts.odometry is None or parts.cloud is None:
            return
        # To count does not remap the name, as to subscribe does.
        topic = self.resolve_topic_name(self._settings.value.topics.odometry_status_topic)
        if parts.status is None and self.count_publishers(topic):
            return
        del self._parts[stamp]
        try:
            self.worker.sweep(_sweep(stamp, parts.odometry, parts.cloud, parts.status))
        except ValueError as error:
            self._drop(str(error))

    def _drop(self, reason: str) -> None:
        self._refused += 1
        self.get_logger().warning(f"sweep dropped: {reason}", throttle_duration_sec=5.0)

    def _initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        frame = self._settings.value.topics.map_frame
        if message.header.frame_id not in ("", frame):
            self.get_logger().warning(
                f"initial pose in '{message.header.frame_id}' ignored, expected '{frame}'"
            )
            return
        matrix = messages.matrix(message.pose.pose)
        problem = _pose_problem(matrix)
        if problem:
            self.get_logger().warning(f"initial pose ignored: {problem}")
            return
        x, y = matrix[:2, 3].tolist()
        yaw = float(np.arctan2(matrix[1, 0], matrix[0, 0]))
        worker = self.worker
        worker.request(lambda: worker.set_pose(x, y, yaw), self._say)

    def _transforms(self, message: TFMessage) -> None:
        if self._latest is not None:
            self._transform.watch(message, self._settings.value.topics, self._latest.frame)

    # ---- output

    def _publish_transform(self) -> None:
        latest = self._latest
        if latest is not None:
            self._transform.publish(
                self.worker.T_map_odom,
                latest.pose,
                latest.stamp,
                latest.arrival_ns,
                latest.frame,
                self._settings.value.topics,
            )

    def _publish_pose(self, odometry: Odometry) -> None:
        T_map_odom = self.worker.T_map_odom
        if T_map_odom is None:
            return
        message = PoseWithCovarianceStamped()
        message.header.stamp = odometry.header.stamp
        message.header.frame_id = self._settings.value.topics.map_frame
        matrix = T_map_odom @ messages.matrix(odometry.pose.pose)
        if not np.isfinite(matrix).all():
            return
        message.pose.pose = messages.pose(matrix)
        order = [3, 4, 5, 0, 1, 2]
        message.pose.covariance = self.worker.covariance[np.ix_(order, order)].ravel()
        self._pose.publish(message)

    def _show(self) -> None:
        """Publish map, path and graph if they changed and have subscribers."""
        listeners = [self._map, self._path, self._graph]
        wanted = tuple(publisher.get_subscription_count() for publisher in listeners)
        worker = self.worker
        now = (worker.submaps, hash((worker.loops, wanted)))
        if self._latest is None or not any(wanted) or now == self._shown:
            return
        self._shown = now
        stamp = self._latest.stamp
        worker.show(lambda built, loops: self._show_map(built, loops, stamp))

    @_until_shutdown
    def _show_map(self, built: Map, loops: list[tuple[int, int]], stamp: HostNs) -> None:
        """Publish map, path and graph; called in the worker's thread."""
        frame = self._settings.value.topics.map_frame
        if self._map.get_subscription_count():
            points = records.decimated(built.points(), _SHOWN_POINTS)
            self._map.publish(to_cloud(messages.as_cloud(points), stamp, frame))
        if self._path.get_subscription_count():
            places = built.trajectory()
            some = places[:: max(len(places) // 5000, 1)]
            path = Path(
                poses=[
                    messages.pose_stamped(pose, HostNs(int(at)), frame)
                    for at, pose in zip(some["stamp"], some["pose"], strict=True)
                ]
            )
            path.header.stamp, path.header.frame_id = to_time(stamp), frame
            self._path.publish(path)
        if self._graph.get_subscription_count():
            self._graph.publish(_markers(built, loops, frame))

    @_until_shutdown
    def _show_keyframe(self, keyframe: Keyframe) -> None:
        """Publish a submap for other back ends; called in the worker's thread."""
        latest = self._latest
        frame = f"keyframe_{keyframe.number}"
        if latest is not None:
            self._keyframe.publish(messages.keyframe(keyframe, latest.frame, frame))
        if self._keyframe_points.get_subscription_count() and keyframe.submap is not None:
            points = messages.as_cloud(keyframe.submap.xyz)
            self._keyframe_points.publish(to_cloud(points, keyframe.stamp, frame))

    def _autosave(self) -> None:
        self.worker.request(self.worker.autosave, lambda answer: None, at_once=True)

    def _answered(self, job: Callable[[bool], Answer], *, at_once: bool = False) -> Any:
        """Return a callback of a service that answers when the worker has done a job.

        Parameters
        ----------
        job : callable
            Given what a SetBool asks for; True from a Trigger.
        at_once : bool
            See :meth:`SlamWorker.request`.
        """

        async def answer(request: Any, response: Any) -> Any:
            wanted, executor = bool(getattr(request, "data", True)), self.executor
            future: Future = Future(executor=executor)

            def done(result: Answer) -> None:
                future.set_result(result)
                executor.wake()  # it may sleep: nothing else tells it of the worker's answer

            self.worker.request(lambda: job(wanted), done, at_once=at_once)
            response.success, response.message = await future
            return response

        return answer

    def _say(self, answer: Answer) -> None:
        worked, text = answer
        if worked:
            self.get_logger().info(f"initial pose {text}")
        else:
            self.get_logger().warning(text)

    def _diagnose(self) -> None:
        state = self.worker.state
        text, level = state.value, _LEVELS[state]
        parent = self._transform.other_parent
        if parent:
            level = Level.ERROR
            text = (
                f"'{parent}' is already the parent of the odometry frame; set "
                "invert_tf of the odometry or publish_tf of slam_node to false"
            )
        if self.worker.failures > self._failures:
            self._failures = self.worker.failures
            level, text = Level.ERROR, f"{text}; internal error in the worker, see log"
        values = {**values_of(self.worker), "sweeps refused": self._refused}
        told = {name: str(value) for name, value in values.items()}
        judged = self._inputs.judge(Check("slam", level, text, told))
        name = self.get_fully_qualified_name().lstrip("/")
        now = HostNs(self.get_clock().now().nanoseconds)
        self._diagnostics.publish(diagnostic_array([judged], name, now))
        self._state.publish(diagnostic_status(replace(judged, message=state.name)))


def _problem(stamp: HostNs, pose: F64, odometry: Odometry) -> str:
    """Return why the odometry's pose (4, 4) cannot be used, empty if it can."""
    # the transform is stamped a little later
    if not (is_ros_time(stamp) and is_ros_time(stamp + _LATER_NS)):
        return f"its stamp, {stamp / 1e9:.0f} s, is out of range"
    if problem := _pose_problem(pose):
        return problem
    if not np.isfinite(odometry.pose.covariance).all():
        return "the covariance of the pose is not finite"
    return ""


def _pose_problem(pose: F64) -> str:
    """Return why a pose (4, 4) cannot be used, empty if it can."""
    if not np.isfinite(pose).all():
        return "the pose is not finite"
    if np.abs(pose[:3, 3]).max() > _FARTHEST_M:
        return f"the pose is more than {_FARTHEST_M / 1e3:.0f} km from the origin"
    return ""


def _sweep(
    stamp: HostNs, odometry: Odometry, cloud: PointCloud2, status: DiagnosticStatus | None
) -> OdometrySweep:
    """Return messages of one stamp as a sweep.

    Raises
    ------
    ValueError
        If the cloud cannot be used.
    """
    if cloud.header.frame_id != odometry.child_frame_id:
        raise ValueError(
            f"the cloud is in '{cloud.header.frame_id}', the pose is that of "
            f"'{odometry.child_frame_id}'; they must be the same"
        )
    points = from_cloud(cloud)
    if not {"x", "y", "z"} <= set(points.dtype.names or ()):
        raise ValueError("the cloud has no x, y, z")
    xyz = positions(points.reshape(-1))
    pose = messages.matrix(odometry.pose.pose)
    remarks = status.message.split(",") if status is not None else []
    covariance = np.array(odometry.pose.covariance, np.float64).reshape(6, 6)
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    health = health_of(remarks)
    if (np.diagonal(covariance) >= messages.UNKNOWN_VARIANCE).all():
        health = Health.CUT  # how odometries without a status say that they are lost
    return OdometrySweep(stamp, pose, xyz, health, covariance)


def _markers(built: Map, loops: list[tuple[int, int]], frame: str) -> MarkerArray:
    """Return submaps, the way between them, and loops."""
    places = built.poses[:, :3, 3].tolist()
    pairs = [(n, n + 1) for n in range(len(places) - 1)]
    return MarkerArray(
        markers=[
            _marker(0, Marker.SPHERE_LIST, 0.3, (0.2, 0.5, 1.0), places, frame),
            _marker(1, Marker.LINE_LIST, 0.05, (0.2, 0.5, 1.0), _ends(places, pairs), frame),
            _marker(2, Marker.LINE_LIST, 0.1, (1.0, 0.2, 0.2), _ends(places, loops), frame),
        ]
    )


def _ends(places: list[list[float]], pairs: list[tuple[int, int]]) -> list[list[float]]:
    return [places[number] for pair in pairs for number in pair]


def _marker(
    number: int,
    kind: int,
    size: float,
    color: tuple[float, float, float],
    places: list[list[float]],
    frame: str,
) -> Marker:
    marker = Marker(ns="slam", id=number, type=kind, action=Marker.ADD)
    marker.header.frame_id = frame
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = marker.scale.z = size
    marker.color.r, marker.color.g, marker.color.b = color
    marker.color.a = 1.0
    marker.points = [Point(x=x, y=y, z=z) for x, y, z in places]
    return marker


def main(args: list[str] | None = None) -> int:
    """Run the SLAM node; see :func:`l2lidar_node.ros.program.run`."""
    return run("slam_node", SlamNode, args)


if __name__ == "__main__":
    sys.exit(main())
