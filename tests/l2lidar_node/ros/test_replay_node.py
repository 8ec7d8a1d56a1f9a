"""The node with a capture: what it publishes is what the live node published, bit for bit."""

from __future__ import annotations

import array
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, PointCloud2
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import SetBool, Trigger

from l2lidar_node.demo.processes import Program, assigned
from l2lidar_node.driver.reorder import REORDER_NS
from l2lidar_node.recording.bag import BagFile
from l2lidar_node.recording.packet_bag import HEADER_SIZE, PACKETS, open_packets
from l2lidar_node.recording.recording import Recording
from l2lidar_node.ros.conversions import from_time
from tests.l2lidar_node.driver.virtual_host import EPOCH_NS, live_run
from tests.l2lidar_node.ros.rig import TIMEOUT_S, Rig, open_rig, refused
from tests.support import build

YEARS_NS = 20 * 365 * 86_400 * 10**9  # from 2023 into the 2040s

END_NS = REORDER_NS + 200_000_000  # what may wait at the end: swapped packets, and a sweep
SETTINGS = {"qos_reliability": "reliable", "sweep_cut": "half_turn", "imu_adjust": True}


@pytest.fixture
def rig() -> Iterator[Rig]:
    with open_rig() as item:
        yield item


class Ear:
    """Keeps the messages of a driver, by stamp."""

    def __init__(self, rig: Rig) -> None:
        self.clouds: dict[int, PointCloud2] = {}
        self.samples: dict[int, Imu] = {}
        self.times: list[int] = []
        node = rig.observer
        reliable = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)
        self._node = node
        self._subscriptions = [
            node.create_subscription(PointCloud2, "/points", self._cloud, reliable),
            node.create_subscription(Imu, "/imu/data", self._sample, reliable),
            node.create_subscription(Clock, "/clock", self._clock, 100),
        ]

    @property
    def heard(self) -> int:
        return len(self.clouds) + len(self.samples) + len(self.times)

    @property
    def is_connected(self) -> bool:
        """Whether every topic has its publisher."""
        return all(self._node.count_publishers(item.topic_name) for item in self._subscriptions)

    def take_what_waits(self) -> None:
        idle = 0
        while idle < 50:
            before = self.heard
            rclpy.spin_once(self._node, timeout_sec=0.001)
            idle = 0 if self.heard > before else idle + 1

    def close(self) -> None:
        for item in self._subscriptions:
            self._node.destroy_subscription(item)

    def _cloud(self, message: PointCloud2) -> None:
        self.clouds[from_time(message.header.stamp)] = message

    def _sample(self, message: Imu) -> None:
        self.samples[from_time(message.header.stamp)] = message

    def _clock(self, message: Clock) -> None:
        self.times.append(from_time(message.clock))


def heard_again(rig: Rig, path: Path, **settings: Any) -> Ear:
    """Replay a recording, which begins when the publishers have been found."""
    ear = Ear(rig)
    arguments = rig.arguments(**settings, replay_file=path, autostart=False)
    program = Program("l2lidar_node.ros.driver_node", arguments)
    try:
        change(rig, "configure")
        rig.wait_for(lambda: ear.is_connected, "publishers")
        change(rig, "activate")
        deadline = time.monotonic() + TIMEOUT_S
        while program._process.poll() is None:
            rclpy.spin_once(rig.observer, timeout_sec=0.05)
            assert time.monotonic() < deadline
        assert program._process.returncode == 0
    finally:
        program.stop()
    ear.take_what_waits()
    ear.close()
    return ear


def change(rig: Rig, label: str) -> None:
    """Take the driver through a transition of its life cycle."""
    request = ChangeState.Request(transition=Transition(label=label))
    assert rig.call(ChangeState, "/l2lidar_node/change_state", request).success


def test_a_replayed_node_publishes_what_the_live_one_did(rig: Rig, tmp_path: Path) -> None:
    path = tmp_path / "run.pcap"
    ear = Ear(rig)
    rig.emulator("--ready", "--loss", "0.01", "--reorder", "0.01")
    packets: list[bytes] = []
    latched = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    subscription = rig.observer.create_subscription(
        UInt8MultiArray,
        "/l2lidar_node/packets",
        lambda message: packets.append(bytes(message.data)),
        latched,
    )
    driver = rig.driver(**SETTINGS, record_file=path, publish_packets=True)
    rig.wait_for(lambda: len(ear.clouds) > 20 and len(packets) > 50, "clouds and packets")
    rig.programs.stop(driver)
    code, said = driver.stop()
    assert code == 0
    assert f"recording to {path}" in said
    ear.take_what_waits()
    assert not ear.times
    ear.close()
    rig.observer.destroy_subscription(subscription)
    # The topic's messages, one header left of all, are the capture, to the byte; the last ones may
    # not have come before the driver was gone.
    recorded_bytes = path.read_bytes()
    joined = packets[0] + b"".join(item[HEADER_SIZE:] for item in packets[1:])
    assert recorded_bytes.startswith(joined)
    assert len(joined) > 200_000

    bag = tmp_path / "run"
    with BagFile(bag) as file:  # as ros2 bag record makes it
        file.connect("/l2lidar_node/packets", PACKETS, 100, reliable=True, latched=True)
        for number, item in enumerate(packets):
            message = UInt8MultiArray(data=array.array("B", item))
            file.write("/l2lidar_node/packets", number, serialize_message(message))
    again = heard_again(rig, bag, **SETTINGS)
    for live, replayed, few in (
        (ear.clouds, again.clouds, 10),
        (ear.samples, again.samples, 100),
    ):
        # But for what came before the subscribers had found their publisher, and for the end: the
        # bag may lack the last packets, so a sweep may be cut short there, and the earlier one of
        # two swapped packets may be missing.
        first, last = max(min(live), min(replayed)), min(max(live), max(replayed)) - END_NS
        within = [stamp for stamp in live if first <= stamp <= last]
        assert len(within) > few
        assert within == [stamp for stamp in replayed if first <= stamp <= last]
        assert all(live[stamp] == replayed[stamp] for stamp in within)
    # The recording's time, never the wall's.
    assert len(again.times) > 50
    assert again.times == sorted(again.times)
    with open_packets(bag) as stream:
        recorded = [entry.time for entry in Recording(stream)]
    assert min(recorded) <= again.times[0] < again.times[-1] <= max(recorded)


def test_a_loop_goes_on_in_time_and_obeys_nobody(rig: Rig, tmp_path: Path) -> None:
    path = tmp_path / "run.pcap"
    path.write_bytes(live_run(2.0)[2].stream.getvalue())
    again = Ear(rig)
    rig.driver(**SETTINGS, replay_file=path, replay_loop=True, replay_rate=2.0)
    far = EPOCH_NS + 5e9
    rig.wait_for(lambda: again.samples and max(again.samples) > far, "another lap, and a third")
    stamps = list(again.samples)
    assert stamps == sorted(stamps)
    assert again.times == sorted(again.times)
    for kind, name, request in (
        (SetBool, "/l2lidar_node/enable", SetBool.Request(data=False)),
        (Trigger, "/l2lidar_node/reset", Trigger.Request()),
    ):
        answer = rig.call(kind, name, request)
        assert not answer.success
        assert "no device" in answer.message
    again.close()


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"replay_file": "no/such.pcap"}, "cannot replay no/such.pcap: No such file"),
        ({"replay_file": "README.md"}, "a capture file"),
        ({"serial_port": "/dev/null"}, "not a serial device"),
    ],
    ids=str,
)
def test_what_cannot_be_opened_ends_the_start(
    parameters: dict[str, str], words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    code, said = refused(capfd, *assigned(parameters))
    assert code == 1
    assert words in said


def test_a_serial_line_feeds_the_node(rig: Rig) -> None:
    emulator = rig.programs.start(
        "l2lidar_node.emulator", ["--serial", "pty", "--ready", "--world", "pattern"]
    )
    rig.wait_for(
        lambda: any(line.startswith("serial ") for line in tuple(emulator.lines)), "its port"
    )
    name = next(line for line in tuple(emulator.lines) if line.startswith("serial "))
    rig.driver(serial_port=name.split()[1].rstrip(","))
    rig.wait_for(lambda: len(rig.observer.clouds.stamps) >= 3, "clouds")


def test_a_capture_after_2038_is_refused_by_name(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "late.pcap"
    build.write_capture(path, build.capture(1.0), YEARS_NS)
    code, said = refused(capfd, *assigned({"replay_file": str(path)}))
    assert code == 1
    assert f"cannot replay {path}: the time " in said
    assert "ROS 2 stamps cover 1901-12-13 to 2038-01-19" in said
