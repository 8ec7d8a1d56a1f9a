"""What other ROS nodes do to the driver node: a subscriber that stalls, and one that dies."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from typing import Final

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu, PointCloud2

from benchmarks.fault_world import Finding
from benchmarks.topic_watch import CLOUDS, IMU, TopicWatch, backward_steps, missing
from l2lidar_node.demo.processes import Program, Programs, assigned, free_udp_ports, isolate_ros
from l2lidar_node.protocol import wire
from tests.support.cpu import resident_mb

_MODULE: Final = "benchmarks.fault_ros"
_TURN_S: Final = 0.229769  # of the head


def run() -> list[Finding]:
    """Return what a stalled and a killed reliable subscriber do to the topics."""
    isolate_ros()
    host_port, lidar_port = free_udp_ports(2)
    values = {
        "l2_ip": "127.0.0.1", "l2_port": lidar_port, "host_ip": "127.0.0.1",
        "host_port": host_port, "enable_IMU_publishing": "true", "imu_adjust": "false",
        "sweep_cut": "turn", "qos_reliability": "reliable",
    }  # fmt: skip
    rclpy.init()
    watch = TopicWatch([CLOUDS, IMU], reliable=True)
    try:
        with Programs() as programs:
            driver = programs.start("l2lidar_node.ros.driver_node", assigned(values))
            programs.start(
                "l2lidar_node.emulator",
                ["--ready", "--world", "pattern",
                 "--host-port", str(host_port), "--lidar-port", str(lidar_port)],
            )  # fmt: skip
            slow = programs.start(_MODULE, [])
            watch.until(
                lambda: len(watch.seen(CLOUDS)) >= 10 and watch.count_subscribers(CLOUDS) >= 2,
                programs,
                "no clouds, or no second subscriber",
            )
            return [
                _watched(watch, driver, "two reliable subscribers", lambda: None),
                _watched(
                    watch, driver, "one of them stopped 6 s",
                    lambda: _signal(slow, signal.SIGSTOP),
                ),
                _watched(
                    watch, driver, "that one killed",
                    lambda: _signal(slow, signal.SIGKILL),
                ),
            ]  # fmt: skip
    finally:
        watch.destroy_node()
        rclpy.try_shutdown()


def _signal(program: Program, number: signal.Signals) -> None:
    os.kill(program.pid, number)


def _watched(watch: TopicWatch, driver: Program, name: str, happen: Callable[[], None]) -> Finding:
    watch.forget()
    before_mb = resident_mb(driver.pid)
    happen()
    watch.watch(6.0)
    clouds, imu = watch.seen(CLOUDS), watch.seen(IMU)
    finding = Finding(name, published=len(clouds) + len(imu))
    finding.backwards = backward_steps(clouds) + backward_steps(imu)
    finding.missing = missing(imu, 1 / wire.IMU_RATE_HZ) + missing(clouds, _TURN_S)
    finding.recovery_s = float(np.diff(imu[:, 1]).max(initial=0)) / 1e9
    growth = resident_mb(driver.pid) - before_mb
    finding.remark = (
        f"longest pause of the other {finding.recovery_s * 1e3:.0f} ms, "
        f"driver grows by {growth:.1f} MB"
    )
    finding.good = finding.missing == finding.backwards == 0 and finding.published > 1000
    return finding


class _Subscriber(Node):  # type: ignore[misc]  # rclpy is used as if it had no types
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
