"""Odometry node: converts messages, calls the pipeline, publishes."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry as OdometryMessage, Path
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from l2lidar_node import rotations
from l2lidar_node.files import DataFolder, FileNameError, write_whole
from l2lidar_node.ros.conversions import diagnostic_array, to_cloud
from l2lidar_node.ros.managed_node import ManagedNode
from l2lidar_node.ros.mounting import StaticFrames, untied
from l2lidar_node.ros.parameters import ParameterSet
from l2lidar_node.ros.program import run
from l2lidar_node.settings import SettingError
from l2lidar_node.types import F64, HostNs, Level, Sweep
from l2lidar_proc.cloud import CloudError
from l2lidar_proc.deskew.config import DeskewTopics
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.motion.imu_corrections import ImuConvention, ImuExtrinsics
from l2lidar_proc.motion.tracker import KnownMotion
from l2lidar_proc.odometry.config import OdometryNodeConfig, OdometryTopics
from l2lidar_proc.odometry.estimate import CUTS, BaseFrame, OdometryEstimate
from l2lidar_proc.odometry.odometry import LIBRARIES
from l2lidar_proc.odometry.pipeline import OdometryPipeline, judge
from l2lidar_proc.recording import outputs
from l2lidar_proc.ros import odometry_messages as messages
from l2lidar_proc.ros.inputs import (
    InputMonitor,
    answer_or_error,
    in_range,
    load_libraries,
    steady_timer,
)
from l2lidar_proc.ros.pose_broadcaster import PoseBroadcaster
from l2lidar_proc.ros.subscriptions import SLOW_LOOK_S, ReceivedCloud, SensorSubscriptions

_PATH_STEP = (0.05, np.radians(5.0))  # [m, rad] between poses of the path


class OdometryNode(ManagedNode):
    """Publishes the pose of the sensor or of its carrier.

    Raises
    ------
    SettingError
        If a parameter is wrong.
    """

    def __init__(self) -> None:
        super().__init__("odometry_node")
        self._pipeline: OdometryPipeline | None = None
        self._map_timer: Timer | None = None
        self._map_period_s = 0.0
        self._settings = ParameterSet(self, OdometryNodeConfig, self._configure)
        topics = self._settings.value.topics
        period_s = 1.0 / topics.imu_rate if topics.imu_rate > 0.0 else SLOW_LOOK_S
        self.sensors = SensorSubscriptions(
            self, topics.cloud_topic, topics.imu_topic, "best_effort", period_s
        )
        self.start(self._settings.value.lifecycle.autostart)

    def set_up(self) -> None:
        """Open publishers and services, and begin without a map."""
        config = self._settings.value
        topics = config.topics
        self._pipeline = OdometryPipeline(
            config.odometry,
            topics.T_cloud_imu,
            topics.imu_wait_ms,
            ImuExtrinsics.of(topics),
            max_skipped=topics.max_skipped,
        )
        if self._pipeline.extrinsics.problem:
            self.get_logger().warning(self._pipeline.extrinsics.problem)
        self._folder = DataFolder(config.files.data_dir, config.files.overwrite)
        self._static = StaticFrames(self)  # also without use_tf: a second parent breaks the tree
        self._withheld = ""  # why the transform is, as last logged
        self._frames = self._static if topics.use_tf else None
        self._base = BaseFrame(np.eye(4))
        self._cloud_frame = ""
        self._mounted: tuple[int, str, str] | None = None
        self._inputs = InputMonitor(self, (topics.cloud_topic, topics.imu_topic))
        self._said: set[str] = set()
        self._looked_at = 0
        self._path: deque[PoseStamped] = deque(maxlen=topics.path_length)
        self._path_end = np.full((4, 4), np.inf)
        self._open(config)
        self._poses.mount(self._imu_mount)

    def begin(self) -> None:
        """Listen. After a pause the map is the one of before."""
        self._poses.reset()
        # A deskew uses what the odometry finds.
        is_fast = self._settings.value.topics.imu_rate > 0.0
        fast = self._inputs.guarded(self.take_fast, self._poses.reset) if is_fast else None
        self.sensors.add(self, self._guarded, is_first=True, fast=fast)
        guarded = self._guarded
        steady_timer(self, 1.0, guarded(self._diagnose))
        self._map_timer, self._map_period_s = None, 0.0  # that of before ended with the pause
        self._time_map(self._settings.value.topics.map_period_s)
        load_libraries(*LIBRARIES)

    def pause(self) -> None:
        """Listen no more."""
        self.sensors.remove(self)

    def tear_down(self) -> None:
        """Forget map and path."""
        self.sensors.remove(self)
        self._pipeline = None

    def shared_entities(self) -> list[Any]:
        """Return those of the subscriptions."""
        return self.sensors.entities

    @property
    def pipeline(self) -> OdometryPipeline:
        """The odometry pipeline; only while the node is configured."""
        assert self._pipeline is not None
        return self._pipeline

    def _guarded(self, callback: Callable[..., None]) -> Callable[..., None]:
        return self._inputs.guarded(callback, self._begin_again)

    def _open(self, config: OdometryNodeConfig) -> None:
        topics = config.topics
        reliable = topics.qos_reliability == "reliable"
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        out = QoSProfile(depth=10, reliability=reliability)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._odometry = self.create_publisher(OdometryMessage, topics.odometry_topic, out)
        self._path_publisher = self.create_publisher(Path, topics.path_topic, latched)
        self._map = self.create_publisher(PointCloud2, topics.map_topic, latched)
        self._registered = self.create_publisher(PointCloud2, topics.registered_topic, out)
        self._deskewed = self.create_publisher(PointCloud2, topics.deskewed_topic, out)
        self._status = self.create_publisher(DiagnosticArray, topics.status_topic, out)
        self._tf = self.create_publisher(TFMessage, "/tf", QoSProfile(depth=100))
        self._poses = PoseBroadcaster(
            lambda: self._settings.value.topics,
            lambda: self._base_name,
            self._tf,
            self.create_publisher(OdometryMessage, topics.fast_odometry_topic, out),
            round(config.odometry.inertial.imu_gap_ms * 1e6),
            lambda parent, child: not self._static.obstacle(parent, child),
        )
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        for name, answer in (
            ("reset", self._reset),
            ("save_map", self._save_map),
            ("save_trajectory", self._save_trajectory),
        ):
            self.create_service(Trigger, f"~/{name}", answer_or_error(self._inputs, answer))

    def _configure(self, config: OdometryNodeConfig) -> None:
        if self._pipeline is not None:
            self._pipeline.configure(config.odometry)
        if self.is_active:
            self._time_map(config.topics.map_period_s)

    def _time_map(self, period_s: float) -> None:
        """Show the map in this period from now on [s], with 0 never."""
        if period_s == self._map_period_s:
            return
        self._map_period_s = period_s
        if self._map_timer is not None:
            self.destroy_timer(self._map_timer)
            self._map_timer = None
        if period_s > 0.0:
            self._map_timer = steady_timer(self, period_s, self._guarded(self._show_map))

    def shared_subscriptions(self, node: Node, topics: DeskewTopics) -> SensorSubscriptions | None:
        """Return the subscriptions if a deskew node wants exactly these."""
        own = self._settings.value.topics
        same = (
            topics.input_reliability == "best_effort"
            and node.resolve_topic_name(topics.cloud_topic)
            == self.resolve_topic_name(own.cloud_topic)
            and node.resolve_topic_name(topics.imu_topic) == self.resolve_topic_name(own.imu_topic)
        )
        return self.sensors if same else None

    def publishes(self, node: Node, topics: DeskewTopics) -> bool:
        """Return whether this is the odometry whose velocities a deskew node takes.

        Raises
        ------
        SettingError
            If it expects twists on the topic of this odometry.
        """
        own = self.resolve_topic_name(self._settings.value.topics.odometry_topic)
        if node.resolve_topic_name(topics.velocity_topic) != own:
            return False
        if topics.velocity_type == "twist":
            raise SettingError(
                f"parameter 'velocity_topic': {own} carries the odometry of "
                "this process, not twists; set velocity_type to odometry, or choose another topic"
            )
        return topics.velocity_type == "odometry"

    def motion_of(self, sweep: Sweep) -> KnownMotion | None:
        """Return the motion that was estimated for a sweep, None if there is none."""
        return self._pipeline.motion_of(sweep) if self._pipeline is not None else None

    def convention_of_imu(self) -> ImuConvention | None:
        """Return unit and sign of the accelerometer as detected, None while not configured."""
        return self._pipeline.convention if self._pipeline is not None else None

    @property
    def is_waiting(self) -> bool:
        """Whether a sweep waits for IMU samples."""
        return self.pipeline.due_ns is not None

    def take_samples(self, samples: Samples, frame: str) -> None:
        """Take IMU samples (N,) of a frame."""
        samples = self._inputs.usable(samples, frame)
        if not len(samples):
            return
        self.pipeline.imu(samples)
        for note in self.pipeline.convention.notes:
            self._say(f"{frame}: {note}")

    def take_fast(self, samples: Samples, frame: str) -> None:
        """Publish poses at new IMU samples (N,); called in the subscriptions' thread."""
        pipeline = self._pipeline
        if pipeline is not None and frame == self._inputs.imu.name:
            self._poses.take(pipeline.corrected(samples[in_range(samples)]))

    def take_cloud(self, item: ReceivedCloud) -> None:
        """Take a cloud; one that cannot be read is counted and left out."""
        frame = item.cloud.frame
        if not self._inputs.clouds.takes(frame):
            return
        if self._cloud_frame not in ("", frame):  # another sensor: neither pose nor map are its
            self._begin_again()
        self._cloud_frame = frame
        try:
            sweep = item.sweep(self._settings.value.topics.time_unit, snapshots=True)
        except CloudError as error:
            self.refuse_cloud(error)
            return
        if sweep.start == sweep.end:
            self._say(
                f"{frame}: clouds without a time per point: each is taken as measured at its stamp"
            )
        self._mount()
        self._inputs.sweep(sweep)
        # To show the deskewed cloud, the transform must reach its end and arrive first.
        self._poses.catch_up()
        self.pipeline.sweep(sweep, time.monotonic_ns(), item.backlog)

    def refuse_cloud(self, error: ValueError) -> None:
        """Count a cloud that cannot be used."""
        self._inputs.refuse(str(error))
        self.get_logger().warning(f"cloud dropped: {error}", throttle_duration_sec=5.0)

    def _mount(self) -> None:
        """Take the mounts from TF, as long as nothing depends on them yet or they changed."""
        imu_frame = self._inputs.imu.name or ""
        self._share_frame(imu_frame)
        if self._frames is None:
            return
        asked = (self._frames.version, self._cloud_frame, imu_frame)
        if asked == self._mounted:
            return
        self._mounted = asked
        if imu_frame and imu_frame != self._cloud_frame:
            T_cloud_imu = self._frames.find(self._cloud_frame, imu_frame)
            if T_cloud_imu is not None and not self.pipeline.is_mounted(T_cloud_imu):
                self.pipeline.mount(T_cloud_imu)
                self._poses.mount(self._imu_mount)
        base = self._settings.value.topics.base_frame
        if base and base != self._cloud_frame:
            T_cloud_base = self._frames.find(self._cloud_frame, base)
            if T_cloud_base is not None and not np.allclose(T_cloud_base, self._base.T_lidar_base):
                self._base = BaseFrame(T_cloud_base)

    @property
    def _imu_mount(self) -> F64:
        """Where the odometry has the IMU, (4, 4)."""
        return self.pipeline.odometry.T_cloud_imu

    def _say(self, note: str) -> None:
        """Warn of something once."""
        if note not in self._said:
            self._said.add(note)
            self.get_logger().warning(note)

    def _share_frame(self, imu_frame: str) -> None:
        """Put the IMU at the clouds' origin if both have the same frame."""
        topics = self._settings.value.topics
        if (
            imu_frame
            and imu_frame == self._cloud_frame
            and topics.imu_xyz == OdometryTopics().imu_xyz  # a place set by hand counts more
            and not self.pipeline.is_mounted(np.eye(4))
        ):
            self.pipeline.mount(np.eye(4))
            self._poses.mount(self._imu_mount)
            self._say(
                f"IMU and clouds have the same frame '{imu_frame}': the IMU is taken to be "
                "at its origin"
            )

    def advance(self) -> None:
        """Publish finished estimates."""
        estimates = self.pipeline.poll(time.monotonic_ns())
        for estimate in estimates:
            self._publish(estimate)
        if estimates:
            self._go_on_from_here()

    @property
    def _base_name(self) -> str:
        return self._settings.value.topics.base_frame or self._cloud_frame

    def _publish(self, estimate: OdometryEstimate) -> None:
        topics = self._settings.value.topics
        motion = self._base.motion(estimate)
        stamp, odom = estimate.stamp, topics.odom_frame
        message = messages.odometry(motion, stamp, odom, self._base_name)
        if topics.covariance_when_lost and CUTS & set(estimate.status):
            messages.set_unknown(message)
        self._odometry.publish(message)
        self._status.publish(
            messages.odometry_status(
                estimate,
                self._base_name,
                estimate.T_map_lidar @ self._base.T_lidar_base,
                self.get_clock().now().nanoseconds,
            )
        )
        self._poses.sweep(estimate, self._base)
        self._extend_path(motion.T_odom_base, estimate)
        if self._registered.get_subscription_count():
            pose = self._base.odom_from_map(estimate.T_map_lidar) @ estimate.T_map_lidar
            points = messages.moved(estimate.points, pose)
            self._registered.publish(to_cloud(points, stamp, odom))
        if self._deskewed.get_subscription_count():
            T_base_lidar = rotations.inverse(self._base.T_lidar_base)
            points = messages.moved(estimate.points, T_base_lidar)
            self._deskewed.publish(to_cloud(points, stamp, self._base_name))

    def _extend_path(self, pose: F64, estimate: OdometryEstimate) -> None:
        topics = self._settings.value.topics
        if not messages.are_apart(self._path_end, pose, *_PATH_STEP):
            return
        self._path_end = pose
        if self._path.maxlen != topics.path_length:
            self._path = deque(self._path, topics.path_length)
        self._path.append(messages.pose_stamped(pose, estimate.stamp, topics.odom_frame))
        if self._path_publisher.get_subscription_count():
            path = Path(poses=list(self._path))
            path.header = self._path[-1].header
            self._path_publisher.publish(path)

    def _go_on_from_here(self) -> None:
        """Let dead reckoning go on from the latest sweep."""
        newest = self.pipeline.newest_imu
        if newest is not None:
            self._poses.go_on_from(self.pipeline.odometry.extrapolated(newest))

    def _show_map(self) -> None:
        last = self.pipeline.last
        if last is not None and self._map.get_subscription_count():
            points = messages.as_cloud(self._map_points(last))
            odom = self._settings.value.topics.odom_frame
            self._map.publish(to_cloud(points, last.stamp, odom))

    def _map_points(self, last: OdometryEstimate) -> F64:
        """Return the local map in the odometry frame [m], shape (N, 3)."""
        turn = self._base.odom_from_map(last.T_map_lidar)
        return self.pipeline.odometry.map_points() @ turn[:3, :3].T + turn[:3, 3]

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        del request
        self._begin_again()
        response.success, response.message = True, "a new map begins with the next clouds"
        return response

    def _begin_again(self) -> None:
        # First: the IMU's thread would begin the new odometry frame at a pose in the old map.
        self._poses.reset()
        self.pipeline.reset()
        self._base.reset()
        self._path.clear()
        self._path_end = np.full((4, 4), np.inf)
        self._looked_at = 0

    def _save_map(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        del request
        last = self.pipeline.last
        if last is None:
            response.success, response.message = False, "no map yet"
            return response
        try:
            (path,) = self._folder.new_files(self._settings.value.files.map_file)
            count = outputs.save(path, self._map_points(last))
            response.success, response.message = True, f"{count} points in {path.absolute()}"
        except (OSError, FileNameError) as error:
            response.success, response.message = False, str(error)
        return response

    def _save_trajectory(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        del request
        name = self._settings.value.files.trajectory_file
        poses = self._base.poses(self.pipeline.trajectory.poses)
        try:
            path, beside = self._folder.new_files(name, f"{FilePath(name).stem}.kitti")
            write_whole(path, outputs.tum(poses))
            write_whole(beside, outputs.kitti(poses))
            response.success = True
            response.message = (
                f"{len(poses)} poses in {path.absolute()} and a KITTI file beside it"
            )
        except (OSError, FileNameError) as error:
            response.success, response.message = False, str(error)
        return response

    def _untied(self) -> str:
        """Return why the poses are not those of the base frame; empty if they are."""
        base = self._settings.value.topics.base_frame
        reason = untied(self._frames, self._cloud_frame, base) if base else ""
        if not reason or not self._cloud_frame:
            return ""
        text = f"poses are those of '{self._cloud_frame}': {reason}"
        self.get_logger().warning(text, throttle_duration_sec=10.0)
        return text

    def _unpublished(self) -> str:
        """Return why the transform is withheld, and what to set; empty if it is not."""
        topics = self._settings.value.topics
        odom, base = topics.odom_frame, self._base_name
        if not topics.publish_tf or not base:
            return ""
        parent, child = (base, odom) if topics.invert_tf else (odom, base)
        obstacle = self._static.obstacle(parent, child)
        if not obstacle:
            self._withheld = ""
            return ""
        root, _ = self._static.root(child)
        if topics.invert_tf or root == odom:
            remedy = f"take '{odom}' off /tf_static, or set publish_tf to false"
        else:
            remedy = f"set base_frame to '{root}', or invert_tf to true, or publish_tf to false"
        text = f"no transform from '{parent}' to '{child}': {obstacle}; {remedy}"
        if text != self._withheld:
            self.get_logger().warning(text)
        self._withheld = text
        return text

    def _diagnose(self) -> None:
        since = self.pipeline.sweeps - self._looked_at
        self._looked_at = self.pipeline.sweeps
        judged = judge(
            self.pipeline.last,
            self.pipeline.sweeps,
            since,
            self.pipeline.counts,
            self._inputs.refused,
            self._untied(),
            self.pipeline.check,
        )
        judged.values["calibration of the IMU"] = self.pipeline.extrinsics.source
        if self._said:
            judged.values["recognized"] = "; ".join(sorted(self._said))
        unpublished = self._unpublished()
        if unpublished:
            text = f"{judged.message}; {unpublished}"
            judged = replace(judged, level=Level.ERROR, message=text)
        refused = self._frames.refused if self._frames is not None else ""
        judged = self._inputs.judge(judged, refused)
        name = self.get_fully_qualified_name().lstrip("/")
        now = HostNs(self.get_clock().now().nanoseconds)
        self._diagnostics.publish(diagnostic_array([judged], name, now))


def main(args: list[str] | None = None) -> int:
    """Run the odometry node; see :func:`l2lidar_node.ros.program.run`."""
    return run("odometry_node", OdometryNode, args)


if __name__ == "__main__":
    sys.exit(main())
