"""Mount monitor: warns when ``imu_adjust`` meets a mount in ``/tf_static`` that is not level.

With ``imu_adjust`` the points are turned upright but stay in the cloud frame. TF then applies the
mount a second time: right only where the mount does not tilt the sensor.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from rclpy.node import Node

from l2lidar_node.driver.health import Check
from l2lidar_node.ros.static_frames import StaticFrames
from l2lidar_node.types import Level

MAX_TILT_DEG: Final = 2.0
"""At 5 m a floor is 17 cm off: more than the sensor's own alignment error of about 1 degree."""


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
        self._frames = StaticFrames(node)

    def tilt_deg(self) -> tuple[str, float]:
        """Return the topmost frame above the cloud frame, and the tilt of the sensor in it [deg].

        The cloud frame itself and 0 where nothing is above it.
        """
        frame, T_root_cloud = self._frames.root(self._cloud_frame)
        return frame, math.degrees(math.acos(float(np.clip(T_root_cloud[2, 2], -1.0, 1.0))))

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
