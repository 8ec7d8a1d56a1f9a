"""Starts the whole chain, and notes stamp and arrival of every message of its topics."""

from __future__ import annotations

import struct
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, PointCloud2

from l2lidar_node.demo.processes import Program, Programs, assigned, free_udp_ports
from l2lidar_node.programs import held

EMULATOR: Final = "l2lidar_node.emulator"
DRIVER: Final = "l2lidar_node.ros.driver_node"
DESKEW_NODE: Final = "l2lidar_proc.ros.deskew_node"
ODOMETRY_NODE: Final = "l2lidar_proc.ros.odometry_node"
COMPANION: Final = "l2lidar_proc.ros.companion_node"  # both in one process, as launched
SLAM: Final = "l2lidar_proc.ros.slam_node"


def start(
    programs: Programs,
    unit: Sequence[str],
    values: Mapping[str, object] | None = None,
    nodes: Sequence[str] = (DRIVER, COMPANION),
    base_frame: str | None = None,
    data_dir: str | None = None,
    folder: Path | None = None,
) -> dict[str, Program]:
    """Start the nodes that there are and then a unit; return them by name.

    Parameters
    ----------
    programs : Programs
    unit : sequence of str
        Options of the virtual L2.
    values : mapping, optional
        Parameters of the driver beside addresses and IMU.
    nodes : sequence of str
        Modules.
    base_frame : str, optional
        Of the odometry in the companion, for a sensor on a robot.
    data_dir : str, optional
        Where slam_node saves its map, if it is among the modules.
    folder : Path, optional
        Another checkout, whose nodes are to run; the unit is always this one's.
    """
    host_port, lidar_port = free_udp_ports(2)
    parameters = {
        "l2_ip": "127.0.0.1", "l2_port": lidar_port, "host_ip": "127.0.0.1",
        "host_port": host_port, "enable_IMU_publishing": "true", "imu_adjust": "false",
        **(values or {}),
    }  # fmt: skip
    arguments = {DRIVER: assigned(parameters)}
    if base_frame is not None:
        arguments[COMPANION] = assigned({"odometry_node:base_frame": base_frame})
    if data_dir is not None:
        arguments[SLAM] = assigned({"data_dir": data_dir})
    started = {
        module.rpartition(".")[2]: programs.start(module, arguments.get(module, []), folder)
        for module in nodes
        if find_spec(module)
    }
    ports = ["--host-port", str(host_port), "--lidar-port", str(lidar_port)]
    return {**started, "emulator": programs.start(EMULATOR, [*ports, *unit])}


_START_S: Final = 60.0  # until programs are at work, on a busy machine
_STAMP: Final = struct.Struct("<iI")
_ENCAPSULATION: Final = 4  # bytes before a serialized message, which begins with its stamp

CLOUDS: Final = "/points"
IMU: Final = "/imu/data"
DESKEWED: Final = "/points_deskewed"
ODOMETRY: Final = "/odometry"
_KINDS: Final = {CLOUDS: PointCloud2, IMU: Imu, DESKEWED: PointCloud2, ODOMETRY: Odometry}

_DEPTHS: Final = {IMU: 10_000}  # 40 s: what is to be seen is not what the watch itself loses


class TopicWatch(Node):  # type: ignore[misc]  # rclpy is used as if it had no types
    """Subscribes to topics and keeps what arrives, stamps and times alone.

    Parameters
    ----------
    topics : sequence of str
    reliable : bool
        Ask for reliable delivery: the publisher then has to offer it.
    name : str
        Of the node.
    """

    def __init__(
        self, topics: Sequence[str], *, reliable: bool = False, name: str = "watch"
    ) -> None:
        super().__init__(name)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self.checks: dict[str, dict[str, str]] = {}
        self._seen: dict[str, list[tuple[int, int]]] = defaultdict(list)
        policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        for topic in topics:
            self.create_subscription(
                _KINDS[topic],
                topic,
                lambda data, topic=topic: self._note(topic, data),
                QoSProfile(depth=_DEPTHS.get(topic, 500), reliability=policy),
                raw=True,
            )
        self.create_subscription(DiagnosticArray, "/diagnostics", self._diagnose, 10)

    def watch(self, seconds: float) -> None:
        """Handle what arrives for a while."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            with held():
                self._executor.spin_once(min(left, 0.1))

    def until(self, condition: Callable[[], bool], programs: Programs, otherwise: str) -> None:
        """Handle what arrives until a condition holds, while programs run.

        Raises
        ------
        TimeoutError
            With the text ``otherwise``, if that takes too long.
        ProgramError
            If one of them ends.
        """
        deadline = time.monotonic() + _START_S
        while not condition():
            self.watch(0.2)
            programs.check()
            if time.monotonic() > deadline:
                raise TimeoutError(otherwise)

    def spin_with(self, other: Node) -> None:
        """Handle what arrives at another node, too."""
        self._executor.add_node(other)

    def seen(self, topic: str) -> NDArray[np.int64]:
        """Return stamp and arrival of the messages so far [ns, host clock], shape (N, 2)."""
        return np.array(self._seen[topic], np.int64).reshape(-1, 2)

    def forget(self) -> None:
        """Forget all messages."""
        self._seen.clear()

    def _note(self, topic: str, data: bytes) -> None:
        seconds, nanoseconds = _STAMP.unpack_from(data, _ENCAPSULATION)
        self._seen[topic].append((seconds * 10**9 + nanoseconds, time.time_ns()))

    def _diagnose(self, message: Any) -> None:
        for status in message.status:
            name = status.name.rpartition(": ")[2]
            self.checks[name] = {
                "message": status.message,
                **{item.key: item.value for item in status.values},
            }


def backward_steps(seen: NDArray[np.int64]) -> int:
    """Return how many stamps are not later than the one before."""
    return int((np.diff(seen[:, 0]) <= 0).sum())


def missing(seen: NDArray[np.int64], period_s: float) -> int:
    """Return how many messages of a steady topic are missing between the first and the last."""
    steps = np.rint(np.diff(seen[:, 0]) / (period_s * 1e9)).astype(np.int64) - 1
    return int(np.maximum(steps, 0).sum())
