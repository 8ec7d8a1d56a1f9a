"""Publishes the health of the device once a second, and what it is once it is known."""

from __future__ import annotations

import json
from concurrent.futures import CancelledError
from dataclasses import asdict
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from l2lidar_node.driver import health
from l2lidar_node.driver.driver import Driver
from l2lidar_node.driver.metadata import metadata
from l2lidar_node.ros.conversions import to_time
from l2lidar_node.ros.mount import MountMonitor
from l2lidar_node.ros.program import StartError
from l2lidar_node.transport.session import Loop
from l2lidar_node.types import HostNs

PERIOD_S = 1.0
_SHORTEST_NS = 500_000_000


def diagnostic_array(
    checks: list[health.Check], name: str, hardware_id: str, stamp: HostNs
) -> DiagnosticArray:
    """Return checks as a message; every status is called ``<node>: <check>``."""
    message = DiagnosticArray()
    message.header.stamp = to_time(stamp)
    message.status = [
        DiagnosticStatus(
            level=bytes([check.level]),
            name=f"{name}: {check.name}",
            message=check.message,
            hardware_id=hardware_id,
            values=[KeyValue(key=key, value=value) for key, value in check.values.items()],
        )
        for check in checks
    ]
    return message


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
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._about = node.create_publisher(String, "~/metadata", latched)
        node.create_timer(PERIOD_S, self._publish)

    def _publish(self) -> None:
        try:
            checks, about, now = self._session.call(self._look).result()
        except CancelledError:
            self._ended()
            return
        config = self._session.driver.config
        if checks:
            mount = self._mount.judge(config.imu.adjust)
            checks += [mount] if mount is not None else []
            name = self._node.get_fully_qualified_name().lstrip("/")
            self._diagnostics.publish(diagnostic_array(checks, name, config.network.l2_ip, now))
        text = json.dumps(about, indent=2)
        if text != self._metadata:
            self._metadata = text
            self._about.publish(String(data=text))

    def _ended(self) -> None:
        """End the program if the session failed: nothing would ever come again."""
        if self._session.failure is not None and self._node.context.ok():
            raise StartError(f"the receiving thread failed: {self._session.failure!r}")

    def _look(
        self, driver: Driver, now: HostNs
    ) -> tuple[list[health.Check], dict[str, Any], HostNs]:
        after = health.observe(driver, self._session.transport, now)
        before = self._before
        if driver is not self._driver:  # that of a replay's next lap counts from 0
            self._driver, before = driver, None
        if before is not None and 0 <= after.now - before.now < _SHORTEST_NS:
            return [], asdict(metadata(driver)), now  # a slow replay: rates would say nothing
        self._before = after
        checks = health.judge(driver, before, after) if before is not None else []
        return checks, asdict(metadata(driver)), now
