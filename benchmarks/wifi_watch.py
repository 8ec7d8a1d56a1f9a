"""Counts what arrives on a topic for a while, in a network namespace of its own; prints JSON."""

from __future__ import annotations

import json
import struct
import sys
import time
from typing import Any

import rclpy
from point_cloud_interfaces.msg import CompressedPointCloud2
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray

_KINDS = {"cloud": PointCloud2, "zstd": CompressedPointCloud2, "packets": UInt8MultiArray}


_FIRST_S = 60.0  # until the virtual L2 and the driver are at work, and found
_SMALLEST = 1044  # [B] one packet of points: before them, there is only word of waiting


def main() -> int:
    """Listen: TOPIC TYPE RELIABILITY SECONDS; return the exit code."""
    topic, kind, reliability, seconds = sys.argv[1:]
    rclpy.init(args=[])
    node = rclpy.create_node("wifi_watch")
    ages: list[float] = []
    sizes: list[int] = []

    def hear(data: bytes) -> None:
        if len(data) < _SMALLEST:
            return
        whole, fraction = struct.unpack_from("<iI", data, 4)
        ages.append(time.time() - whole - fraction * 1e-9)
        sizes.append(len(data))

    reliable = reliability == "reliable"
    node.create_subscription(
        _KINDS[kind],
        topic,
        hear,
        QoSProfile(
            depth=20,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.VOLATILE,
        ),
        raw=True,
    )
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    deadline = time.monotonic() + _FIRST_S
    while not sizes and time.monotonic() < deadline:  # over a bad link it may never come
        executor.spin_once(timeout_sec=0.1)
    ages.clear()
    sizes.clear()
    begun = time.monotonic()
    while time.monotonic() < begun + float(seconds):
        executor.spin_once(timeout_sec=0.1)
    found: dict[str, Any] = {
        "seconds": time.monotonic() - begun,
        "messages": len(sizes),
        "bytes": sum(sizes),
        "ages_s": ages,
    }
    print(json.dumps(found))
    node.destroy_node()
    rclpy.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
