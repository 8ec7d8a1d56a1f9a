"""What other ROS nodes do to the driver node: a subscriber that stalls, and one that dies."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Final

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu, PointCloud2

from l2lidar_node.demo.observer import TopicRecord
from l2lidar_node.demo.processes import Program, Programs, free_udp_ports, isolate_ros
from l2lidar_node.ros.conversions import from_time
from tools.cpu import resident_mb
from tools.fault_world import Finding

_MODULE: Final = "tools.fault_ros"
_PACKETS_PER_TURN: Final = 49.53
_PACKETS_PER_S: Final = 1 / 0.004639
_START_S: Final = 30.0


def run() -> list[Finding]:
    """Return what a stalled and a killed reliable subscriber do to the topics."""
    isolate_ros()
    host_port, lidar_port = free_udp_ports(2)
    values = {
        "l2_ip": "127.0.0.1", "l2_port": lidar_port, "host_ip": "127.0.0.1",
        "host_port": host_port, "enable_IMU_publishing": "true", "imu_adjust": "false",
        "sweep_cut": "turn", "qos_reliability": "reliable",
    }  # fmt: skip
    assignments = [part for key, value in values.items() for part in ("-p", f"{key}:={value}")]
    rclpy.init()
    observer = _Watcher()
    try:
        with Programs() as programs:
            driver = programs.start("l2lidar_node.ros.driver_node", ["--ros-args", *assignments])
            programs.start(
                "l2lidar_node.emulator",
                ["--ready", "--world", "pattern",
                 "--host-port", str(host_port), "--lidar-port", str(lidar_port)],
            )  # fmt: skip
            slow = programs.start(_MODULE, [])
            deadline = time.monotonic() + _START_S
            while len(observer.clouds.stamps) < 10 or observer.count_subscribers("/points") < 2:
                observer.watch(time.monotonic() + 0.2)
                programs.check()
                if time.monotonic() > deadline:
                    raise TimeoutError("no clouds, or no second subscriber")
            return [
                _watched(observer, driver, "two reliable subscribers", lambda: None),
                _watched(
                    observer, driver, "one of them stopped 6 s",
                    lambda: _signal(slow, signal.SIGSTOP),
                ),
                _watched(
                    observer, driver, "that one killed",
                    lambda: _signal(slow, signal.SIGKILL),
                ),
            ]  # fmt: skip
    finally:
        observer.destroy_node()
        rclpy.try_shutdown()


def _signal(program: Program, number: signal.Signals) -> None:
    os.kill(program.pid, number)


def _watched(
    observer: _Watcher, driver: Program, name: str, happen: Callable[[], None]
) -> Finding:
    observer.clouds, observer.imu = TopicRecord(), TopicRecord()
    before_mb = resident_mb(driver.pid)
    happen()
    observer.watch(time.monotonic() + 6.0)
    clouds, imu = observer.clouds, observer.imu
    finding = Finding(name, published=len(clouds.stamps) + len(imu.stamps))
    finding.backwards = clouds.backward_steps + imu.backward_steps
    # An IMU sample comes every 4 ms, a turn takes 49.53 packets.
    turn_ns = _PACKETS_PER_TURN / _PACKETS_PER_S * 1e9
    finding.missing = sum(
        max(round((after - before) / period) - 1, 0)
        for stamps, period in ((imu.stamps, 4e6), (clouds.stamps, turn_ns))
        for before, after in pairwise(stamps)
    )
    growth = resident_mb(driver.pid) - before_mb
    gaps = [b - a for a, b in pairwise(imu.arrivals)]
    finding.recovery_s = max(gaps, default=0.0)
    finding.remark = (
        f"longest pause of the other {finding.recovery_s * 1e3:.0f} ms, "
        f"driver grows by {growth:.1f} MB"
    )
    finding.good = finding.missing == finding.backwards == 0 and finding.published > 1000
    return finding


class _Watcher(Node):
    """Takes everything, reliably, with a long queue, and notes the stamps."""

    def __init__(self) -> None:
        super().__init__("watcher")
        self.clouds, self.imu = TopicRecord(), TopicRecord()
        deep = QoSProfile(depth=500)
        self.create_subscription(PointCloud2, "/points", self._cloud, deep)
        self.create_subscription(Imu, "/imu/data", self._sample, deep)

    def watch(self, until: float) -> None:
        """Handle what arrives until a monotonic time [s]."""
        while (left := until - time.monotonic()) > 0:
            rclpy.spin_once(self, timeout_sec=min(left, 0.1))

    def _cloud(self, message: PointCloud2) -> None:
        self.clouds.add(from_time(message.header.stamp), message.header.frame_id)

    def _sample(self, message: Imu) -> None:
        self.imu.add(from_time(message.header.stamp), message.header.frame_id)


class _Subscriber(Node):
    """Takes everything, reliably, with a short queue."""

    def __init__(self) -> None:
        super().__init__("slow_subscriber")
        for kind, topic in ((PointCloud2, "/points"), (Imu, "/imu/data")):
            self.create_subscription(kind, topic, lambda message: None, QoSProfile(depth=5))


def main() -> int:
    """Be the subscriber."""
    rclpy.init()
    rclpy.spin(_Subscriber())
    return 0


if __name__ == "__main__":
    sys.exit(main())
