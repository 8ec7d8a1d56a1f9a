"""Room for more than one cloud between processes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any
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
CLOUD_BYTES = 365_000
CLOUDS = 6  # a second of half turns

SPEAKER = """
import sys
{start}
from rclpy.node import Node
node = Node("speaker")
print("ready", flush=True)
sys.stdin.readline()
"""
OURS = 'from l2lidar_node.ros.program import start_rclpy; start_rclpy(["speaker"])'
PLAIN = "import rclpy; rclpy.init()"


def room(start: str, profile: Path | None = None) -> int:
    """Return the size of the shared memory that a node has for what it publishes [B]."""
    domain = {
        "ROS_DOMAIN_ID": str(free_ros_domain()),  # not that of this test run
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    environment = {name: value for name, value in os.environ.items() if name not in NAMES}
    if profile is not None:
        environment |= dict.fromkeys(NAMES[:2], str(profile))
    node = subprocess.Popen(
        [sys.executable, "-c", SPEAKER.format(start=start)],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env=environment | domain,
    )  # fmt: skip
    try:
        assert node.stdout is not None
        assert node.stdout.readline().strip() == "ready"
        mapped = Path(f"/proc/{node.pid}/maps").read_text().splitlines()
        spans = [line.split()[0].split("-") for line in mapped if "/dev/shm/" in line]
        return max(int(end, 16) - int(begin, 16) for begin, end in spans)
    finally:
        node.kill()
        node.communicate(timeout=LIMIT_S)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /dev/shm")
def test_a_node_has_room_for_the_clouds_of_a_listener_that_is_held_up() -> None:
    assert room(PLAIN) < 2 * CLOUD_BYTES  # that is why
    assert room(OURS) > CLOUDS * CLOUD_BYTES


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
    assert size > CLOUDS * CLOUD_BYTES


def milliseconds(profile: Any, name: str) -> float:
    """Return a duration of a profile."""
    (found,) = (item for item in profile.iter() if item.tag.endswith(f"}}{name}"))
    seconds, nanoseconds = (int(part.text or 0) for part in found)
    return 1e3 * seconds + 1e-6 * nanoseconds


def test_the_profile_for_wifi_keeps_that_room_and_sends_what_fits_into_a_packet() -> None:
    path = ROOT / "config" / "fastdds_wifi.xml"
    assert room(PLAIN, path) > CLOUDS * CLOUD_BYTES
    profile = ElementTree.parse(path)
    (largest,) = (item.text for item in profile.iter() if item.tag.endswith("maxMessageSize"))
    assert int(largest or 0) <= 1500 - 28  # headers of IP and UDP
    # A repair takes two times the link's delay: a question that is repeated before that brings
    # it twice, and so on, until nothing else gets through.
    assert milliseconds(profile, "heartbeatPeriod") <= 100.0
    assert milliseconds(profile, "heartbeatResponseDelay") >= 150.0
