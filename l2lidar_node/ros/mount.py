"""Mount monitor: warns when ``imu_adjust`` meets a mount in ``/tf_static`` that is not level.

With ``imu_adjust`` the points are turned upright but stay in the cloud frame. TF then applies the
mount a second time: right only where the mount does not tilt the sensor.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

from l2lidar_node.driver.health import Check
from l2lidar_node.types import F64, Level

MAX_TILT_DEG: Final = 2.0
"""At 5 m a floor is 17 cm off: more than the sensor's own alignment error of about 1 degree."""
_MAX_FRAMES: Final = 10_000
_MAX_DEPTH: Final = 100
_UP: Final = np.array([0.0, 0.0, 1.0])


class MountMonitor:
    """Follows the static transforms above a cloud frame.

    Parameters
    ----------
    node : Node
    cloud_frame : str
    """

    def __init__(self, node: Node, cloud_frame: str) -> None:
        self._node = node
        self._cloud_frame = cloud_frame
        self._parents: dict[str, tuple[str, F64]] = {}  # with the quaternion (w, x, y, z)
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(TFMessage, "/tf_static", self._take, latched)

    def tilt_deg(self) -> tuple[str, float]:
        """Return the topmost frame above the cloud frame, and the tilt of the sensor in it [deg].

        The cloud frame itself and 0 where nothing is above it.
        """
        frame, up = self._cloud_frame, _UP
        passed: set[str] = set()
        while frame in self._parents and frame not in passed and len(passed) < _MAX_DEPTH:
            passed.add(frame)
            frame, q_parent_child = self._parents[frame]
            up = _rotated(q_parent_child, up)
        return frame, math.degrees(math.acos(float(np.clip(up[2], -1.0, 1.0))))

    def judge(self, levels_points: bool) -> Check | None:
        """Return what is to be said of the mount while the driver levels its points or not.

        None without a mount. A warning is logged as well, every 30 s at most.
        """
        frame, tilt = self.tilt_deg()
        if frame == self._cloud_frame:
            return None
        values = {"root frame": frame, "tilt [deg]": f"{tilt:.1f}"}
        if not levels_points or tilt <= MAX_TILT_DEG:
            return Check("mount", Level.OK, f"tilted by {tilt:.1f} deg in '{frame}'", values)
        message = (
            f"imu_adjust is true, but /tf_static tilts '{self._cloud_frame}' by {tilt:.0f} deg "
            f"against '{frame}': the mount is applied twice; set imu_adjust: false"
        )
        self._node.get_logger().warning(message, throttle_duration_sec=30.0)
        return Check("mount", Level.WARN, message, values)

    def _take(self, message: TFMessage) -> None:
        for item in message.transforms:
            child, q = item.child_frame_id.lstrip("/"), item.transform.rotation
            wxyz = np.array([q.w, q.x, q.y, q.z])
            norm = float(np.linalg.norm(wxyz))
            is_rotation = math.isfinite(norm) and abs(norm - 1.0) < 0.1
            if is_rotation and (child in self._parents or len(self._parents) < _MAX_FRAMES):
                self._parents[child] = item.header.frame_id.lstrip("/"), wxyz / norm


def _rotated(q_wxyz: F64, vector: F64) -> F64:
    """Return a vector (3,) turned by a unit quaternion."""
    axis = q_wxyz[1:]
    twice = 2.0 * np.cross(axis, vector)
    return np.asarray(vector + q_wxyz[0] * twice + np.cross(axis, twice))
