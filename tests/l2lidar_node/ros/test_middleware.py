"""Room for more than one cloud between processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from l2lidar_node.demo.processes import free_ros_domain
from l2lidar_node.ros import program

pytestmark = pytest.mark.ros
ROOT = Path(__file__).parents[3]
LIMIT_S = 60.0
NAMES = (
    "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_BUILTIN_TRANSPORTS",
)  # fmt: skip
COUNT = 6

SPEAKER = f"""
import sys, time
from l2lidar_node.ros.program import start_rclpy
start_rclpy(["speaker"])
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt8MultiArray
node = Node("speaker")
qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
publisher = node.create_publisher(UInt8MultiArray, "clouds", qos)
while not publisher.get_subscription_count():
    time.sleep(0.01)
print("heard of", flush=True)
sys.stdin.readline()
for number in range({COUNT}):
    publisher.publish(UInt8MultiArray(data=bytes(365_000)))
print("sent", flush=True)
sys.stdin.readline()
"""
LISTENER = f"""
import sys, time
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt8MultiArray
rclpy.init()
node = rclpy.create_node("listener")
qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
clouds = []
subscription = node.create_subscription(UInt8MultiArray, "clouds", clouds.append, qos)
while not subscription.get_publisher_count():
    time.sleep(0.01)
for _ in range(10):
    rclpy.spin_once(node, timeout_sec=0.1)
print("heard of", flush=True)
sys.stdin.readline()
until = time.monotonic() + 5.0
while len(clouds) < {COUNT} and time.monotonic() < until:
    rclpy.spin_once(node, timeout_sec=0.1)
print(len(clouds), flush=True)
"""


def started(code: str, environment: dict[str, str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
    )  # fmt: skip


def next_line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def go_on(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /dev/shm")
def test_a_listener_that_is_held_up_loses_no_cloud() -> None:
    # Stopped at a moment at which the middleware is busy it may lose all, whatever the room.
    assert any(heard_after_a_stop() == COUNT for _ in range(8))


def heard_after_a_stop() -> int:
    """Return how many clouds a process hears that were sent while it was stopped."""
    domain = {
        "ROS_DOMAIN_ID": str(free_ros_domain()),  # not that of this test run
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    environment = {name: value for name, value in os.environ.items() if name not in NAMES}
    listener = started(LISTENER, environment | domain)
    speaker = started(SPEAKER, environment | domain)
    try:
        # What is published before both know of each other is lost.
        assert next_line(listener) == next_line(speaker) == "heard of"
        listener.send_signal(signal.SIGSTOP)
        go_on(speaker)
        assert next_line(speaker) == "sent"
        listener.send_signal(signal.SIGCONT)
        go_on(listener)
        return int(next_line(listener))
    finally:
        for process in (listener, speaker):
            process.kill()
            process.communicate(timeout=LIMIT_S)


def test_what_others_have_configured_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in NAMES:
        for other in NAMES:
            monkeypatch.delenv(other, raising=False)
        monkeypatch.setenv(name, "theirs")
        program.make_room()
        assert {os.environ.get(other) for other in NAMES} == {"theirs", None}
        monkeypatch.delenv(name)
    (tmp_path / "DEFAULT_FASTRTPS_PROFILES.xml").touch()
    program.make_room()
    assert not any(name in os.environ for name in NAMES)


def test_the_profile_gives_room_for_a_second_of_clouds(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in NAMES:
        monkeypatch.setenv(name, "")
    program.make_room()
    profile = ElementTree.parse(os.environ[NAMES[0]])
    (size,) = (int(item.text or 0) for item in profile.iter() if item.tag.endswith("segment_size"))
    assert size > 6 * 365_000
