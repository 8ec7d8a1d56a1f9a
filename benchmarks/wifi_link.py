"""A bad link between two network namespaces, and who counts what arrives at its end.

What ``tc netem`` does in kernels that have it, for those that have not: a process that holds a TUN
device in each namespace and passes packets on in its own time (``python -m benchmarks.wifi_link
link ...``). The watch (``watch ...``) counts what arrives on a topic, and prints it as JSON.
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import itertools
import json
import math
import os
import random
import selectors
import signal
import struct
import sys
import time
from pathlib import Path
from typing import Any, Final

import rclpy
from point_cloud_interfaces.msg import CompressedPointCloud2
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray

_TUNSETIFF: Final = 0x400454CA
_IFF_TUN: Final = 0x0001
_IFF_NO_PI: Final = 0x1000
_CLONE_NEWNET: Final = 0x40000000
_LARGEST: Final = 65_536
_QUEUE_S: Final = 1.0  # of packets that wait for their turn; more are lost, as in a router


def open_tun(namespace: str, name: str) -> int:
    """Return the descriptor of a new TUN device in a namespace; this process is in it after.

    Raises
    ------
    OSError
        Without the right or the device.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    with Path("/run/netns", namespace).open("rb") as place:
        if libc.setns(place.fileno(), _CLONE_NEWNET) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), namespace)
    descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(
        descriptor, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN | _IFF_NO_PI)
    )
    return descriptor


class Direction:
    """Packets from one end to the other.

    Parameters
    ----------
    source, target : int
        Descriptors.
    rate : float
        [bit/s]
    loss : float
        Share of the packets that do not arrive.
    delay_s : float
    seed : int
    """

    def __init__(
        self, source: int, target: int, rate: float, loss: float, delay_s: float, seed: int
    ) -> None:
        self.source = source
        self._target = target
        self._rate, self._loss, self._delay_s = rate, loss, delay_s
        self._random = random.Random(seed)
        self._free_s = 0.0
        self._waiting: list[tuple[float, int, bytes]] = []
        self._count = 0

    def take(self, now: float) -> None:
        """Read what has come."""
        while True:
            try:
                packet = os.read(self.source, _LARGEST)
            except BlockingIOError:
                return
            begin = max(now, self._free_s)
            if begin - now > _QUEUE_S:
                continue
            self._free_s = begin + 8.0 * len(packet) / self._rate
            if self._random.random() < self._loss:
                continue
            self._count += 1
            heapq.heappush(self._waiting, (self._free_s + self._delay_s, self._count, packet))

    def give(self, now: float) -> float:
        """Pass on what is due; return the time to the next [s]."""
        while self._waiting and self._waiting[0][0] <= now:
            try:
                os.write(self._target, heapq.heappop(self._waiting)[2])
            except OSError:  # a full device: one packet more that is lost
                continue
        return self._waiting[0][0] - now if self._waiting else 1.0


def _run_link() -> int:
    """Run until killed: RATE LOSS DELAY_S NAMESPACE DEVICE NAMESPACE DEVICE."""
    rate, loss, delay_s = map(float, sys.argv[1:4])
    ends = [open_tun(*sys.argv[at : at + 2]) for at in (4, 6)]
    ways = [
        Direction(ends[0], ends[1], rate, loss, delay_s, 1),
        Direction(ends[1], ends[0], rate, loss, delay_s, 2),
    ]
    print("ready", flush=True)
    with selectors.DefaultSelector() as selector:
        for way in ways:
            selector.register(way.source, selectors.EVENT_READ, way)
        while True:
            now = time.monotonic()
            pause = min(way.give(now) for way in ways)
            for key, _ in selector.select(max(pause, 0.0)):
                key.data.take(time.monotonic())


_KINDS = {"cloud": PointCloud2, "zstd": CompressedPointCloud2, "packets": UInt8MultiArray}


_FIRST_S: Final = 40.0  # until the virtual L2 and the driver are at work, and found
_SMALLEST = 1044  # [B] one packet of points: before them, there is only word of waiting


def _watch() -> int:
    """Listen: TOPIC TYPE RELIABILITY SECONDS, 0 for until told to end; return the exit code."""
    topic, kind, reliability, seconds = sys.argv[1:]
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("wifi_watch")
    ages: list[float] = []
    arrivals: list[float] = []
    sizes: list[int] = []

    def hear(data: bytes) -> None:
        if len(data) < _SMALLEST:
            return
        whole, fraction = struct.unpack_from("<iI", data, 4)
        arrivals.append(time.monotonic())
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
    told: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: told.append(number))
    deadline = time.monotonic() + _FIRST_S
    while not (sizes or told) and time.monotonic() < deadline:  # it may never come
        executor.spin_once(timeout_sec=0.1)
    begun = time.monotonic()
    ending = begun + float(seconds) if float(seconds) else math.inf
    while not told and time.monotonic() < ending:
        executor.spin_once(timeout_sec=0.1)
    ended = time.monotonic()
    is_counted = [not float(seconds) or begun < arrival <= ended for arrival in arrivals]
    found: dict[str, Any] = {
        "begun_s": begun,
        "seconds": ended - begun,
        "messages": sum(is_counted),
        "bytes": sum(itertools.compress(sizes, is_counted)),
        "ages_s": list(itertools.compress(ages, is_counted)),
        "arrivals_s": list(itertools.compress(arrivals, is_counted)),
    }
    print(json.dumps(found))
    node.destroy_node()
    rclpy.shutdown()
    return 0


def main() -> int:
    """Be the link or the watch."""
    role = sys.argv.pop(1)
    return _run_link() if role == "link" else _watch()


if __name__ == "__main__":
    sys.exit(main())
