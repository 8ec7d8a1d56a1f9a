"""Fuzzes the nodes over DDS: hostile messages, calls and parameters, then good data again.

``make fuzz-nodes`` runs it for ten minutes (``BENCH_ARGS="--seconds 3600"`` for an hour) and
writes ``out/bench/fuzz_nodes.json``. Driver, deskew, odometry and SLAM run as processes of their
own, and deskew and odometry once more together in the companion. Each round sends a burst of
hostile messages on all topics, calls services, asks for transitions of the life cycle and sets
live parameters; then everything is set right and good data follow, and every node has to be
alive, free of internal errors and publishing again.

In every fourth round nobody is hostile: all nodes are reset and taken through their life cycle,
then good data follow. What a node needs there, it needs in any case.

How soon a node publishes again is told in two ways. *Data* is how much of the good data has passed
when the first publication is about it, by its stamp: a busy machine does not change that, a node
that cannot use the data does. It may be a second more than in calm rounds. *Wall* is the time by
the clock. How much processor time other programs took meanwhile is measured: on an idle machine
the wall time has to keep the same bound. On any machine three minutes without a publication count
as stuck.
"""

from __future__ import annotations

import argparse
import os
import random
import struct
import sys
import tempfile
import time
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import Imu, PointCloud2
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from benchmarks.fuzz_messages import CLOUD_FRAME, IMU_FRAME, TEXTS, HostileMessages
from benchmarks.results import Target, at_most, publish
from l2lidar_node.config import DriverConfig
from l2lidar_node.demo.processes import (
    ProgramError,
    Programs,
    assigned,
    free_udp_ports,
    isolate_ros,
)
from l2lidar_node.programs import held
from l2lidar_node.ros.conversions import to_cloud, to_time
from l2lidar_node.settings import Setting, settings_of
from l2lidar_node.types import HostNs
from l2lidar_proc.deskew.config import DeskewNodeConfig
from l2lidar_proc.odometry.config import OdometryNodeConfig
from l2lidar_proc.slam.config import SlamNodeConfig
from tests.support.cpu import ForeignLoad, resident_mb
from tests.support.odometry_runs import Run, record, sweeps

_SETTINGS: Final[dict[str, type]] = {
    "l2lidar_node": DriverConfig,
    "deskew_node": DeskewNodeConfig,
    "odometry_node": OdometryNodeConfig,
    "slam_node": SlamNodeConfig,
    "together/deskew_node": DeskewNodeConfig,
    "together/odometry_node": OdometryNodeConfig,
}
NODES: Final = tuple(_SETTINGS)
_OUTPUTS: Final[dict[str, tuple[type, str]]] = {
    "l2lidar_node": (Imu, "/imu/data"),
    "deskew_node": (PointCloud2, "/points_deskewed"),
    "odometry_node": (Odometry, "/odometry"),
    "slam_node": (PoseWithCovarianceStamped, "/pose"),
    "together/deskew_node": (PointCloud2, "/together/points_deskewed"),
    "together/odometry_node": (Odometry, "/together/odometry"),
}
_TRIGGERS: Final = {
    "l2lidar_node": ("reset",),
    "odometry_node": ("reset", "save_map", "save_trajectory"),
    "slam_node": ("reset", "save", "load", "relocalize"),
    "together/odometry_node": ("reset", "save_map", "save_trajectory"),
}
# What the odometry says to the SLAM node, passed on so that others can be told apart from it.
_PASSED_ON: Final[dict[str, type]] = {
    "odometry": Odometry,
    "deskewed_points": PointCloud2,
    "odometry_status": DiagnosticArray,
}
# A node that is shut down ends; who may ask for that is a matter of the domain (docs/security.md).
_ENDINGS: Final = frozenset(
    (
        Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
        Transition.TRANSITION_INACTIVE_SHUTDOWN,
        Transition.TRANSITION_ACTIVE_SHUTDOWN,
        Transition.TRANSITION_DESTROY,
    )
)
_TO_INACTIVE: Final = (Transition.TRANSITION_DEACTIVATE,)
_TO_UNCONFIGURED: Final = (*_TO_INACTIVE, Transition.TRANSITION_CLEANUP)
_TO_ACTIVE: Final = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)

_TIMEOUT_S: Final = 180.0  # for good data to come through; beyond that a node is stuck
_ANSWER_S: Final = 10.0
_TARGET_S: Final = 1.0
# After hostility: what is under way arrives, and clouds that cannot be told from the sensor's own,
# being stamped about now, are no longer within the second that sweeps are held together for.
_QUIET_S: Final = 1.5
_SWEEP_S: Final = 0.2  # a turn of the head, about
_IDLE: Final = 0.1  # of the machine that others may use while it counts as idle
_CALM_EVERY: Final = 4
_RUN_S: Final = 6.0  # of good data; they are repeated
_EARLY_NS: Final = 50_000_000  # a cloud begins with its first point, before its first IMU sample
_STAMP: Final = struct.Struct("<iI")
_STAMP_AT: Final = 4  # of a serialized message that begins with a header


class Back(NamedTuple):
    """When a node published again.

    Attributes
    ----------
    wall_s : float
        By the clock, since the good data began.
    data_s : float
        How much good data there was before what it published about.
    """

    wall_s: float
    data_s: float


_NEVER: Final = Back(0.0, 0.0)


class GoodData:
    """When good data began, and the stamps of the sweeps that were given.

    Attributes
    ----------
    began_s : float
        By the monotonic clock.
    began_ns : int
        By the host's clock.
    """

    def __init__(self) -> None:
        self.began_s = time.monotonic()
        self.began_ns = time.time_ns()
        self._starts: list[int] = []

    def given(self, start: int) -> None:
        """Take note of a sweep, by its first instant [ns]."""
        self._starts.append(start)

    def before(self, stamp: int, name: str) -> float | None:
        """Return how much good data there was before a stamp [s]; None if it is older.

        The driver's come from the unit, in real time; those of the others are the sweeps.
        """
        if stamp < self.began_ns - _EARLY_NS:
            return None
        if name == "l2lidar_node":
            return (stamp - self.began_ns) * 1e-9
        number = bisect_right(self._starts, stamp + _EARLY_NS) - 1
        return None if number < 0 else number * _SWEEP_S


class Fuzzer:
    """A participant that sends anything to anybody, and good data in between.

    Parameters
    ----------
    seed : int
    """

    def __init__(self, seed: int) -> None:
        self.node: Node = rclpy.create_node("fuzzer")
        self.rng = random.Random(seed)
        self.hostile = HostileMessages(self.rng)
        self.sent = 0
        self.errors: list[str] = []
        self.said: dict[str, str] = {}  # the latest diagnostics of a node, by its name
        self.good: GoodData | None = None
        self.back: dict[str, Back] = {}
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        create = self.node.create_publisher
        self.clouds = create(PointCloud2, "/fuzz/points", 100)
        self.imu = create(Imu, "/fuzz/imu", 2000)
        self.velocity = create(Odometry, "/fuzz/velocity", 10)
        self.tf_static = create(TFMessage, "/tf_static", latched)
        self._tf = create(TFMessage, "/tf", 10)
        self._initial_pose = create(PoseWithCovarianceStamped, "/initialpose", 10)
        self._to_slam = {
            name: create(kind, f"/fuzz/{name}", 100) for name, kind in _PASSED_ON.items()
        }
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnosed, 100)
        listening = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
        for name, (kind, topic) in _OUTPUTS.items():
            self.node.create_subscription(kind, topic, self._by(name), listening, raw=True)
        for name, kind in _PASSED_ON.items():
            pass_on = self._to_slam[name].publish
            self.node.create_subscription(kind, name, pass_on, listening, raw=True)
        client = self.node.create_client
        self._parameters = {name: client(SetParameters, f"/{name}/set_parameters")
                            for name in NODES}  # fmt: skip
        self._states = {name: client(ChangeState, f"/{name}/change_state") for name in NODES}
        self._triggers = {
            (name, what): client(Trigger, f"/{name}/{what}")
            for name, whats in _TRIGGERS.items()
            for what in whats
        }
        self._enable = client(SetBool, "/l2lidar_node/enable")
        self._live = {
            name: [item for item in settings_of(group) if item.live]
            for name, group in _SETTINGS.items()
        }

    @property
    def clients_ready(self) -> bool:
        """Whether every service is there."""
        clients: list[Client] = [
            *self._parameters.values(), *self._triggers.values(), *self._states.values(),
            self._enable,
        ]  # fmt: skip
        return all(client.service_is_ready() for client in clients)

    def _by(self, name: str) -> Callable[[Any], None]:
        def heard(message: bytes) -> None:
            if self.good is None or name in self.back:
                return
            seconds, nanoseconds = _STAMP.unpack_from(message, _STAMP_AT)
            data_s = self.good.before(seconds * 1_000_000_000 + nanoseconds, name)
            if data_s is not None:
                self.back[name] = Back(time.monotonic() - self.good.began_s, data_s)

        return heard

    def begin_good_data(self) -> GoodData:
        """Forget who has published; return what the good data are to be noted in."""
        self.good = GoodData()
        self.back.clear()
        return self.good

    def _diagnosed(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.said[status.name.partition(":")[0]] = status.message[:300]
        self.errors += [
            f"{status.name}: {status.message}"[:300]
            for status in message.status
            if "internal error" in status.message
        ]

    # ---- hostile

    def attack(self) -> None:
        """Send, call or set one thing."""
        kinds = (self._cloud, self._cloud, self._sample, self._sample, self._mounts, self._speed,
                 self._slam, self._raw, self._call, self._transition, self._set)  # fmt: skip
        self.rng.choice(kinds)()
        self.sent += 1

    def _cloud(self) -> None:
        self.clouds.publish(self.hostile.cloud())

    def _sample(self) -> None:
        self.imu.publish(self.hostile.sample())

    def _mounts(self) -> None:
        self.rng.choice((self.tf_static, self._tf)).publish(self.hostile.transforms())

    def _speed(self) -> None:
        self.velocity.publish(self.hostile.odometry())

    def _slam(self) -> None:
        """Send the SLAM node parts of a sweep, often of one stamp, or a place in the map."""
        if self.rng.random() < 0.2:
            self._initial_pose.publish(self.hostile.initial_pose())
            return
        odometry = self.hostile.odometry()
        parts = {
            "odometry": odometry,
            "deskewed_points": self.hostile.cloud(),
            "odometry_status": self.hostile.status(),
        }
        for name, message in parts.items():
            if self.rng.random() < 0.7:
                message.header.stamp = odometry.header.stamp
            if self.rng.random() < 0.8:
                self._to_slam[name].publish(message)

    def _raw(self) -> None:
        publishers = (self.clouds, self.imu, self.tf_static, self._tf, self.velocity,
                      self._initial_pose, *self._to_slam.values())  # fmt: skip
        self.rng.choice(publishers).publish(self.hostile.raw())

    def _call(self) -> None:
        if self.rng.random() < 0.3:
            self._enable.call_async(SetBool.Request(data=self.rng.random() < 0.5))
        else:
            self.rng.choice(list(self._triggers.values())).call_async(Trigger.Request())

    def _transition(self) -> None:
        known = (*_TO_UNCONFIGURED, *_TO_ACTIVE)
        number = self.rng.choice((*known, *known, self.rng.randrange(256)))
        if number in _ENDINGS:
            return
        request = ChangeState.Request(transition=Transition(id=number))
        if self.rng.random() < 0.2:
            request.transition.label = self.rng.choice(("configure", "activate", *TEXTS))
        self.rng.choice(list(self._states.values())).call_async(request)

    def _set(self) -> None:
        name = self.rng.choice([name for name in NODES if self._live[name]])
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
        rng, number = self.rng, self.hostile.number
        return rng.choice((
            rng.choice(TEXTS), number(), rng.randrange(-(2**63), 2**63), True,
            [number()], [rng.choice(TEXTS)],
        ))  # fmt: skip

    def _send_parameters(self, name: str, parameters: list[Parameter[Any]]) -> Future:
        request = SetParameters.Request()
        request.parameters = [item.to_parameter_msg() for item in parameters]
        return self._parameters[name].call_async(request)

    # ---- good

    def restore(self) -> list[Future]:
        """Activate every node, set every live parameter to its default, start the unit.

        The SLAM node begins a new map: somebody may have had it load another one and search it,
        and while it searches it rightly publishes no pose.
        """
        answers = []
        for name, items in self._live.items():
            answers += self.transitions(name, _TO_ACTIVE)
            values = [
                Parameter(item.name, value=list(item.default))
                if isinstance(item.default, tuple)
                else Parameter(item.name, value=item.default)
                for item in items
                if item.default != ()
            ]
            answers.append(self._send_parameters(name, values))
        answers.append(self._triggers["slam_node", "reset"].call_async(Trigger.Request()))
        item = TransformStamped(child_frame_id=IMU_FRAME)
        item.header.frame_id = CLOUD_FRAME
        item.transform.rotation.w = 1.0
        self.tf_static.publish(TFMessage(transforms=[item]))
        answers.append(self._enable.call_async(SetBool.Request(data=True)))
        return answers

    def reset(self) -> list[Future]:
        """Call every reset and take every node down; :meth:`restore` takes it up again."""
        answers = [
            client.call_async(Trigger.Request())
            for (_, what), client in self._triggers.items()
            if what == "reset"
        ]
        for name in NODES:
            answers += self.transitions(name, _TO_UNCONFIGURED)
        return answers

    def transitions(self, name: str, numbers: Sequence[int]) -> list[Future]:
        """Ask a node for transitions, one after the other; impossible ones it refuses."""
        return [
            self._states[name].call_async(ChangeState.Request(transition=Transition(id=number)))
            for number in numbers
        ]

    def give(self, run: Run, number: int, first: int, shift: int) -> int:
        """Publish a good sweep after the samples that cover it; return the next sample."""
        sweep = list(sweeps(run, "turn"))[number]
        last = int(np.searchsorted(run.imu["stamp"], sweep.end)) + 1
        for sample in run.imu[first:last]:
            message = Imu()
            message.header.stamp = to_time(HostNs(int(sample["stamp"]) + shift))
            message.header.frame_id = IMU_FRAME
            rate, force = message.angular_velocity, message.linear_acceleration
            rate.x, rate.y, rate.z = sample["angular_velocity"].tolist()
            force.x, force.y, force.z = sample["linear_acceleration"].tolist()
            self.imu.publish(message)
        if self.good is not None:
            self.good.given(sweep.start + shift)
        self.clouds.publish(to_cloud(sweep.points, HostNs(sweep.start + shift), CLOUD_FRAME))
        return last


def start(programs: Programs, folder: Path) -> dict[str, int]:
    """Start a virtual L2 and the programs; return their process numbers by name."""
    host, lidar = free_udp_ports(2)
    programs.start(
        "l2lidar_node.emulator",
        ["--host-port", str(host), "--lidar-port", str(lidar), "--world", "pattern",
         "--boot-scale", "0.1"],
    )  # fmt: skip
    inputs = {"cloud_topic": "/fuzz/points", "imu_topic": "/fuzz/imu"}
    files = {name: str(folder / name) for name in ("odometry", "slam", "together")}
    velocity = {"velocity_topic": "/fuzz/velocity"}
    values: dict[str, tuple[str, dict[str, object]]] = {
        "l2lidar_node": ("l2lidar_node.ros.driver_node", {
            "l2_ip": "127.0.0.1", "host_ip": "127.0.0.1", "l2_port": lidar, "host_port": host,
            "watchdog_action": "wait", "enable_IMU_publishing": True,
        }),
        "deskew_node": ("l2lidar_proc.ros.deskew_node", {**inputs, **velocity}),
        "odometry_node": ("l2lidar_proc.ros.odometry_node",
                          {**inputs, "data_dir": files["odometry"]}),
        "slam_node": ("l2lidar_proc.ros.slam_node", {
            "data_dir": files["slam"],
            **{f"{name}_topic": f"/fuzz/{topic}" for name, topic in (
                ("odometry", "odometry"), ("cloud", "deskewed_points"),
                ("odometry_status", "odometry_status"),
            )},
        }),
        "companion_node": ("l2lidar_proc.ros.companion_node",
                           {**inputs, **velocity, "data_dir": files["together"]}),
    }  # fmt: skip
    pids = {}
    for name, (module, parameters) in values.items():
        arguments = assigned(parameters)
        if name == "companion_node":
            arguments += ["-r", "__ns:=/together"]
        pids[name] = programs.start(module, arguments).pid
    return pids


@dataclass
class Campaign:
    """Rounds of hostile bursts and good data.

    Attributes
    ----------
    back, calm : dict
        By node: when it published after the first good data, in every round after hostility and
        in every calm one.
    stuck : list of str
        Who did not publish in time, and in which round.
    unanswered : int
        Calls that set nodes right and got no answer in time.
    """

    fuzzer: Fuzzer
    programs: Programs
    run: Run
    back: dict[str, list[Back]] = field(default_factory=lambda: {n: [] for n in NODES})
    calm: dict[str, list[Back]] = field(default_factory=lambda: {n: [] for n in NODES})
    stuck: list[str] = field(default_factory=list)
    rounds: int = 0
    unanswered: int = 0

    def spin(self, seconds: float) -> None:
        """Let messages come for a while; raise ProgramError if a program has ended."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            with held():
                rclpy.spin_once(self.fuzzer.node, timeout_sec=min(left, 0.02))
        self.programs.check()

    def round(self, attacks: int) -> None:
        """Attack, or reset all if ``attacks`` is 0, set all right, and give good data."""
        self.rounds += 1
        for _ in range(attacks):
            self.fuzzer.attack()
            self.spin(self.fuzzer.rng.choice((0.0, 0.0, 0.01)))
        self.spin(_QUIET_S)
        if not attacks:
            self._await(self.fuzzer.reset())
        deadline = time.monotonic() + _TIMEOUT_S
        while not self._await(self.fuzzer.restore()) and time.monotonic() < deadline:
            pass  # a starved node has not done it yet; what is set twice does no harm
        self.spin(0.5)  # so that DDS has found what is new
        waiting = self._good_data(self.back if attacks else self.calm)
        self.stuck += [
            f"{name} does not publish in round {self.rounds}: {self.fuzzer.said.get(name, '')!r}"
            for name in waiting
        ]

    def _await(self, answers: list[Future]) -> bool:
        """Wait until all services have answered; return whether they have in time.

        DDS loses answers when their receiver is busy; whether a node is stuck, good data show.
        """
        deadline = time.monotonic() + _ANSWER_S
        while not all(answer.done() for answer in answers):
            if time.monotonic() > deadline:
                self.unanswered += sum(not answer.done() for answer in answers)
                return False
            self.spin(0.02)
        return True

    def _good_data(self, found: dict[str, list[Back]]) -> set[str]:
        """Publish good data in real time; return who has not published in time."""
        good = self.fuzzer.begin_good_data()
        count = len(list(sweeps(self.run, "turn")))
        number = first = shift = 0
        while len(self.fuzzer.back) < len(NODES):
            if time.monotonic() - good.began_s > _TIMEOUT_S:
                break
            if number % count == 0:  # from the beginning, later
                number = first = 0
                shift = time.time_ns() - int(self.run.imu["stamp"][0])
            first = self.fuzzer.give(self.run, number, first, shift)
            number += 1
            self.spin(_SWEEP_S)
        for name, back in self.fuzzer.back.items():
            found[name].append(back)
        return set(NODES) - set(self.fuzzer.back)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a campaign ended with.

    Attributes
    ----------
    sizes_mb : dict
        By program: memory after each calm round, which leaves every node with a new map.
    ended : str
        What the program said that ended by itself, empty if none did.
    foreign_load : float
        Share of the processors that other programs used meanwhile.
    """

    campaign: Campaign
    sizes_mb: dict[str, list[float]]
    ended: str
    foreign_load: float

    @property
    def growth_mb(self) -> dict[str, float]:
        """Memory gained in the second half of the calm rounds, by program.

        In the first half parameters have modules imported that nobody needed before, some 70 MB.
        """
        return {name: some[-1] - some[len(some) // 2] for name, some in self.sizes_mb.items()}


def fuzz(
    seconds: float, seed: int, attacks: int, least: int = _CALM_EVERY, *, begin_calm: bool = True
) -> Outcome:
    """Run rounds for a time, and at least so many; the first is calm, or else the fourth."""
    isolate_ros()
    run = record("room", "walk", 1, _RUN_S)
    rclpy.init()
    fuzzer = Fuzzer(seed)
    ended = ""
    sizes: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder, Programs() as programs:
        campaign = Campaign(fuzzer, programs, run)
        load = ForeignLoad(os.getpid())
        try:
            pids = start(programs, Path(folder))
            while not fuzzer.clients_ready:
                campaign.spin(0.1)
            load.begin()
            deadline = time.monotonic() + seconds
            while time.monotonic() < deadline or campaign.rounds < least:
                is_calm = (campaign.rounds + (not begin_calm)) % _CALM_EVERY == 0
                campaign.round(0 if is_calm else attacks)
                if is_calm:
                    for name, pid in pids.items():
                        sizes.setdefault(name, []).append(resident_mb(pid))
        except ProgramError as error:
            ended = str(error)
        foreign = load.share()
    fuzzer.node.destroy_node()
    rclpy.shutdown()
    return Outcome(campaign, sizes, ended, foreign)


def report(outcome: Outcome) -> tuple[list[dict[str, Any]], list[Target]]:
    """Return a row for every node, and the targets."""
    campaign, growth_mb = outcome.campaign, outcome.growth_mb
    is_idle = outcome.foreign_load < _IDLE
    rows: list[dict[str, Any]] = []
    targets = [
        at_most("programs that ended", int(bool(outcome.ended)), 0),
        at_most("nodes that were stuck", len(campaign.stuck), 0),
        at_most("internal errors", len(campaign.fuzzer.errors), 0),
        at_most("growth of a program (MB)", max(growth_mb.values(), default=0.0), 20.0),
    ]
    for name in NODES:
        back, calm = campaign.back[name] or [_NEVER], campaign.calm[name] or [_NEVER]
        program = name if name in growth_mb else "companion_node"
        rows.append({
            "node": name,
            "rounds": len(campaign.back[name]),
            "data (s), worst": round(_worst(back, "data_s"), 2),
            "calm": round(_worst(calm, "data_s"), 2),
            "wall (s), median": round(float(np.median([item.wall_s for item in back])), 2),
            "worst": round(_worst(back, "wall_s"), 2),
            "calm, worst": round(_worst(calm, "wall_s"), 2),
            "growth (MB)": round(growth_mb.get(program, 0.0), 1),
        })  # fmt: skip
        for kind in ("data_s", "wall_s") if is_idle else ("data_s",):
            late = _worst(back, kind) - _worst(calm, kind)
            words = f"{name}: publishing later than in calm rounds, by {kind[:4]} (s)"
            targets.append(at_most(words, late, _TARGET_S))
    return rows, targets


def _worst(times: Iterable[Back], kind: str) -> float:
    return max(float(getattr(item, kind)) for item in times)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run it; return 1 for any finding."""
    if not sys.stdout.isatty():
        os.environ.setdefault("COLUMNS", "200")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--attacks", type=int, default=200, help="per round")
    options = parser.parse_args(arguments)
    outcome = fuzz(options.seconds, options.seed, options.attacks)
    campaign = outcome.campaign
    if outcome.ended:
        print(outcome.ended, file=sys.stderr)
    for text in sorted(set(campaign.fuzzer.errors + campaign.stuck)):
        print(text, file=sys.stderr)
    rows, targets = report(outcome)
    for name, sizes in outcome.sizes_mb.items():
        print(f"memory of {name} [MB]: {', '.join(f'{size:.0f}' for size in sizes)}")
    publish("fuzz_nodes", "Hostile neighbors", rows, targets)
    print(
        f"{campaign.rounds} rounds, {campaign.fuzzer.sent} hostile messages and calls, "
        f"{campaign.unanswered} calls without an answer; other "
        f"programs used {100.0 * outcome.foreign_load:.0f} % of the machine"
    )
    return int(not all(target.met for target in targets))


if __name__ == "__main__":
    sys.exit(main())
