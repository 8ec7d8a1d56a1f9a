"""Deskew node: converts messages, calls the pipeline, publishes."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistStamped, Vector3
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import LaserScan, PointCloud2
from tf2_msgs.msg import TFMessage

from l2lidar_node import rotations
from l2lidar_node.clouds import LAYOUTS
from l2lidar_node.ros.conversions import (
    CloudTemplate,
    diagnostic_array,
    diagnostic_status,
    from_time,
    to_cloud,
    to_time,
)
from l2lidar_node.ros.managed_node import ManagedNode
from l2lidar_node.ros.mounting import ImuAdjustClient, StaticFrames, untied
from l2lidar_node.ros.parameters import ParameterSet
from l2lidar_node.ros.program import run
from l2lidar_node.types import F64, Check, HostNs, Sweep, is_ros_time
from l2lidar_proc.cloud import CloudError, position_problem, without_time
from l2lidar_proc.deskew.config import AS_INPUT, DeskewNodeConfig, ScanConfig
from l2lidar_proc.deskew.laser_scan import ScanBuilder, level_rotation
from l2lidar_proc.deskew.pipeline import Deskewed, Pipeline, of_period, of_sweep
from l2lidar_proc.motion.filter import LIBRARY
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.motion.imu_corrections import ImuConvention
from l2lidar_proc.motion.tracker import (
    KnownMotion,
    MotionTracker,
    cloud_velocity,
    cloud_velocity_covariance,
)
from l2lidar_proc.ros import odometry_messages as messages
from l2lidar_proc.ros.inputs import InputMonitor, load_libraries, steady_timer
from l2lidar_proc.ros.subscriptions import (
    IMU_DEPTH,
    RELIABILITY,
    ReceivedCloud,
    SensorSubscriptions,
)

if TYPE_CHECKING:
    from l2lidar_proc.ros.odometry_node import OdometryNode  # brings kiss-icp along


class ScanPublisher:
    """Publishes the laser scan, and the transform to its level frame.

    Parameters
    ----------
    node : Node
    config : ScanConfig
    frames : StaticFrames or None
        Where the mount of ``scan_frame`` is looked up.
    """

    def __init__(self, node: Node, config: ScanConfig, frames: StaticFrames | None) -> None:
        self._node = node
        self._frames = frames
        self._builder = ScanBuilder(config)
        self._before: tuple[HostNs, KnownMotion | None] | None = None
        self._scans = self._transforms = None
        if config.publish == "never":
            return
        reliable = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
        self._scans = node.create_publisher(LaserScan, config.topic, reliable)
        if not config.frame:
            self._transforms = node.create_publisher(TFMessage, "/tf", QoSProfile(depth=100))

    def configure(self, config: ScanConfig) -> None:
        """Take new live settings."""
        self._builder.config = config

    def publish(self, item: Deskewed, cloud_frame: str, tracker: MotionTracker) -> None:
        """Publish the scan of a sweep if it is wanted."""
        config = self._builder.config
        if self._scans is None or not (
            config.publish == "always" or self._scans.get_subscription_count()
        ):
            self._before = None
            return
        place = self._place(item.stamp, cloud_frame, tracker)
        if place is None:
            return
        frame, T_scan_cloud = place
        before, self._before = self._before, (item.stamp, item.known)
        T_now_before = None
        if before is not None:
            stamp_before, known_before = before
            T_now_before = tracker.motion(stamp_before, item.stamp, known_before, item.known)
        scan = self._builder.add(item.points, T_scan_cloud, T_now_before)
        message = LaserScan(
            angle_min=scan.angle_min,
            angle_max=scan.angle_min + (len(scan.ranges) - 1) * scan.angle_increment,
            angle_increment=scan.angle_increment,
            scan_time=(item.sweep.end - item.sweep.start) * 1e-9,
            range_min=config.range_min,
            range_max=config.range_max,
            ranges=scan.ranges,
            intensities=scan.intensities,
        )
        message.header.stamp = to_time(item.stamp)
        message.header.frame_id = frame
        if self._transforms is not None:
            T_cloud_level = rotations.inverse(T_scan_cloud)
            made = messages.transform(T_cloud_level, item.stamp, cloud_frame, frame)
            self._transforms.publish(made)
        self._scans.publish(message)

    def _place(
        self, stamp: HostNs, cloud_frame: str, tracker: MotionTracker
    ) -> tuple[str, F64] | None:
        """Return the scan's frame, and the transform from the cloud frame; None if unknown."""
        frame = self._builder.config.frame
        if frame:
            found = self._frames.find(frame, cloud_frame) if self._frames is not None else None
            if found is None and frame != cloud_frame:
                self._warn(f"scan_frame '{frame}' is not tied to '{cloud_frame}' on /tf_static")
                return None
            return frame, np.eye(4) if found is None else found
        up = tracker.up(stamp)
        if up is None:
            self._warn(
                "the vertical is unknown without IMU samples; publish them, or set scan_frame"
            )
            return None
        T_level_cloud = np.eye(4)
        T_level_cloud[:3, :3] = level_rotation(up)
        return f"{cloud_frame.removesuffix('_link')}_level", T_level_cloud

    def _warn(self, reason: str) -> None:
        self._before = None
        self._node.get_logger().warning(f"no scan: {reason}", throttle_duration_sec=10.0)


class DeskewNode(ManagedNode):
    """Publishes deskewed and filtered clouds.

    Parameters
    ----------
    companion : OdometryNode, optional
        An odometry in the same process. If it uses the same clouds and IMU, its subscriptions are
        shared, and unit and sign of the accelerometer are those that it detects. If the
        velocities would come from it as well, each sweep is deskewed with the motion that it has
        estimated for that sweep.

    Raises
    ------
    SettingError
        If a parameter is wrong.
    """

    def __init__(self, companion: OdometryNode | None = None) -> None:
        super().__init__("deskew_node")
        self._pipeline: Pipeline | None = None
        self._settings = ParameterSet(self, DeskewNodeConfig, self._configure)
        topics = self._settings.value.topics
        shared = companion.shared_subscriptions(self, topics) if companion is not None else None
        self._sensors = shared or SensorSubscriptions(
            self, topics.cloud_topic, topics.imu_topic, topics.input_reliability
        )
        self._odometry_motion: Callable[[Sweep], KnownMotion | None] | None = None
        self._odometry_convention: Callable[[], ImuConvention | None] | None = None
        if companion is not None and shared is not None:
            self._odometry_convention = companion.convention_of_imu
        if companion is not None and companion.publishes(self, topics) and shared is not None:
            self._odometry_motion = companion.motion_of
        self.start(self._settings.value.lifecycle.autostart)

    def set_up(self) -> None:
        """Open publishers and begin without a past."""
        config = self._settings.value
        topics = config.topics
        self._pipeline = Pipeline(config.proc)
        if self._pipeline.extrinsics.problem:
            self.get_logger().warning(self._pipeline.extrinsics.problem)
        self._pipeline.odometry_motion = self._odometry_motion
        self._pipeline.odometry_convention = self._odometry_convention
        self._frames = StaticFrames(self) if topics.use_tf else None
        self._mounted: tuple[str, str, int] | None = None
        self._cloud_frame = ""
        self._template: tuple[tuple[np.dtype[np.void], str], CloudTemplate] | None = None
        velocity = [topics.velocity_topic] if topics.velocity_type != "none" else []
        self._inputs = InputMonitor(self, (topics.cloud_topic, topics.imu_topic, *velocity))
        self._untied = ""
        self._last: Check | None = None
        self._before = self._pipeline.counts
        speaking = QoSProfile(depth=10, reliability=RELIABILITY[topics.qos_reliability])
        self._output = self.create_publisher(PointCloud2, topics.output_topic, speaking)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._statistics = self.create_publisher(DiagnosticStatus, "~/statistics", 10)
        self._scan = ScanPublisher(self, config.scan, self._frames)

    def begin(self) -> None:
        """Listen."""
        topics = self._settings.value.topics
        self._sensors.add(self, self._guarded)
        guarded, hear = self._guarded, self.create_subscription
        velocities = QoSProfile(depth=IMU_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        if topics.velocity_type == "odometry":
            hear(Odometry, topics.velocity_topic, guarded(self._odometry), velocities)
        elif topics.velocity_type == "twist":
            hear(TwistStamped, topics.velocity_topic, guarded(self._twist), velocities)
        self._imu_adjust = ImuAdjustClient(
            self, topics.cloud_topic, on_leveling=self._warn_of_leveling
        )
        steady_timer(self, 1.0, guarded(self._diagnose))
        load_libraries(LIBRARY)

    def pause(self) -> None:
        """Stop listening, publish waiting sweeps, and forget the motion."""
        self._sensors.remove(self)
        for item in self.pipeline.finish(time.monotonic_ns()):
            self._publish(item)
        self.pipeline.reset()

    def tear_down(self) -> None:
        """Forget everything."""
        self._sensors.remove(self)
        self._pipeline = None

    def shared_entities(self) -> list[Any]:
        """Return those of the subscriptions."""
        return self._sensors.entities

    @property
    def pipeline(self) -> Pipeline:
        """The deskew pipeline; only while the node is configured."""
        assert self._pipeline is not None
        return self._pipeline

    def _guarded(self, callback: Callable[..., None]) -> Callable[..., None]:
        return self._inputs.guarded(callback, self.pipeline.reset)

    def _configure(self, config: DeskewNodeConfig) -> None:
        if self._pipeline is not None:
            self._pipeline.configure(config.proc)
            self._scan.configure(config.scan)

    @property
    def is_waiting(self) -> bool:
        """Whether a sweep waits for IMU samples."""
        return self.pipeline.is_waiting

    def take_samples(self, samples: Samples, frame: str) -> None:
        """Take IMU samples (N,) of a frame."""
        samples = self._inputs.usable(samples, frame)
        if len(samples):
            self._mount(frame)
            self.pipeline.imu(samples)

    def _mount(self, imu_frame: str) -> None:
        """Take the place of the IMU from TF as soon as both frames are in it."""
        if self._frames is None or not self._cloud_frame:
            return
        asked = (self._cloud_frame, imu_frame, self._frames.version)
        if asked != self._mounted:
            self._mounted = asked
            T_cloud_imu = self._frames.find(self._cloud_frame, imu_frame)
            if T_cloud_imu is not None and self._cloud_frame != imu_frame:
                self.pipeline.mount(T_cloud_imu)

    def take_cloud(self, item: ReceivedCloud) -> None:
        """Take a cloud; one without usable times is passed on as it came."""
        points, stamp, frame = item.cloud
        if not self._inputs.clouds.takes(frame):
            return
        self._follow(frame)
        try:
            sweep = item.sweep(self._settings.value.proc.deskew.time_unit)
        except CloudError as error:
            if position_problem(points.dtype) or not is_ros_time(stamp):
                self._refuse(error, "dropped")
                return
            self._refuse(error, "passed on as it came, without times")
            self._output.publish(to_cloud(without_time(points), stamp, self._cloud_frame))
            return
        except ValueError as error:
            self._refuse(error, "dropped")
            return
        self._inputs.sweep(sweep)
        self.pipeline.sweep(sweep, time.monotonic_ns())

    def refuse_cloud(self, error: ValueError) -> None:
        """Count a cloud that could not be read."""
        self._refuse(error, "dropped")

    def _follow(self, frame: str) -> None:
        """Start over if clouds arrive in another frame."""
        if self._cloud_frame not in ("", frame):
            for item in self.pipeline.finish(time.monotonic_ns()):
                self._publish(item)
            self.pipeline.reset()
        self._cloud_frame = frame

    def _refuse(self, error: ValueError, fate: str) -> None:
        self._inputs.refuse(str(error))
        self.get_logger().warning(f"cloud {fate}: {error}", throttle_duration_sec=5.0)

    def _odometry(self, message: Odometry) -> None:
        twist = message.twist.twist
        covariance = np.reshape(message.twist.covariance, (6, 6))[:3, :3]
        self._velocity(
            message, message.child_frame_id, twist.linear, twist.angular, "odometry", covariance
        )

    def _twist(self, message: TwistStamped) -> None:
        twist = message.twist
        self._velocity(message, message.header.frame_id, twist.linear, twist.angular, "twist")

    def _velocity(
        self,
        message: Any,
        frame: str,
        linear: Vector3,
        angular: Vector3,
        source: str,
        covariance: NDArray[np.float64] | None = None,
    ) -> None:
        if not self._cloud_frame:
            return
        self._untied = untied(self._frames, self._cloud_frame, frame)
        if self._untied:
            text = f"velocity not used: {self._untied}"
            self.get_logger().warning(text, throttle_duration_sec=5.0)
            return
        T_cloud_body = self._frames.find(self._cloud_frame, frame) if self._frames else None
        if T_cloud_body is None:
            T_cloud_body = np.eye(4)
        velocity = cloud_velocity(
            (linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z), T_cloud_body
        )
        covariance = cloud_velocity_covariance(covariance, T_cloud_body)
        self.pipeline.velocity(from_time(message.header.stamp), velocity, source, covariance)

    def advance(self) -> None:
        """Publish finished sweeps."""
        for item in self.pipeline.poll(time.monotonic_ns()):
            self._publish(item)

    def _publish(self, item: Deskewed) -> None:
        self._output.publish(self._serialized(item.points, item.stamp))
        self._scan.publish(item, self._cloud_frame, self.pipeline.tracker)
        self._last = of_sweep(item.quality, item.waited_ns)
        if self._statistics.get_subscription_count():
            name = self.get_fully_qualified_name().lstrip("/")
            self._statistics.publish(diagnostic_status(self._last, name))

    def _serialized(self, points: NDArray[np.void], stamp: HostNs) -> bytes | PointCloud2:
        """Return a cloud to publish; a plain one is put together as bytes, three times as fast."""
        if points.ndim == 2:
            return to_cloud(points, stamp, self._cloud_frame)
        topics = self._settings.value.topics
        name = topics.point_layout
        if name != AS_INPUT:
            layout = LAYOUTS[name].with_rings(topics.ring_count)
            has_time = "time" in (points.dtype.names or ())
            points = (layout if has_time else layout.without_time()).convert(points, stamp)
        kind = (points.dtype, self._cloud_frame)
        if self._template is None or self._template[0] != kind:
            self._template = kind, CloudTemplate(*kind)
        return self._template[1].serialize(points, stamp)

    def _warn_of_leveling(self, publishers: list[str]) -> None:
        self.get_logger().error(
            f"{', '.join(publishers)} levels each packet (imu_adjust), and deskewing such "
            "clouds makes them wrong; set imu_adjust to false there",
            throttle_duration_sec=30.0,
        )

    def _diagnose(self) -> None:
        tracker = self.pipeline.tracker
        judged = of_period(
            self._before,
            self.pipeline.counts,
            self._last,
            tracker.buffer.counts,
            tracker.filter,
            self._inputs.refused,
            is_leveled=bool(self._imu_adjust.answer),
            untied=self._untied,
        )
        self._before = self.pipeline.counts
        judged.values["calibration of the IMU"] = self.pipeline.extrinsics.source
        if self.pipeline.convention.notes:
            judged.values["recognized"] = "; ".join(self.pipeline.convention.notes)
        refused = self._frames.refused if self._frames is not None else ""
        judged = self._inputs.judge(judged, refused)
        name = self.get_fully_qualified_name().lstrip("/")
        now = HostNs(self.get_clock().now().nanoseconds)
        self._diagnostics.publish(diagnostic_array([judged], name, now))


def main(args: list[str] | None = None) -> int:
    """Run the deskew node; see :func:`l2lidar_node.ros.program.run`."""
    return run("deskew_node", DeskewNode, args)


if __name__ == "__main__":
    sys.exit(main())
