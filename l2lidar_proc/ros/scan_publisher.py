"""Publishes a ``LaserScan`` of each deskewed sweep, for Nav2, slam_toolbox and others."""

from __future__ import annotations

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from l2lidar_node import rotations
from l2lidar_node.ros.conversions import to_time
from l2lidar_node.ros.mounting import StaticFrames
from l2lidar_node.types import F64, HostNs
from l2lidar_proc.deskew.config import ScanConfig
from l2lidar_proc.deskew.laser_scan import ScanBuilder, level_rotation
from l2lidar_proc.deskew.pipeline import Deskewed
from l2lidar_proc.motion.tracker import MotionTracker
from l2lidar_proc.ros import odometry_messages as messages


class ScanPublisher:
    """The scan's topic, and where its frame is gravity's, the transform to that.

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
        self._before: HostNs | None = None
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
        """Publish the scan of a sweep if somebody wants it."""
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
        before, self._before = self._before, item.stamp
        T_now_before = None if before is None else tracker.motion(before, item.stamp)
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
            self._transforms.publish(TFMessage(transforms=[made]))
        self._scans.publish(message)

    def _place(
        self, stamp: HostNs, cloud_frame: str, tracker: MotionTracker
    ) -> tuple[str, F64] | None:
        """Return the scan's frame, and what takes cloud coordinates to it; None if not known."""
        frame = self._builder.config.frame
        if frame:
            found = self._frames.find(frame, cloud_frame) if self._frames is not None else None
            if found is None and frame != cloud_frame:
                self._warn(f"scan_frame '{frame}' is not tied to '{cloud_frame}' on /tf_static")
                return None
            return frame, np.eye(4) if found is None else found
        up = tracker.up(stamp)
        if up is None:
            self._warn("the vertical is not known without IMU samples; or set scan_frame")
            return None
        T_level_cloud = np.eye(4)
        T_level_cloud[:3, :3] = level_rotation(up)
        return f"{cloud_frame.removesuffix('_link')}_level", T_level_cloud

    def _warn(self, reason: str) -> None:
        self._before = None
        self._node.get_logger().warning(f"no scan: {reason}", throttle_duration_sec=10.0)
