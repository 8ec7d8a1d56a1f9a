"""Measures how long after the end of a sweep the deskew node has its cloud out."""

from __future__ import annotations

import threading
import time

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu, PointCloud2

from l2lidar_node.config import ImuConfig
from l2lidar_node.demo.processes import Programs, isolate_ros
from l2lidar_node.ros.conversions import CloudTemplate, ImuTemplate, from_time
from l2lidar_node.types import POINT, HostNs, ImuSample
from tests.support.deskew_scenarios import Recording, Scenario, record

_WAIT_S = 20.0
_FIELDS = ("orientation_wxyz", "angular_velocity", "linear_acceleration")


class _Bench(Node):  # type: ignore[misc]  # rclpy has no types
    """Sends a recording in real time and notes when what comes back."""

    def __init__(self) -> None:
        super().__init__("deskew_latency")
        self._cloud = CloudTemplate(POINT, "l2lidar_link")
        self._imu = ImuTemplate("l2lidar_imu", ImuConfig())
        self.clouds = self.create_publisher(PointCloud2, "/points", QoSProfile(depth=10))
        self.samples = self.create_publisher(Imu, "/imu/data", QoSProfile(depth=200))
        self.create_subscription(PointCloud2, "points_deskewed", self._back, QoSProfile(depth=10))
        self.came: dict[int, int] = {}

    def _back(self, message: PointCloud2) -> None:
        self.came[from_time(message.header.stamp)] = time.monotonic_ns()

    def play(self, recording: Recording) -> dict[int, int]:
        """Send everything at its time; return when each sweep and its IMU samples were there."""
        origin = int(recording.samples["stamp"][0])
        begin = time.monotonic_ns()
        events = [(int(row["stamp"]), row) for row in recording.samples]
        events += [(int(item.sweep.end), item.sweep) for item in recording.sweeps]
        sent: dict[int, int] = {}
        waiting: dict[int, int] = {}
        for stamp, what in sorted(events, key=lambda event: event[0]):
            pause = (begin + stamp - origin - time.monotonic_ns()) * 1e-9
            if pause > 0:
                time.sleep(pause)
            if isinstance(what, np.void):
                q, rate, force = (tuple(what[name].tolist()) for name in _FIELDS)
                self.samples.publish(self._imu.serialize(ImuSample(HostNs(stamp), q, rate, force)))
                for start in [start for start, end in waiting.items() if stamp >= end]:
                    sent[start] = time.monotonic_ns()
                    del waiting[start]
            else:
                self.clouds.publish(self._cloud.serialize(what.points, what.start))
                waiting[int(what.start)] = int(what.end)
        return sent


def latency_ms(seconds: float = 40.0) -> float:
    """Return the 99th percentile [ms] of a run: from the last input a cloud needs to the cloud."""
    recording = record(Scenario("latency", "walk", 0.7, seconds=seconds))
    isolate_ros()
    rclpy.init()
    node = _Bench()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    with Programs() as programs:
        programs.start("l2lidar_proc.ros.deskew_node", [])
        deadline = time.monotonic() + _WAIT_S
        while not (node.clouds.get_subscription_count() and node.samples.get_subscription_count()):
            programs.check()
            if time.monotonic() > deadline:
                raise TimeoutError("the deskew node did not subscribe")
            time.sleep(0.1)
        sent = node.play(recording)
        time.sleep(0.5)
        programs.check()
    executor.shutdown()
    thread.join()
    node.destroy_node()
    rclpy.try_shutdown()
    delays = [1e-6 * (node.came[start] - at) for start, at in sent.items() if start in node.came]
    if len(delays) < 0.98 * len(sent):
        raise RuntimeError(f"{len(sent) - len(delays)} of {len(sent)} clouds did not come back")
    print(f"latency of {len(delays)} clouds: median {np.median(delays):.1f} ms")
    return float(np.quantile(delays[5:], 0.99))
