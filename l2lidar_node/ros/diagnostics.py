"""Publishes diagnostics of the device once a second, and its metadata on change.

With ``imu_adjust`` the points are turned upright but stay in the cloud frame. TF then applies the
mount a second time: right only where the mount does not tilt the sensor.
"""

from __future__ import annotations

import json
import math
import time
from concurrent.futures import CancelledError, Future
from dataclasses import asdict
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from l2lidar_node.driver import health
from l2lidar_node.driver.driver import Driver
from l2lidar_node.driver.health import metadata
from l2lidar_node.ros.conversions import diagnostic_array
from l2lidar_node.ros.mounting import StaticFrames
from l2lidar_node.ros.program import StartError
from l2lidar_node.transport.session import Loop
from l2lidar_node.types import FIRST_STAMP, LAST_STAMP, Check, HostNs, Level

MAX_TILT_DEG: Final = 2.0
"""At 5 m a floor is 17 cm off: more than the sensor's own alignment error of about 1 degree."""


class MountMonitor:
    """Monitors the static transforms above a cloud frame.

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
        """Return the check of the mount, depending on whether the driver levels its points.

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


PERIOD_S = 1.0
_SHORTEST_NS = 500_000_000
_SILENT_S = 3.0

_Figures = tuple[list[Check], dict[str, Any], HostNs]


class HealthPublisher:
    """Publishes ``/diagnostics`` at 1 Hz and the latched ``~/metadata`` when it changes.

    Parameters
    ----------
    node : Node
    session : Loop
        Whose thread is asked for the figures; should it have failed, the program is ended.
    """

    def __init__(self, node: Node, session: Loop) -> None:
        self._node = node
        self._session = session
        self._mount = MountMonitor(node, session.driver.config.frames.cloud)
        self._before: health.Period | None = None
        self._driver: Driver | None = None
        self._metadata = ""
        self._block = ""
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._about = node.create_publisher(String, "~/metadata", latched)
        self._asked: Future[_Figures] | None = None
        self._asked_at = 0.0
        self._ready = node.create_guard_condition(self._publish)
        node.create_timer(PERIOD_S, self._ask, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _ask(self) -> None:
        """Ask the session's thread for the figures; it wakes the executor when it has them.

        A replay's thread begins with the activation: until then there is nobody to ask.
        """
        if not self._session.is_started:
            return
        if self._asked is not None:
            self._tell_silence()
            return
        self._asked, self._asked_at = self._session.call(self._look), time.monotonic()
        self._asked.add_done_callback(lambda _: self._ready.trigger())

    def _tell_silence(self) -> None:
        silent_s = time.monotonic() - self._asked_at
        if silent_s < _SILENT_S:
            return
        text = f"the receive thread has not responded for {silent_s:.0f} s"
        check = Check("device", Level.ERROR, text, {})
        self._send([check], HostNs(self._node.get_clock().now().nanoseconds))

    def _publish(self) -> None:
        asked, self._asked = self._asked, None
        if asked is None:
            return
        try:
            checks, about, stamp = asked.result()
        except CancelledError:
            self._ended()
            return
        self._block = about["calibration_crc"]
        if checks:
            mount = self._mount.judge(self._session.driver.config.imu.adjust)
            checks += [mount] if mount is not None else []
            self._send(checks, stamp)
        text = json.dumps(about, indent=2)
        if text != self._metadata:
            self._metadata = text
            self._about.publish(String(data=text))

    def _send(self, checks: list[Check], stamp: HostNs) -> None:
        name = self._node.get_fully_qualified_name().lstrip("/")
        stamp = HostNs(min(max(stamp, FIRST_STAMP), LAST_STAMP))
        self._diagnostics.publish(diagnostic_array(checks, name, stamp, self._hardware_id()))

    def _hardware_id(self) -> str:
        """Name the unit: its line or address, and its calibration block, which no other has."""
        where = self._session.driver.config.network.where
        return f"L2 at {where}" + (f", calibration block {self._block}" if self._block else "")

    def _ended(self) -> None:
        """End the program if the session failed: nothing would ever come again."""
        if self._session.failure is not None and self._node.context.ok():
            raise StartError(f"the receive thread failed: {self._session.failure!r}")

    def _look(self, driver: Driver, now: HostNs) -> _Figures:
        stamp = self._session.stamp(now)
        after = health.observe(driver, self._session.transport, now)
        before = self._before
        if driver is not self._driver:  # that of a replay's next lap counts from 0
            self._driver, before = driver, None
        if before is not None and 0 <= health.elapsed_ns(before, after) < _SHORTEST_NS:
            return [], asdict(metadata(driver)), stamp  # a slow replay: rates would say nothing
        self._before = after
        checks = health.judge(driver, before, after) if before is not None else []
        return checks, asdict(metadata(driver)), stamp
