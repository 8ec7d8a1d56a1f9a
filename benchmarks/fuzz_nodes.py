"""Fuzzes the nodes over DDS: hostile messages, calls and parameters, then good data again.

``make fuzz-nodes`` runs it for ten minutes (``BENCH_ARGS="--seconds 3600"`` for an hour) and
writes ``out/bench/fuzz_nodes.json``. The driver, deskew and odometry run as processes of their
own. Each round sends a burst of hostile messages on all topics, calls services and sets live
parameters; then good data follow, and every node has to be alive, free of internal errors and
publishing again.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Imu, PointCloud2, PointField
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from benchmarks.results import Target, at_most, publish
from l2lidar_node.config import DriverConfig
from l2lidar_node.demo.processes import (
    ProgramError,
    Programs,
    assigned,
    free_udp_ports,
    isolate_ros,
)
from l2lidar_node.ros.conversions import to_cloud, to_time
from l2lidar_node.settings import Setting, settings_of
from l2lidar_node.types import HostNs
from l2lidar_proc.config import DeskewNodeConfig, OdometryNodeConfig
from tests.support.cpu import resident_mb
from tests.support.odometry_runs import Run, record, sweeps

NODES: Final = {
    "l2lidar_node": DriverConfig,
    "deskew_node": DeskewNodeConfig,
    "odometry_node": OdometryNodeConfig,
}
_MODULES: Final = {
    "l2lidar_node": "l2lidar_node.ros.driver_node",
    "deskew_node": "l2lidar_proc.ros.deskew_node",
    "odometry_node": "l2lidar_proc.ros.odometry_node",
}
_FRAME, _IMU_FRAME = "l2lidar_link", "l2lidar_imu"
_TIMEOUT_S: Final = 60.0  # for good data to come through; beyond that a node is stuck
_TARGET_S: Final = 1.0
_YEAR_S: Final = 365 * 86_400
_NUMBERS: Final = (
    0.0, -0.0, 1.0, -1.0, 1e-300, 1e30, -1e30, 1.7e308, math.nan, math.inf, -math.inf,
)  # fmt: skip
_TEXTS: Final = ("", ".", "..", "/", "/etc/passwd", "a/b", "~/x", "\N{SNOWMAN}", "x" * 300, "\n")
_KINDS: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


class Fuzzer:
    """A participant that sends anything to anybody, and good data in between.

    Parameters
    ----------
    seed : int
    """

    def __init__(self, seed: int) -> None:
        self.node: Node = rclpy.create_node("fuzzer")
        self.rng = random.Random(seed)
        self.sent = 0
        self.errors: list[str] = []
        self.heard = dict.fromkeys(NODES, 0)
        self.latest_s = dict.fromkeys(NODES, 0.0)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.clouds = self.node.create_publisher(PointCloud2, "/fuzz/points", 100)
        self.imu = self.node.create_publisher(Imu, "/fuzz/imu", 2000)
        self.velocity = self.node.create_publisher(Odometry, "/fuzz/velocity", 10)
        self.tf = self.node.create_publisher(TFMessage, "/tf_static", latched)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnosed, 100)
        self.node.create_subscription(PointCloud2, "points_deskewed", self._by("deskew_node"), 100)
        self.node.create_subscription(Odometry, "odometry", self._by("odometry_node"), 100)
        self._parameters = {
            name: self.node.create_client(SetParameters, f"/{name}/set_parameters")
            for name in NODES
        }
        self._triggers = [
            self.node.create_client(Trigger, name)
            for name in (
                "/l2lidar_node/reset",
                "/odometry_node/reset",
                "/odometry_node/save_map",
                "/odometry_node/save_trajectory",
            )
        ]
        self._enable = self.node.create_client(SetBool, "/l2lidar_node/enable")
        self._live = {
            name: [item for item in settings_of(group) if item.live]
            for name, group in NODES.items()
        }

    @property
    def clients_ready(self) -> bool:
        """Whether every service is there."""
        clients = [*self._parameters.values(), *self._triggers, self._enable]
        return all(client.service_is_ready() for client in clients)

    def _by(self, name: str) -> Callable[[Any], None]:
        def heard(message: Any) -> None:
            del message
            self.heard[name] += 1
            self.latest_s[name] = time.monotonic()

        return heard

    def _diagnosed(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.partition(":")[0]
            if name == "l2lidar_node":
                self._by(name)(message)
            if "internal error" in status.message:
                self.errors.append(f"{status.name}: {status.message}"[:300])

    # ---- hostile

    def attack(self) -> None:
        """Send, call or set one thing."""
        kinds = (self._cloud, self._cloud, self._sample, self._sample, self._mounts,
                 self._speed, self._raw, self._call, self._set)  # fmt: skip
        self.rng.choice(kinds)()
        self.sent += 1

    def _number(self) -> float:
        rng = self.rng
        return rng.choice((rng.choice(_NUMBERS), rng.gauss(0.0, 10.0), rng.uniform(-1e6, 1e6)))

    def _stamp(self, header: Any) -> None:
        """Set a stamp: about now, years off, at the ends of time, not normalized."""
        rng = self.rng
        now = time.time() + rng.choice((0.0, 0.0, rng.gauss(0.0, 1.0), rng.gauss(0.0, 1e4),
                                        rng.uniform(-60.0, 60.0) * _YEAR_S))  # fmt: skip
        ends = (-(2**31), -1, 0, 2**31 - 1)
        seconds = rng.choice((int(now), int(now), int(now), rng.choice(ends)))
        header.stamp.sec = min(max(seconds, -(2**31)), 2**31 - 1)
        header.stamp.nanosec = rng.choice((0, rng.randrange(10**9), 2**32 - 1))

    def _frame(self) -> str:
        frames = (_FRAME, _FRAME, _IMU_FRAME, "odom", *_TEXTS)
        return self.rng.choice(frames)

    def _cloud(self) -> None:
        rng = self.rng
        names = rng.choice((
            ["x", "y", "z", "time"], ["x", "y", "z", "intensity", "t"], ["range", "azimuth"],
            ["x", "y", "z", "timestamp"], ["x", "y", "time"], ["x", "y", "z", "time", "t"],
            ["x", "y", "z"], [rng.choice(_TEXTS), "x"], [],
        ))  # fmt: skip
        message = PointCloud2()
        message.header.frame_id = self._frame()
        self._stamp(message.header)
        count = rng.choice((0, 1, 2, 100, 5000))
        offset, kinds = 0, []
        for name in names:
            number = rng.choice((7, 7, 7, 8, rng.choice((1, 2, 3, 4, 5, 6, 99))))
            message.fields.append(PointField(name=name, offset=offset, datatype=number, count=1))
            kinds.append(_KINDS.get(number, "u4"))
            offset += np.dtype(kinds[-1]).itemsize
        if names and offset:
            message.data = self._points(names, kinds, count).tobytes()
        message.point_step = rng.choice((offset, offset, offset, 0, 2**32 - 1))
        message.width = rng.choice((count, count, count, 2**31))
        message.height = rng.choice((1, 1, 1, 0, 2**31))
        message.row_step = rng.choice((offset * count, offset * count, 0, 2**32 - 1))
        message.is_bigendian = rng.random() < 0.1
        self.clouds.publish(message)

    def _points(self, names: list[str], kinds: list[str], count: int) -> NDArray[np.void]:
        rng = np.random.default_rng(self.rng.randrange(2**32))
        layout = [(f"{number}", kind) for number, kind in enumerate(kinds)]
        points = np.zeros(count, dtype=layout)
        with np.errstate(all="ignore"):
            for number, name in enumerate(names):
                if name in ("time", "t", "timestamp"):
                    length = self.rng.choice((0.0, 0.2, 20.0, 90.0, 1e9, -1.0))
                    values = np.linspace(0.0, length, count)
                else:
                    values = rng.normal(0.0, self.rng.choice((0.0, 5.0, 5.0, 1e8)), count)
                if count and self.rng.random() < 0.3:
                    values[rng.integers(count)] = self._number()
                points[f"{number}"] = values.astype(kinds[number])
        return points

    def _sample(self) -> None:
        message = Imu()
        message.header.frame_id = self.rng.choice((_IMU_FRAME, _IMU_FRAME, self._frame()))
        self._stamp(message.header)
        for vector in (message.angular_velocity, message.linear_acceleration):
            vector.x, vector.y, vector.z = (self._number() for _ in "xyz")
        message.orientation.w = self._number()
        self.imu.publish(message)

    def _mounts(self) -> None:
        message = TFMessage()
        for _ in range(self.rng.choice((0, 1, 1, 3))):
            item = TransformStamped(child_frame_id=self._frame())
            item.header.frame_id = self._frame()
            q, p = item.transform.rotation, item.transform.translation
            q.w = self.rng.choice((1.0, self._number()))
            q.x, p.x, p.y, p.z = (self.rng.choice((0.0, self._number())) for _ in range(4))
            message.transforms.append(item)
        self.tf.publish(message)

    def _speed(self) -> None:
        message = Odometry(child_frame_id=self._frame())
        self._stamp(message.header)
        twist = message.twist.twist
        twist.linear.x, twist.linear.y, twist.angular.z = (self._number() for _ in range(3))
        self.velocity.publish(message)

    def _raw(self) -> None:
        """Send bytes that are no message."""
        data = self.rng.randbytes(self.rng.choice((0, 4, 40, 400)))
        self.rng.choice((self.clouds, self.imu, self.tf, self.velocity)).publish(
            b"\0\1\0\0" + data
        )

    def _call(self) -> None:
        if self.rng.random() < 0.3:
            self._enable.call_async(SetBool.Request(data=self.rng.random() < 0.5))
        else:
            self.rng.choice(self._triggers).call_async(Trigger.Request())

    def _set(self) -> None:
        name = self.rng.choice(list(NODES))
        item = self.rng.choice(self._live[name])
        value = self.rng.choice((item.default, self._within(item), self._any()))
        self._send_parameters(name, [Parameter(item.name, value=value)])

    def _within(self, item: Setting) -> Any:
        rng = self.rng
        if item.choices and item.item is None:
            return rng.choice(item.choices)
        if item.type in (int, float) and item.lo is not None and item.hi is not None:
            return item.type(rng.choice((item.lo, item.hi, rng.uniform(item.lo, item.hi))))
        return not item.default if item.type is bool else item.default

    def _any(self) -> Any:
        rng = self.rng
        return rng.choice((
            rng.choice(_TEXTS), self._number(), rng.randrange(-(2**63), 2**63), True,
            [self._number()], [rng.choice(_TEXTS)],
        ))  # fmt: skip

    def _send_parameters(self, name: str, parameters: list[Parameter[Any]]) -> None:
        request = SetParameters.Request()
        request.parameters = [item.to_parameter_msg() for item in parameters]
        self._parameters[name].call_async(request)

    # ---- good

    def restore(self) -> None:
        """Set every live parameter to its default, mounts as they are, and start the unit."""
        for name, items in self._live.items():
            values = [
                Parameter(item.name, value=list(item.default))
                if isinstance(item.default, tuple)
                else Parameter(item.name, value=item.default)
                for item in items
                if item.default != ()
            ]
            self._send_parameters(name, values)
        item = TransformStamped(child_frame_id=_IMU_FRAME)
        item.header.frame_id = _FRAME
        item.transform.rotation.w = 1.0
        self.tf.publish(TFMessage(transforms=[item]))
        self._enable.call_async(SetBool.Request(data=True))

    def give(self, run: Run, number: int, first: int, shift: int) -> int:
        """Publish a good sweep after the samples that cover it; return the next sample."""
        sweep = list(sweeps(run, "turn"))[number]
        last = int(np.searchsorted(run.imu["stamp"], sweep.end)) + 1
        for sample in run.imu[first:last]:
            message = Imu()
            message.header.stamp = to_time(HostNs(int(sample["stamp"]) + shift))
            message.header.frame_id = _IMU_FRAME
            rate, force = message.angular_velocity, message.linear_acceleration
            rate.x, rate.y, rate.z = sample["angular_velocity"].tolist()
            force.x, force.y, force.z = sample["linear_acceleration"].tolist()
            self.imu.publish(message)
        self.clouds.publish(to_cloud(sweep.points, HostNs(sweep.start + shift), _FRAME))
        return last


def start(programs: Programs, folder: Path) -> dict[str, int]:
    """Start a virtual L2 and the nodes; return their process numbers by name."""
    host, lidar = free_udp_ports(2)
    programs.start(
        "l2lidar_node.emulator",
        ["--host-port", str(host), "--lidar-port", str(lidar), "--world", "pattern"],
    )
    inputs = {"cloud_topic": "/fuzz/points", "imu_topic": "/fuzz/imu"}
    values: dict[str, dict[str, object]] = {
        "l2lidar_node": {
            "l2_ip": "127.0.0.1", "host_ip": "127.0.0.1", "l2_port": lidar, "host_port": host,
            "watchdog_action": "wait", "enable_IMU_publishing": True,
        },
        "deskew_node": {**inputs, "velocity_topic": "/fuzz/velocity"},
        "odometry_node": {**inputs, "data_dir": str(folder)},
    }  # fmt: skip
    return {name: programs.start(_MODULES[name], assigned(values[name])).pid for name in NODES}


class Campaign:
    """Rounds of hostile bursts and good data.

    Parameters
    ----------
    fuzzer : Fuzzer
    programs : Programs
    run : Run
        The good data.
    """

    def __init__(self, fuzzer: Fuzzer, programs: Programs, run: Run) -> None:
        self.fuzzer = fuzzer
        self.back_s: dict[str, list[float]] = {name: [] for name in NODES}
        self.calm_s: dict[str, list[float]] = {name: [] for name in NODES}
        self.stuck: list[str] = []
        self.rounds = 0
        self._programs = programs
        self._run = run
        self._count = len(list(sweeps(run, "turn")))

    def spin(self, seconds: float) -> None:
        """Let messages come for a while; raise ProgramError if a program has ended."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            rclpy.spin_once(self.fuzzer.node, timeout_sec=min(left, 0.02))
        self._programs.check()

    def round(self, attacks: int) -> None:
        """Attack, restore, and give good data until every node has published."""
        for _ in range(attacks):
            self.fuzzer.attack()
            self.spin(self.fuzzer.rng.choice((0.0, 0.0, 0.01)))
        self.spin(0.5)  # what is under way arrives
        self.fuzzer.restore()
        self.spin(0.5)
        self.rounds += 1
        waiting = self._good_data(self.back_s if attacks else self.calm_s)
        self.stuck += [f"{name} in round {self.rounds}" for name in waiting]

    def _good_data(self, after_s: dict[str, list[float]]) -> set[str]:
        """Publish good data in real time; return who has not published in time."""
        began = time.monotonic()
        before = dict(self.fuzzer.heard)
        waiting = set(NODES)
        shift = time.time_ns() - int(self._run.imu["stamp"][0])
        number = first = 0
        while waiting and time.monotonic() - began < _TIMEOUT_S:
            if number == self._count:  # from the beginning, later
                number = first = 0
                shift = time.time_ns() - int(self._run.imu["stamp"][0])
            first = self.fuzzer.give(self._run, number, first, shift)
            number += 1
            self.spin(0.2)
            for name in [name for name in waiting if self.fuzzer.heard[name] > before[name]]:
                waiting.discard(name)
                after_s[name].append(self.fuzzer.latest_s[name] - began)
        return waiting


def fuzz(seconds: float, seed: int, attacks: int) -> tuple[Campaign, dict[str, float], str]:
    """Run rounds for a time; return them, growth by node [MB], and what a node ended with."""
    isolate_ros()
    run = record("room", "walk", 1, 6.0)
    rclpy.init()
    fuzzer = Fuzzer(seed)
    ended = ""
    growth: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder, Programs() as programs:
        campaign = Campaign(fuzzer, programs, run)
        try:
            pids = start(programs, Path(folder))
            while not fuzzer.clients_ready:
                campaign.spin(0.1)
            campaign.round(0)
            base: dict[str, float] = {}
            deadline = time.monotonic() + seconds
            while time.monotonic() < deadline or campaign.rounds < 3:
                campaign.round(attacks)
                if campaign.rounds % 4 == 0:
                    campaign.round(0)
                if not base and (campaign.rounds > 5 or time.monotonic() > deadline):
                    base = {name: resident_mb(pid) for name, pid in pids.items()}
            growth = {name: resident_mb(pid) - base[name] for name, pid in pids.items()}
        except ProgramError as error:
            ended = str(error)
    fuzzer.node.destroy_node()
    rclpy.shutdown()
    return campaign, growth, ended


def main(arguments: Sequence[str] | None = None) -> int:
    """Run it; return 1 for any finding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--attacks", type=int, default=200, help="per round")
    options = parser.parse_args(arguments)
    campaign, growth, ended = fuzz(options.seconds, options.seed, options.attacks)
    if ended:
        print(ended, file=sys.stderr)
    rows: list[dict[str, Any]] = []
    targets: list[Target] = [
        at_most("nodes that ended", int(bool(ended)), 0),
        at_most("nodes that were stuck", len(campaign.stuck), 0),
        at_most("internal errors", len(campaign.fuzzer.errors), 0),
    ]
    for name, times in campaign.back_s.items():
        rows.append({
            "node": name, "rounds": campaign.rounds, "hostile messages": campaign.fuzzer.sent,
            "publishing after s, median": round(float(np.median(times or [0.0])), 2),
            "worst": round(max(times, default=0.0), 2),
            "calm rounds, worst": round(max(campaign.calm_s[name], default=0.0), 2),
            "growth [MB]": round(growth.get(name, 0.0), 1),
        })  # fmt: skip
        # a busy machine takes its time without anybody's hostility
        late = max(times, default=_TIMEOUT_S) - max(campaign.calm_s[name], default=0.0)
        targets.append(at_most(f"{name}: later than in calm rounds, s", late, _TARGET_S))
    for text in sorted(set(campaign.fuzzer.errors + campaign.stuck)):
        print(text, file=sys.stderr)
    publish("fuzz_nodes", "Hostile neighbors", rows, targets)
    return int(bool(ended or campaign.stuck or campaign.fuzzer.errors))


if __name__ == "__main__":
    sys.exit(main())
